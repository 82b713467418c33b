// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <mutex>
#include <vector>

#include "search/chords.hpp"
#include "search/suppression.hpp"
#include "numeric/image.hpp"
#include "reference/faigl2013.hpp"
#include "search/threshold.hpp"
#include "tracks.hpp"
#include "search/change_mask.hpp"

namespace roundel {

/// Roundels of grey images, frame after frame: those of the last frame where they are expected, then what
/// changed since it was searched under a local threshold, each one fitted to its grey levels. Every 16th
/// frame all counts as changed. Calls from several threads wait for each other.
class Detector {
  public:
    explicit Detector(Settings settings)
        : settings_(std::move(settings)), chords_(settings_), smeared_(settings_) {}
    std::vector<Roundel> detect(const ImageView& image);
    /// The paper's theta, in force for the next frame.
    double theta() const { return theta_.value(); }
    /// How many places of the last frame were left for the next ones, which begin with them.
    int postponed() const { return postponed_; }
    /// Carries on another's tracks and theta, under settings of its own.
    void take_over(Detector& from);

  private:
    void follow(const ImageView& image);
    void search(const ImageView& image);
    void follow_smeared(const ImageView& image);
    void search_smeared(const ImageView& image);
    void search_part(const ImageView& image, const Box& part);
    void fit_places(const ImageView& image);
    std::vector<Box> parts_to_search(const ImageView& image);
    void settle();
    bool accept(const ImageView& image, const std::optional<Start>& start, int track);
    bool keep(const ImageView& image, const std::optional<Fit>& fit, int track);
    Box next_band(const ImageView& image);
    void update_theta();

    Settings settings_;
    ChordSearch chords_;
    StreakMatcher smeared_;
    Theta theta_;
    Tracks tracks_;
    Watch watch_;
    Claims claims_{0, 0};
    std::vector<Roundel> found_;
    std::vector<Box> parts_;
    std::vector<Seed> places_;
    std::vector<Tracks::Expected> lost_;
    std::vector<Streak> streaks_;
    double noise_ = 0;        // grey levels
    double searched_to_ = 0;  // share of the height
    double begin_at_ = 0;     // share of the places to look at, where a frame had too many
    int postponed_ = 0, fits_ = 0;
    int frames_ = 0;  // since all counted as changed
    std::mutex mutex_;
};

}  // namespace roundel
