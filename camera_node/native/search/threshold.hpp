// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "numeric/image.hpp"

namespace roundel {

/// Standard deviation of the noise, grey levels, from 1 to 8: by the flattest twentieth of some hundred
/// patches.
double noise_level(const ImageView& image);

/// The paper's threshold theta, kept from frame to frame (Faigl et al., Section III-B).
class Theta {
  public:
    double value() const { return value_; }
    /// A roundel of mean levels m_d and m_b was found: theta = (m_d + m_b) / 2.
    void settle(double dark, double bright);
    /// Nothing was found: theta steps through 1/2, 1/4, 3/4, 1/8, ... of the grey scale.
    void step();

  private:
    double value_ = 128;
    unsigned steps_ = 1;
};

/// A threshold for each square tile of an image; a pixel is dark where it is below its tile's threshold.
struct ThresholdMap {
    int shift = 0;               // a tile's side is 2^shift pixels, 8 or more
    int columns = 0;             // of tiles
    std::vector<uint8_t> theta;  // row by row
    /// Whether row `y` has other thresholds than the row above it.
    bool changes(int y) const { return (y & ((1 << shift) - 1)) == 0; }
    /// The thresholds of the `width` pixels of row `y`, and of up to 7 beyond.
    void expand(int y, int width, uint8_t* out) const;
};

/// One threshold for a whole image.
ThresholdMap constant_threshold(uint8_t theta);

/// Local light: the mid-range of each 8 x 8 tile (every second row of it) and its neighbours. A tile with
/// less contrast than `min_contrast` asks tiles of 16, 32, 64 and 128 pixels around it, and at last takes
/// `theta`.
ThresholdMap local_threshold(const ImageView& image, double min_contrast, uint8_t theta);

}  // namespace roundel
