// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "numeric/image.hpp"
#include "blur/fit.hpp"

namespace roundel {

/// Where a roundel that was there in the last frame may be smeared in this one, the likeliest first.
///
/// Its shape and its levels are known. What it would look like is foretold at a few dozen points of the disc,
/// for six directions and two lengths of its motion, and compared at all places within `reach` pixels of
/// (x, y), a seventh of the minor axis apart; the level of the ground is free. The fit needs no better start.
std::vector<MovingStart> search_smeared(const ImageView& image, const Fit& last, double x, double y,
                                        double reach);

}  // namespace roundel
