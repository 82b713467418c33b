// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>

namespace roundel {

constexpr int kTile = 8;  // pixels of a side of a tile, in maps of an image

/// A view of an 8-bit grey image; `stride` is the distance between rows in bytes.
struct ImageView {
    const uint8_t* data;
    int width, height;
    ptrdiff_t stride;
    const uint8_t* row(int y) const { return data + y * stride; }
    ImageView window(int x, int y, int w, int h) const { return {row(y) + x, w, h, stride}; }
};

}  // namespace roundel
