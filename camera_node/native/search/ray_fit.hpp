// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "search/chords.hpp"
#include "numeric/image.hpp"
#include "fit/photometric_fit.hpp"
#include "settings.hpp"

namespace roundel {

/// Casts 16 rays from a seed, finds on each where it leaves the bright disc and where it leaves the dark ring
/// (between pixels, at the paper's threshold theta = (m_d + m_b) / 2), and fits both circles' images at once.
/// Crossings that disagree with the rest, where something covers an edge, are left out. Nothing comes back
/// where fewer than nine of either kind agree (six on rays of one half or on either side of a strip) or the
/// ratio or the size is no roundel's.
std::optional<Start> fit_circles(const ImageView& image, const Seed& seed, const Settings& settings);

}  // namespace roundel
