// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "blur/matcher.hpp"
#include "numeric/image.hpp"
#include "verify/acceptance.hpp"

namespace roundel {

/// A roundel of the last frame, and its velocity in pixels per frame.
struct KnownRoundel {
    const RoundelFit& last;
    double vx, vy;
};

/// Fits a roundel of the last frame that no sharp fit finds in this one: first with its last motion, then at
/// the best matches around its predicted position. Returns nothing if no fit passes the acceptance tests.
std::optional<RoundelFit> fit_known_moving(const ImageView& image, const KnownRoundel& known,
                                           const AcceptanceContext& context);

/// Fits a new roundel that moves; nothing if it does not pass the acceptance tests.
std::optional<RoundelFit> fit_new_moving(const ImageView& image, const MovingGuess& guess,
                                         const AcceptanceContext& context);

}  // namespace roundel
