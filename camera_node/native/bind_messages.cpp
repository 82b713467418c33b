// SPDX-License-Identifier: BSD-3-Clause
#include "bind_messages.hpp"

#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include "numeric/unaligned.hpp"

namespace nb = nanobind;

namespace {

constexpr double kMaxCoordinate = 1e5;  // pixels

template <class T>
T number(const nb::bytes& column, size_t k) {
    return roundel::number_at<T>(column.c_str(), k);
}

/// Whether all centres (pairs of doubles) are finite, and covariances (floats uu, uv, vv) positive definite
/// and below `most` square pixels.
bool are_plausible(const nb::bytes& uv, const nb::bytes& cov, size_t n, double most) {
    for (size_t k = 0; k < n; ++k) {
        const double uu = number<float>(cov, 3 * k), mixed = number<float>(cov, 3 * k + 1),
                     vv = number<float>(cov, 3 * k + 2);
        if (!(uu > 0 && uu < most && vv < most && uu * vv > mixed * mixed)) return false;
        for (const size_t i : {2 * k, 2 * k + 1})
            if (!(std::abs(number<double>(uv, i)) < kMaxCoordinate)) return false;
    }
    return true;
}

/// What is wrong with the columns of `Detections`, of which a message has `max_rows` at most; empty if
/// nothing is. Those of codes may be empty. Comparisons with NaN, which is an unknown value, are false.
std::string fault_of_detections(size_t max_rows, double max_variance, const nb::bytes& uv,
                                const nb::bytes& cov, const nb::bytes& axes_px, const nb::bytes& angle_rad,
                                const nb::bytes& ratio, const nb::bytes& contrast, const nb::bytes& id,
                                const nb::bytes& track, const nb::bytes& id_probability,
                                const nb::bytes& rotation_rad, const nb::bytes& rotation_sigma) {
    const size_t n = uv.size() / (2 * sizeof(double));
    if (n > max_rows) return "too many roundels";
    const auto has = [n](const nb::bytes& column, size_t bytes) { return column.size() == n * bytes; };
    bool agree = has(uv, 16) && has(cov, 12) && has(axes_px, 8);
    for (const nb::bytes* column : {&angle_rad, &ratio, &contrast, &id, &track}) agree &= has(*column, 4);
    for (const nb::bytes* column : {&id_probability, &rotation_rad, &rotation_sigma})
        agree &= column->size() == 0 || has(*column, 4);
    if (!agree) return "columns of different lengths";
    if (!are_plausible(uv, cov, n, max_variance)) return "a centre or a covariance is NaN or out of range";
    const auto any = [](const nb::bytes& column, const auto& is_wrong) {
        for (size_t k = 0; k < column.size() / sizeof(float); ++k)
            if (is_wrong(number<float>(column, k))) return true;
        return false;
    };
    if (any(rotation_sigma, [](float sigma) { return sigma <= 0; }) ||
        any(id_probability, [](float p) { return p < 0 || p > 1; }))
        return "a code's probability or standard deviation is out of range";
    if (any(rotation_rad, [](float angle) { return std::isinf(angle); }))
        return "a code's rotation is infinite";
    return "";
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
    m.def("fault_of_detections", &fault_of_detections);
    m.def("unpack_detections", &unpack_detections);
}
