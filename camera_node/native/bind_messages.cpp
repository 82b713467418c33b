// SPDX-License-Identifier: BSD-3-Clause
#include "bind_messages.hpp"

#include <nanobind/ndarray.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>

namespace nb = nanobind;

namespace {

static_assert(std::endian::native == std::endian::little, "columns of messages are little-endian");
constexpr double kMaxCoordinate = 1e5;  // pixels

/// The number `k` of a column; bytes have no alignment.
template <class T>
T number(const nb::bytes& column, size_t k) {
    T value;
    std::memcpy(&value, static_cast<const char*>(column.c_str()) + k * sizeof(T), sizeof(T));
    return value;
}

/// Whether all centres (pairs of doubles) are finite, and covariances (floats uu, uv, vv) positive definite
/// and below `most` square pixels.
bool are_plausible(const nb::bytes& uv, const nb::bytes& cov, double most) {
    const size_t n = uv.size() / (2 * sizeof(double));
    if (cov.size() != 3 * n * sizeof(float)) throw nb::value_error("columns of different lengths");
    for (size_t k = 0; k < n; ++k) {
        const double uu = number<float>(cov, 3 * k), mixed = number<float>(cov, 3 * k + 1),
                     vv = number<float>(cov, 3 * k + 2);
        if (!(uu > 0 && uu < most && vv < most && uu * vv > mixed * mixed)) return false;
        for (const size_t i : {2 * k, 2 * k + 1})
            if (!(std::abs(number<double>(uv, i)) < kMaxCoordinate)) return false;
    }
    return true;
}

/// Appends the rows of a column, of whose numbers each row has those in this order.
template <class From>
double* append(double* to, const nb::bytes& column, size_t n, size_t width,
               std::initializer_list<size_t> order) {
    if (column.size() != n * width * sizeof(From)) throw nb::value_error("columns of different lengths");
    for (size_t k = 0; k < n; ++k)
        for (const size_t i : order) *to++ = number<From>(column, k * width + i);
    return to;
}

/// The columns of `Detections` one after another, in one array: a NumPy array costs as much as a hundred
/// rows. Those of codes are NaN where the message has none.
nb::object unpack_detections(const nb::bytes& uv, const nb::bytes& cov, const nb::bytes& axes_px,
                             const nb::bytes& angle_rad, const nb::bytes& ratio, const nb::bytes& contrast,
                             const nb::bytes& id_probability, const nb::bytes& rotation_rad,
                             const nb::bytes& rotation_sigma) {
    const size_t n = uv.size() / (2 * sizeof(double));
    auto* data = new double[14 * n + 1];
    const nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<double*>(p); });
    double* to = append<double>(data, uv, n, 2, {0, 1});
    to = append<float>(to, cov, n, 3, {0, 1, 1, 2});
    to = append<float>(to, axes_px, n, 2, {0, 1});
    for (const nb::bytes& column : {angle_rad, ratio, contrast}) to = append<float>(to, column, n, 1, {0});
    for (const nb::bytes& column : {id_probability, rotation_rad, rotation_sigma})
        to = column.size() ? append<float>(to, column, n, 1, {0})
                           : std::fill_n(to, n, std::numeric_limits<double>::quiet_NaN());
    const size_t size = 14 * n;
    return nb::cast(nb::ndarray<nb::numpy, double>(data, 1, &size, owner));
}

}  // namespace

void bind_messages(nb::module_& m) {
    m.def("are_plausible", &are_plausible);
    m.def("unpack_detections", &unpack_detections);
}
