// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "numeric/image.hpp"
#include "fit/photometric_fit.hpp"
#include "settings.hpp"

namespace roundel {

/// Contrast, ratio and size within their limits, and levels that a camera can give.
bool has_limits(const Fit& fit, const Settings& settings);

/// The fit to the picture as it is, or to what is left of it where something covers a part, or, where its
/// edges are ragged (drawn, sharpened, badly printed), to the softened one; nothing where none passes the
/// gates that end false positives. They are wider for what is `known` from the last frame. From a model only
/// the first of these is tried: what is not as it was needs another start.
std::optional<Fit> fit_roundel(const ImageView& image, Start start, const Settings& settings, double noise,
                               bool known);

}  // namespace roundel
