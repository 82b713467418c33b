// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "detector.hpp"
#include "table.hpp"

namespace nb = nanobind;
using Grey = nb::ndarray<const uint8_t, nb::ndim<2>, nb::device::cpu>;
using Table = nb::ndarray<nb::numpy, double, nb::ndim<2>>;

static roundel::ImageView view(const Grey& image) {
    if (image.size() == 0) return {nullptr, 0, 0, 0};
    if (image.shape(1) > 1 && image.stride(1) != 1) throw nb::value_error("image rows must be contiguous");
    return {image.data(), int(image.shape(1)), int(image.shape(0)), ptrdiff_t(image.stride(0))};
}

/// One row a roundel.
static Table table(const std::vector<roundel::Roundel>& roundels) {
    auto* rows = new double[roundels.size() * roundel::kColumns + 1];
    const nb::capsule owner(rows, [](void* p) noexcept { delete[] static_cast<double*>(p); });
    double* to = rows;
    for (const auto& roundel : roundels)
        for (const double value : row_of(roundel)) *to++ = value;
    return Table(rows, {roundels.size(), roundel::kColumns}, owner);
}

NB_MODULE(_core, m) {
    m.def("distance_by_principal_axis", &roundel::distance_by_principal_axis, nb::arg("diameter"),
          nb::arg("major"));
    nb::class_<roundel::Detector>(m, "Detector")
        .def(
            "__init__",
            [](roundel::Detector* self, std::vector<double> ratios, double tolerance, double min_diameter,
               double max_diameter, double min_contrast, double share, bool by_paper) {
                new (self) roundel::Detector({std::move(ratios), tolerance, min_diameter, max_diameter,
                                              min_contrast, share, by_paper});
            },
            nb::arg("inner_ratios"), nb::arg("ratio_tolerance"), nb::arg("min_diameter"),
            nb::arg("max_diameter"), nb::arg("min_contrast"), nb::arg("search_share"), nb::arg("by_paper"))
        .def(
            "detect",
            [](roundel::Detector& self, const Grey& image) {
                const auto pixels = view(image);
                std::vector<roundel::Roundel> roundels;
                {
                    nb::gil_scoped_release release;
                    roundels = self.detect(pixels);
                }
                return table(roundels);
            },
            nb::arg("image").noconvert())
        .def("take_over", &roundel::Detector::take_over, nb::arg("other"))
        .def_prop_ro("theta", &roundel::Detector::theta)
        .def_prop_ro("postponed", &roundel::Detector::postponed);
}
