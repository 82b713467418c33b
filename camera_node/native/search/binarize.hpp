// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "search/bit_image.hpp"
#include "numeric/image.hpp"
#include "search/threshold.hpp"

namespace roundel {

/// Two pictures of what is below its threshold, for looking along rows and along columns: a line of `rows` is
/// the mean of two rows of the image, a line of `columns` that of two columns. So both are half as much to
/// look at, with less noise, and keep the image's resolution along their lines.
void binarise(const ImageView& image, const ThresholdMap& threshold, BitImage& rows, BitImage& columns);

}  // namespace roundel
