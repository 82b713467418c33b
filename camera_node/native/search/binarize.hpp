// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "numeric/image.hpp"
#include "search/bit_image.hpp"
#include "search/threshold.hpp"

namespace roundel {

/// Makes two images of the pixels below their thresholds, one to be scanned along rows and one along columns:
/// a line of `rows` is the mean of two rows of the image, a line of `columns` that of two columns. Averaging
/// halves the pixels to scan and reduces the noise; the resolution along the lines stays that of the image.
void binarize(const ImageView& image, const ThresholdMap& threshold, BitImage& rows, BitImage& columns);

}  // namespace roundel
