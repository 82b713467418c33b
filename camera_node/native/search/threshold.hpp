// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "numeric/image.hpp"

namespace roundel {

/// Standard deviation of the noise in grey levels, 1 at least, estimated from the flattest twentieth of 256
/// patches.
double noise_level(const ImageView& image);

/// Spectral density of the noise at low frequencies in squared grey levels, 1 at least, estimated like its
/// level: the variance of a mean of n pixels is this over n, however processing correlates them. That of
/// independent noise is its variance. In a picture full of detail it contains that of the detail.
double noise_density(const ImageView& image);

/// A threshold for each square tile of an image. A pixel is dark if it is below its tile's threshold.
struct ThresholdMap {
    int shift = 0;               // the side of a tile is 2^shift pixels, 8 or more
    int columns = 0;             // of tiles
    std::vector<uint8_t> theta;  // row by row
    /// Whether row `y` may have other thresholds than the row above it.
    bool changes(int y) const { return (y & ((1 << shift) - 1)) == 0; }
    /// Writes the thresholds of the `width` pixels of row `y`, and of up to 7 pixels more.
    void expand(int y, int width, uint8_t* out) const;
};

/// One threshold for a whole image.
ThresholdMap constant_threshold(uint8_t theta);

/// The exponent of a camera's tone curve, and the standard deviation of the noise, grey levels.
struct Tone {
    double exponent = 1, noise = 0;
};

/// A threshold that follows local light: half way between the extremes of each 8 x 8 tile (every second row
/// of it) and of its neighbours, in light. A tile with less contrast than `min_contrast` uses the tiles of
/// 16, 32, 64 and 128 pixels around it, and finally `theta`.
ThresholdMap local_threshold(const ImageView& image, double min_contrast, uint8_t theta,
                             const Tone& tone = {});

}  // namespace roundel
