// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "chords.hpp"
#include "image.hpp"
#include "paper.hpp"
#include "refine.hpp"

namespace roundel {

/// Casts 16 rays from a seed, finds on each where it leaves the bright disc and where it leaves the dark ring
/// (between pixels, at the paper's threshold theta = (m_d + m_b) / 2), and fits both circles' images at once.
/// Crossings that disagree with the rest, where something covers an edge, are left out. Nothing comes back
/// where fewer than nine of either kind agree or the ratio or the size is no roundel's.
std::optional<Start> fit_circles(const ImageView& image, const Seed& seed, const Settings& settings);

/// Of samples in the ring, which is dark, and in the hole and just outside, which are bright: how many are
/// seen, how many are off by a third of the contrast, and how many of these are in the ring.
struct Surface {
    int seen = 0, off = 0, ring_off = 0;
};
Surface inspect(const ImageView& image, const Fit& fit);

/// Whether two more dark rings lie around a roundel within four of its diameters, which makes it a bullseye.
/// One may be a plate that it stands on, or the line that its card was cut along.
bool is_bullseye(const ImageView& image, const Fit& fit);

}  // namespace roundel
