// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_limits.hpp"
#include "numeric/image.hpp"
#include "search/chords.hpp"

namespace roundel {

/// Casts 16 rays from a seed, finds where each leaves the bright disc and the dark ring (with subpixel
/// interpolation at the paper's threshold theta = (m_d + m_b) / 2), and fits the images of both circles
/// together. Crossings that disagree with the others, as on an occluding edge, are rejected.
///
/// Returns nothing if fewer than nine crossings of either circle agree (six on the rays of one half of the
/// disc, or on both sides of a strip), or if the ratio or the size is out of its limits.
std::optional<InitialGuess> fit_rays(const ImageView& image, const Seed& seed, const RoundelLimits& limits);

}  // namespace roundel
