// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>

namespace roundel {

/// A view of an 8-bit grey image; `stride` is the distance between rows in bytes.
struct ImageView {
    const uint8_t* data;
    int width, height;
    ptrdiff_t stride;
    const uint8_t* row(int y) const { return data + y * stride; }
};

/// Mean grey levels of the two classes that the grey level `theta` separates, and how many pixels are dark.
struct Levels {
    double dark, bright;
    size_t dark_count;
};

/// m_d and m_b of the paper's adaptive threshold theta = (m_d + m_b) / 2 (Faigl et al., Section III-B).
/// A class without pixels has the mean `theta`.
Levels class_means(const ImageView& image, uint8_t theta);

}  // namespace roundel
