// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include "threshold.hpp"

namespace nb = nanobind;
using Grey = nb::ndarray<const uint8_t, nb::ndim<2>, nb::device::cpu>;

static roundel::ImageView view(const Grey& image) {
    if (image.shape(1) > 1 && image.stride(1) != 1) throw nb::value_error("image rows must be contiguous");
    return {image.data(), int(image.shape(1)), int(image.shape(0)), ptrdiff_t(image.stride(0))};
}

NB_MODULE(_core, m) {
    m.def(
        "class_means",
        [](const Grey& image, uint8_t theta) {
            const auto pixels = view(image);
            nb::gil_scoped_release release;
            const auto levels = roundel::class_means(pixels, theta);
            return std::tuple(levels.dark, levels.bright, levels.dark_count);
        },
        nb::arg("image").noconvert(), nb::arg("theta"));
}
