// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <mutex>
#include <optional>
#include <vector>

#include "blur/acceptance.hpp"
#include "blur/matcher.hpp"
#include "explanation.hpp"
#include "fit/roundel_limits.hpp"
#include "numeric/image.hpp"
#include "reference/faigl2013.hpp"
#include "search/change_mask.hpp"
#include "search/chords.hpp"
#include "search/suppression.hpp"
#include "tracks.hpp"
#include "verify/camera_model.hpp"

namespace roundel {

/// The roundels of a frame.
struct FrameResult {
    std::vector<TrackedFit> roundels;
    /// The number of seeds that were not fitted because a frame's work is bounded. The next frame begins with
    /// them.
    int n_postponed = 0;
};

/// Detects roundels in a sequence of grey images. Calls from several threads wait for each other.
///
/// Tracked roundels are fitted first, at their predicted positions. Then the parts of the image that changed
/// since they were searched are searched for new ones. Every 16th frame all of the image counts as changed.
class Detector {
  public:
    /// `search_share`: share of a frame's rows that is searched at most, if all changed. `by_paper`: search
    /// by the paper's segments instead of chords.
    explicit Detector(RoundelLimits limits, double search_share = 1, bool by_paper = false);
    FrameResult detect(const ImageView& image);
    /// The ring-like shapes of an image that this detector refuses; it learns nothing from it.
    std::vector<RefusedRing> explain(const ImageView& image);
    /// The threshold of the paper's search in the next frame; none with another search.
    std::optional<double> theta() const;
    /// Continues another detector's tracks and theta with this one's settings.
    void take_over(Detector& from);
    /// The exponent of the camera's tone curve, 1 if it is linear; none before the roundels determine it.
    std::optional<double> tone_exponent() const;
    /// The ratios of the prints that recur, if they were not given.
    std::vector<double> found_ratios() const;

  private:
    /// What is found in one frame.
    struct FrameState {
        FrameState(const ImageView& given, const ImageView& linearized, bool known);
        ImageView encoded, image;         // as the camera gives it, and with levels in proportion to light
        double noise;                     // of `image`, grey levels
        std::optional<double> density{};  // `noise_density` of `image`, from the first new roundel on
        bool decided;                     // the camera is known as well as this frame shows it
        Suppression suppression;
        std::vector<TrackedFit> found;
        std::vector<RoundelFit> undecided;  // until the camera is known,
        std::vector<InitialGuess> refused;  // and rings that were refused until then
        int n_fits = 0;
    };
    /// Places where roundels may be, in the image's frame.
    struct Candidates {
        std::vector<Seed> seeds;
        std::vector<Streak> streaks;
    };

    std::vector<ExpectedRoundel> fit_tracked(FrameState& frame) const;
    void fit_by_paper(FrameState& frame);
    std::vector<Box> parts_to_search(const FrameState& frame);
    Box next_band(const ImageView& image);
    void find_candidates(const FrameState& frame, const std::vector<Box>& parts, double exponent,
                         Candidates& candidates);
    int fit_seeds(const std::vector<Seed>& seeds, FrameState& frame);
    void fit_moving_tracked(std::vector<ExpectedRoundel> lost, FrameState& frame) const;
    void fit_moving_streaks(const std::vector<Streak>& streaks, FrameState& frame) const;
    void update_theta(const std::vector<TrackedFit>& found);
    void mark_searched(const std::vector<Box>& parts, const std::vector<TrackedFit>& found);
    bool decide(FrameState& frame);
    bool observe(const FrameState& frame);
    void use_camera();

    bool fit_and_accept(const std::optional<InitialGuess>& guess, int track, bool known,
                        FrameState& frame) const;
    bool accept(const std::optional<RoundelFit>& fit, int track, bool known, FrameState& frame) const;
    std::optional<InitialGuess> guess(const Seed& seed, const FrameState& frame) const;
    AcceptanceContext context(const FrameState& frame) const { return context(frame.noise, frame.decided); }
    AcceptanceContext context(double noise, bool knows_camera = true) const {
        return {limits_, camera_, noise, knows_camera};
    }

    RoundelLimits limits_;
    double search_share_;
    ChordSearch chords_;
    MotionBlurMatcher matcher_;
    std::optional<PaperSearch> paper_;
    CameraModel camera_;
    Tracks tracks_;
    ChangeMask change_mask_;
    double searched_to_ = 0;    // share of the height, of the bands searched in turns
    double begin_at_ = 0;       // share of the seeds at which the next frame begins
    double searched_with_ = 1;  // exponent of the tone curve
    int n_postponed_ = 0;       // in the last frame
    int n_frames_ = 0;          // since all of the image counted as changed
    mutable std::mutex mutex_;
};

}  // namespace roundel
