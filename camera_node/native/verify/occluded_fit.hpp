// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "numeric/image.hpp"
#include "fit/occlusion.hpp"
#include "fit/photometric_fit.hpp"

namespace roundel {

/// Whether noise, and a hundredth of the contrast, explain all that a fit leaves on the ring's edges.
bool is_noise(const Fit& fit, double noise);

/// Whether what a fit leaves over gathers in some sectors, as where something covers a part; print, paper and
/// lens spread it.
bool shows_cover(const EdgeMisfit& misfit, const Fit& fit, double noise);

/// The fit to what is left of a roundel that something covers in part. Sectors of either edge that are off
/// the fit `whole` are left out and the rest is fitted anew, ever more strictly, until what is left is as the
/// model says; a biased fit does not come through, and the covariance is that of the rest. `misfit` is that
/// of `whole`, where it is known already.
///
/// A roundel that is `known` may look like a letter, and have a ratio a little off its print's; a new one may
/// not.
std::optional<Fit> fit_rest(const ImageView& image, Start start, const Fit& whole,
                            std::optional<EdgeMisfit> misfit, double noise, bool known);

}  // namespace roundel
