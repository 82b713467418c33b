// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "numeric/ellipse.hpp"

namespace roundel {

/// The parts of an image covered by roundels that were found. No other roundel is accepted there.
class Suppression {
  public:
    Suppression(int width, int height);
    void add(const Ellipse& ellipse);
    /// Whether a point lies in one of the ellipses, all of them scaled by a factor.
    bool contains(double x, double y, double scale = 1) const;
    /// The same in constant time. Tests only the last ellipse added near the point, so the result can be
    /// falsely negative where two ellipses touch.
    bool contains_fast(double x, double y) const;

  private:
    size_t tile(double x, double y) const;
    int columns_;                  // of tiles of 8 x 8 pixels
    int rows_;                     // of tiles of 8 x 8 pixels
    std::vector<uint16_t> tiles_;  // 1 + the number of the last ellipse that reaches the tile, or 0
    std::vector<Ellipse> ellipses_;
};

}  // namespace roundel
