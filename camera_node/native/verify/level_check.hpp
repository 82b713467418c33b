// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "fit/photometric_fit.hpp"
#include "numeric/image.hpp"

namespace roundel {

constexpr double kWrongLevel = 0.3;  // of the contrast: a level that is neither noise nor uneven paper

/// Numbers of samples in the ring, which is dark, and in the hole, which is bright: all, and those whose
/// level is wrong.
struct LevelSamples {
    int total = 0, wrong = 0;
};
LevelSamples check_levels(const ImageView& image, const RoundelFit& fit);

/// Whether at least two more dark rings surround a ring within four of its diameters: then it is a bullseye.
/// A single one may be a plate below the card, or the line along which the card was cut.
///
/// A ring of no `known` print is more often one of a bullseye, so two least contrasts of the further rings
/// are tried for it.
bool is_bullseye(const ImageView& image, const RoundelFit& fit, bool known);

}  // namespace roundel
