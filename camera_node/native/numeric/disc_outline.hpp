// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "numeric/ellipse.hpp"
#include "numeric/vector3.hpp"

/// The outline of a disc in the image plane x/z, y/z of a camera of focal length 1.
///
/// A disc with centre c, unit normal n (camera frame) and radius r is a flattened quadric, whose outline has
/// the dual conic C* = c c^T - r^2 (I - n n^T) (Hartley and Zisserman 2004, section 8.3). Divided by its last
/// element it is m m^T - S, where m is the centre of an ellipse and S its shape. m differs from the image of
/// c.
namespace roundel {

/// A symmetric 3 x 3 matrix.
struct DualConic {
    double xx, xy, yy, xz, yz, zz;
};

inline DualConic dual_conic_of(const Vector3& c, const Vector3& n, double radius) {
    const double r2 = radius * radius;
    return {c.x * c.x - r2 * (1 - n.x * n.x), c.x * c.y + r2 * n.x * n.y, c.y * c.y - r2 * (1 - n.y * n.y),
            c.x * c.z + r2 * n.x * n.z,       c.y * c.z + r2 * n.y * n.z, c.z * c.z - r2 * (1 - n.z * n.z)};
}

/// a d^T + d a^T: the change of a a^T with a change d of a.
inline DualConic change_of_square(const Vector3& a, const Vector3& d) {
    return {2 * a.x * d.x,         a.x * d.y + a.y * d.x, 2 * a.y * d.y,
            a.x * d.z + a.z * d.x, a.y * d.z + a.z * d.y, 2 * a.z * d.z};
}

inline EllipseShape ellipse_of(const DualConic& C) {
    const double x = C.xz / C.zz, y = C.yz / C.zz;
    return {x, y, {x * x - C.xx / C.zz, x * y - C.xy / C.zz, y * y - C.yy / C.zz}};
}

/// The change of `ellipse_of(C)` with a change of C, to first order.
inline EllipseShape change_of_ellipse(const DualConic& C, const DualConic& change) {
    const double z = C.zz, x = C.xz / z, y = C.yz / z;
    const double dx = (change.xz - x * change.zz) / z, dy = (change.yz - y * change.zz) / z;
    return {dx,
            dy,
            {2 * x * dx - (change.xx - C.xx / z * change.zz) / z,
             x * dy + y * dx - (change.xy - C.xy / z * change.zz) / z,
             2 * y * dy - (change.yy - C.yy / z * change.zz) / z}};
}

/// The point C* e_z / c_z = c + r^2 / c_z (n_z n - e_z), whose image is the outline's centre.
inline Vector3 outline_centre(const Vector3& c, const Vector3& n, double radius) {
    const double size = radius * radius / c.z;
    return c + (size * n.z) * n - Vector3{0, 0, size};
}

}  // namespace roundel
