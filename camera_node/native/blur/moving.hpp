// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "numeric/image.hpp"
#include "blur/fit.hpp"
#include "settings.hpp"
#include "tracks.hpp"

namespace roundel {

/// A roundel of the last frame that is not to be seen sharp in this one: tried with the motion that it had
/// then, and wherever around its expected place it looks smeared.
std::optional<Fit> follow_moving(const ImageView& image, const Tracks::Expected& expected,
                                 const Settings& settings, double noise);

/// The fit of a roundel that is new and moves; nothing where it does not pass the gates that end false
/// positives.
std::optional<Fit> fit_moving(const ImageView& image, const MovingStart& start, const Settings& settings,
                              double noise);

}  // namespace roundel
