// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>
#include <span>
#include <vector>

#include "blur/fit.hpp"
#include "blur/templates.hpp"
#include "fit/roundel_limits.hpp"
#include "numeric/image.hpp"
#include "search/chords.hpp"

namespace roundel {

/// An initial guess of a moving roundel, and its misfit: RMS residual over the contrast.
struct MovingMatch {
    MovingGuess guess;
    double misfit;
};

/// Finds moving roundels by comparing the image with templates (see templates.hpp).
class MotionBlurMatcher {
  public:
    explicit MotionBlurMatcher(const RoundelLimits& limits) : min_contrast_(float(limits.min_contrast)) {
        use_prints(limits.prints);
    }
    /// New roundels are of these prints from now on.
    void use_prints(std::span<const Print> prints);

    /// A roundel of the last frame, by its picture at the predicted position: the best three matches within
    /// `reach` pixels of it on a grid of a seventh of the minor axis, best first.
    static std::vector<MovingMatch> match_known(const ImageView& image, const InitialGuess& predicted,
                                                double reach);

    /// A new roundel at a streak: the best match by coordinate descent in position, direction and both
    /// diameters; nothing if the streak is not symmetric or nothing matches.
    std::optional<MovingMatch> match_streak(const ImageView& image, const Streak& streak) const;

  private:
    /// A disc with one diameter along its motion and one across it, pixels, and the motion's direction.
    struct DiscPlace {
        double x, y, angle, along, across;
    };
    struct StreakMatch {
        DiscPlace place;
        const NewTemplate* found;
        double misfit, dark, bright;
    };
    static void sample(const ImageView& image, const DiscPlace& place, NewTemplate::Column& levels);
    /// Every `stride`-th template with a motion in a range, diameters.
    struct Selection {
        size_t stride;
        double shortest, longest;
    };
    void compare(const NewTemplate::Column& levels, const DiscPlace& place, const Selection& among,
                 StreakMatch& best) const;
    bool descend(const ImageView& image, StreakMatch& best) const;

    float min_contrast_;
    std::vector<NewTemplate> templates_;
};

}  // namespace roundel
