// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "image.hpp"
#include "refine.hpp"
#include "settings.hpp"

namespace roundel {

/// Contrast, ratio and size within their limits, and levels that a camera can give.
bool has_limits(const Fit& fit, const Settings& settings);

/// Whether the ring's edges are as the model says, but for noise and for what print and lens do to them:
/// `misfit` of the contrast, and more where large ones are drawn or cut by hand.
bool is_as_modelled(const Fit& fit, double noise, double misfit);

/// The fit to the picture as it is, or to what is left of it where something covers a part, or, where its
/// edges are ragged (drawn, sharpened, badly printed), to the softened one; nothing where none passes the
/// gates that end false positives. They are wider for what is `known` from the last frame.
std::optional<Fit> fit_roundel(const ImageView& image, Start start, const Settings& settings, double noise,
                               bool known);

}  // namespace roundel
