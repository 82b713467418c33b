// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <initializer_list>
#include <utility>
#include <vector>

#include "disc_view.hpp"

/// Takes NumPy arrays without copies and checks sizes and indices once.
namespace roundel::fusion {

namespace nb = nanobind;
template <class T, nb::ssize_t... shape>
using In = nb::ndarray<const T, nb::shape<shape...>, nb::c_contig, nb::device::cpu>;
using Index = In<int64_t, -1>;
using Mask = In<bool, -1>;
using Numbers = In<double, -1>;
using Pairs = In<double, 2, -1>;
using Vectors = In<double, 3, -1>;
using Matrices2 = In<double, 2, 2, -1>;
using Positions = In<double, -1, 3>;
using Rotations = In<double, -1, 3, 3>;
using Covariances = In<double, -1, 12, 12>;
using EquationArray = In<double, -1, 2, 13>;
template <class T>
using OutOf = nb::ndarray<nb::numpy, T>;
using Out = OutOf<double>;

/// Raises ValueError unless all sizes are n.
inline void require_equal(size_t n, std::initializer_list<size_t> sizes) {
    for (const size_t size : sizes)
        if (size != n) throw nb::value_error("arrays of different lengths");
}

/// Raises IndexError unless 0 <= index < n.
inline void require_below(size_t n, int64_t index) {
    if (uint64_t(index) >= n) throw nb::index_error("an index is out of range");
}
inline const int64_t* below(size_t n, const Index& indices) {
    for (size_t k = 0; k < indices.size(); ++k) require_below(n, indices(k));
    return indices.data();
}

/// An array with N columns, its last axis.
template <int R, class Array>
Columns<R> columns(const Array& array, size_t n) {
    require_equal(n, {array.shape(array.ndim() - 1)});
    return {array.data(), n};
}

inline Vector vector_at(const double* v) { return {v[0], v[1], v[2]}; }
inline Matrix matrix_at(const double* m) { return {vector_at(m), vector_at(m + 3), vector_at(m + 6)}; }

inline void write(const Vector& v, double* to) {
    to[0] = v.x;
    to[1] = v.y;
    to[2] = v.z;
}
inline void write(const Matrix& m, double* to) {
    write(m.r0, to);
    write(m.r1, to + 3);
    write(m.r2, to + 6);
}

/// Makes an array that owns its memory.
template <class T = double>
std::pair<OutOf<T>, T*> make(std::initializer_list<size_t> shape) {
    size_t size = 1;
    for (const size_t n : shape) size *= n;
    auto* data = new T[size + 1];
    const nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return {OutOf<T>(data, shape, owner), data};
}

/// Runs `work` without the global interpreter lock.
template <class Work>
void unlocked(const Work& work) {
    const nb::gil_scoped_release release;
    work();
}

using BodyStates = std::vector<Body>;
using CameraExposures = std::vector<Exposure>;

}  // namespace roundel::fusion
