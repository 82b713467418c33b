// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include "bind_lens.hpp"
#include "bind_messages.hpp"
#include "code/code_book.hpp"
#include "detector.hpp"
#include "frame_columns.hpp"
#include "numeric/quaternion.hpp"

namespace nb = nanobind;
using GreyImage = nb::ndarray<const uint8_t, nb::ndim<2>, nb::device::cpu>;

static roundel::ImageView view(const GreyImage& image) {
    if (image.size() == 0) return {nullptr, 0, 0, 0};
    if (image.shape(1) > 1 && image.stride(1) != 1) throw nb::value_error("image rows must be contiguous");
    return {image.data(), int(image.shape(1)), int(image.shape(0)), ptrdiff_t(image.stride(0))};
}

/// An array of shape (rows, ...) that takes over the memory of a column.
template <typename T>
static nb::object array(std::vector<T>& column, size_t rows, std::initializer_list<size_t> shape = {}) {
    auto* values = new std::vector<T>(std::move(column));
    values->reserve(1);  // the pointer of an empty array must not be null
    const nb::capsule owner(values, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
    std::vector<size_t> full{rows};
    full.insert(full.end(), shape);
    return nb::cast(nb::ndarray<nb::numpy, T>(values->data(), full.size(), full.data(), owner));
}

static nb::dict detect(roundel::Detector& detector, const GreyImage& image) {
    const auto pixels = view(image);
    roundel::FrameResult result;
    {
        nb::gil_scoped_release release;
        result = detector.detect(pixels);
    }
    roundel::FrameColumns columns(result.roundels);
    const size_t n = result.roundels.size();
    nb::dict named;
    named["uv"] = array(columns.uv, n, {2});
    named["axes_px"] = array(columns.axes_px, n, {2});
    named["angle_rad"] = array(columns.angle_rad, n);
    named["ratio"] = array(columns.ratio, n);
    named["contrast"] = array(columns.contrast, n);
    named["offset_px"] = array(columns.offset_px, n, {2});
    named["pose_cov"] = array(columns.pose_cov, n, {roundel::kPoseCount, roundel::kPoseCount});
    named["track"] = array(columns.track, n);
    named["id"] = array(columns.id, n);
    named["id_probability"] = array(columns.id_probability, n);
    named["rotation_rad"] = array(columns.rotation_rad, n);
    named["rotation_sigma"] = array(columns.rotation_sigma, n);
    named["n_postponed"] = result.n_postponed;
    return named;
}

/// One row a ring: u, v, major, minor, angle, ratio, contrast, misfit, reason.
static nb::object explain(roundel::Detector& detector, const GreyImage& image) {
    const auto pixels = view(image);
    std::vector<roundel::RefusedRing> rings;
    {
        nb::gil_scoped_release release;
        rings = detector.explain(pixels);
    }
    std::vector<double> rows;
    for (const auto& [e, ratio, contrast, misfit, reason] : rings)
        rows.insert(rows.end(),
                    {e.x, e.y, e.major, e.minor, e.angle, ratio, contrast, misfit, double(int(reason))});
    return array(rows, rings.size(), {9});
}

/// (N, 4) quaternions of N rotations.
static nb::object quaternions(const nb::ndarray<const double, nb::shape<-1, 3, 3>, nb::c_contig>& rotations) {
    std::vector<double> parts;
    for (size_t k = 0; k < rotations.shape(0); ++k) {
        const double* m = rotations.data() + 9 * k;
        const auto q = roundel::quaternion({{m[0], m[1], m[2]}, {m[3], m[4], m[5]}, {m[6], m[7], m[8]}});
        parts.insert(parts.end(), q.begin(), q.end());
    }
    return array(parts, rotations.shape(0), {4});
}

NB_MODULE(_core, m) {
    bind_lens(m);
    bind_messages(m);
    m.def("quaternions", &quaternions);
    m.attr("CODE_SECTORS") = roundel::kCodeSectors;
    m.attr("CODE_RADII") = nb::make_tuple(roundel::kCodeInner, roundel::kCodeOuter);
    m.def("code_words", [] { return roundel::code_words(); });
    m.def("distance_by_principal_axis", &roundel::distance_by_principal_axis, nb::arg("diameter"),
          nb::arg("major"));
    nb::class_<roundel::RoundelLimits>(m, "RoundelLimits")
        .def(
            "__init__",
            [](roundel::RoundelLimits* limits, const std::vector<double>& ratios, double ratio_tolerance,
               double min_diameter, double max_diameter, double min_contrast) {
                new (limits) roundel::RoundelLimits{.ratio_tolerance = ratio_tolerance,
                                                    .min_diameter = min_diameter,
                                                    .max_diameter = max_diameter,
                                                    .min_contrast = min_contrast};
                limits->any_print = ratios.empty();
                if (!ratios.empty()) limits->prints.clear();
                for (const double ratio : ratios) limits->prints.push_back({ratio});
            },
            nb::arg("inner_ratios"), nb::arg("ratio_tolerance"), nb::arg("min_diameter"),
            nb::arg("max_diameter"), nb::arg("min_contrast"));
    nb::class_<roundel::Detector>(m, "Detector")
        .def(nb::init<roundel::RoundelLimits, double, bool>(), nb::arg("limits"), nb::arg("search_share"),
             nb::arg("by_paper"))
        .def("detect", &detect, nb::arg("image").noconvert())
        .def("explain", &explain, nb::arg("image").noconvert())
        .def("take_over", &roundel::Detector::take_over, nb::arg("other"))
        .def_prop_ro("found_ratios", &roundel::Detector::found_ratios)
        .def_prop_ro("theta", &roundel::Detector::theta)
        .def_prop_ro("tone_exponent", &roundel::Detector::tone_exponent);
}
