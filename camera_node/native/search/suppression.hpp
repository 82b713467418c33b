// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "numeric/ellipse.hpp"

namespace roundel {

/// The parts of an image that found roundels cover.
class Claims {
  public:
    Claims(int width, int height);
    void add(const Ellipse& ellipse);
    /// Whether a point lies in an ellipse that was added.
    bool cover(double x, double y) const;
    /// The same at once, of the last ellipse near the point only: where two touch it may say no for yes.
    bool cover_quickly(double x, double y) const;

  private:
    size_t tile(double x, double y) const;
    int columns_, rows_;           // of tiles of 8 x 8 pixels
    std::vector<uint16_t> tiles_;  // 1 + the number of the last ellipse that reaches the tile, or 0
    std::vector<Ellipse> ellipses_;
};

}  // namespace roundel
