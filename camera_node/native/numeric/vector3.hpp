// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>

/// Vectors, matrices and rotations of space.
namespace roundel {

struct Vector3 {
    double x, y, z;
};

inline Vector3 operator+(const Vector3& a, const Vector3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector3 operator-(const Vector3& a, const Vector3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vector3 operator*(double s, const Vector3& a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(const Vector3& a, const Vector3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector3 cross(const Vector3& a, const Vector3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

/// A 3 x 3 matrix, stored by rows.
struct Matrix3 {
    Vector3 r0, r1, r2;

    Vector3 column0() const { return {r0.x, r1.x, r2.x}; }
    Vector3 column1() const { return {r0.y, r1.y, r2.y}; }
    Vector3 column2() const { return {r0.z, r1.z, r2.z}; }
};

inline Vector3 operator*(const Matrix3& A, const Vector3& b) {
    return {dot(A.r0, b), dot(A.r1, b), dot(A.r2, b)};
}
/// a^T B.
inline Vector3 operator*(const Vector3& a, const Matrix3& B) { return a.x * B.r0 + a.y * B.r1 + a.z * B.r2; }
inline Matrix3 operator*(const Matrix3& A, const Matrix3& B) { return {A.r0 * B, A.r1 * B, A.r2 * B}; }
inline Matrix3 operator+(const Matrix3& A, const Matrix3& B) {
    return {A.r0 + B.r0, A.r1 + B.r1, A.r2 + B.r2};
}
inline Matrix3 operator*(double s, const Matrix3& A) { return {s * A.r0, s * A.r1, s * A.r2}; }
inline Matrix3 transposed(const Matrix3& A) { return {A.column0(), A.column1(), A.column2()}; }

/// The rotation matrix of a rotation vector w by Rodrigues' formula, with the angle a = |w|:
/// cos(a) I + sin(a)/a [w]x + (1 - cos(a))/a^2 w w^T.
inline Matrix3 rotation_from_vector(const Vector3& w) {
    const double a = std::fmax(std::sqrt(dot(w, w)), 1e-12), c = std::cos(a), half = std::sin(a / 2) / a;
    const Vector3 s = (std::sin(a) / a) * w, k = (2 * half * half) * w;
    return {{k.x * w.x + c, k.x * w.y - s.z, k.x * w.z + s.y},
            {k.y * w.x + s.z, k.y * w.y + c, k.y * w.z - s.x},
            {k.z * w.x - s.y, k.z * w.y + s.x, k.z * w.z + c}};
}

}  // namespace roundel
