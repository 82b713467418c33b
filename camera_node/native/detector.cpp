// SPDX-License-Identifier: BSD-3-Clause
#include "detector.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include "search/ray_fit.hpp"
#include "verify/acceptance.hpp"
#include "blur/moving.hpp"
#include "verify/level_check.hpp"

namespace roundel {

namespace {

constexpr size_t kMaxRoundels = 4096;  // as many as a message may hold
constexpr int kOverlap = 64;           // pixels that a searched band reaches into the one before
constexpr int kFramesOfTrust = 16;     // in which what did not change is searched once
constexpr double kMostInParts = 0.5;   // of a frame that are searched apart, not as a whole
constexpr double kStill = 1 / 8.0;     // of the least contrast, by which a tile's mean may move
constexpr int kMaxFits = 512;          // to new places of a frame
constexpr size_t kMaxSmeared = 8;      // lost roundels of a frame that are looked for smeared
constexpr int kMaxMoving = 32;         // fits of new smeared ones, of which
constexpr int kMaxFailed = 3;          // so many may fail
constexpr double kNoiseSpan = 9.5;     // standard deviations

}  // namespace

std::vector<Roundel> Detector::detect(const ImageView& image) {
    const std::lock_guard lock(mutex_);
    found_.clear(), lost_.clear(), places_.clear(), streaks_.clear();
    fits_ = 0;
    if (image.width < 3 || image.height < 3) return found_;
    noise_ = noise_level(image);
    claims_ = Claims(image.width, image.height);
    follow(image);
    search(image);
    follow_smeared(image);
    search_smeared(image);
    tracks_.update(found_);
    settle();
    update_theta();
    return found_;
}

void Detector::follow(const ImageView& image) {
    for (const auto& expected : tracks_.expect())
        if (!(expected.steady && accept(image, expected.start(), expected.track)) &&
            !accept(image, fit_circles(image, expected.seed, settings_), expected.track))
            lost_.push_back(expected);
}

/// Those that were in the last frame, and are not to be seen sharp in this one; the fastest, where a light
/// that went out took all of them.
void Detector::follow_smeared(const ImageView& image) {
    const auto speed = [](const Tracks::Expected& e) { return std::hypot(e.vx, e.vy); };
    const auto last = lost_.begin() + std::ptrdiff_t(std::min(lost_.size(), kMaxSmeared));
    std::partial_sort(lost_.begin(), last, lost_.end(),
                      [&](const auto& a, const auto& b) { return speed(a) > speed(b); });
    for (auto expected = lost_.begin(); expected != last; ++expected) {
        const auto is_it = [&](const Roundel& r) {
            const double apart = std::hypot(r.fit.outer.x - double(expected->seed.x),
                                            r.fit.outer.y - double(expected->seed.y));
            return r.track < 0 && apart < r.fit.outer.major;
        };
        if (std::none_of(found_.begin(), found_.end(), is_it))
            keep(image, follow_moving(image, *expected, settings_, noise_), expected->track);
    }
}

/// The rows of the image that are searched where all of it changed.
Box Detector::next_band(const ImageView& image) {
    if (settings_.search_share >= 1) return {0, 0, image.width, image.height};
    if (searched_to_ > 1 - 1e-9) searched_to_ = 0;
    int top = std::max(0, int(searched_to_ * image.height) - kOverlap);
    searched_to_ = std::min(1.0, searched_to_ + settings_.search_share);
    const int bottom = std::clamp(int(std::ceil(searched_to_ * image.height)), 3, image.height);
    return {0, std::min(top, bottom - 3), image.width, bottom};
}

/// What changed and is not where a roundel was found already; a band of the frame where that is too much.
std::vector<Box> Detector::parts_to_search(const ImageView& image) {
    if (frames_ == kFramesOfTrust || postponed_) watch_.forget(), frames_ = 0;
    ++frames_;
    watch_.look(image);
    for (const Roundel& roundel : found_) watch_.explain(roundel.fit.outer);
    const double share = std::min(kMostInParts, settings_.search_share);
    auto parts = watch_.changed(kStill * settings_.min_contrast, share);
    const bool all = parts.size() == 1 && parts[0].area() == double(image.width) * image.height;
    return all ? std::vector{next_band(image)} : parts;
}

/// What was searched need not be again while it stays as it is, but for where roundels are or were of late.
void Detector::settle() {
    if (settings_.by_paper) return;
    for (const Roundel& roundel : found_) watch_.explain(roundel.fit.outer);
    for (const Box& part : parts_) watch_.settle(part);
    for (const Ellipse& lost : tracks_.lost()) watch_.doubt(lost);
}

void Detector::search(const ImageView& image) {
    parts_ = settings_.by_paper ? std::vector{next_band(image)} : parts_to_search(image);
    postponed_ = 0;
    for (const Box& part : parts_) search_part(image, part);
    fit_places(image);
}

/// Seeds and streaks are kept for later; what the paper's search finds is fitted at once.
void Detector::search_part(const ImageView& image, const Box& part) {
    const ImageView view = image.window(part.left, part.top, part.right - part.left, part.bottom - part.top);
    const auto theta = uint8_t(std::lround(std::clamp(theta_.value(), 1.0, 255.0)));
    // Ten thousand pixels that only noise tells apart span eight deviations, the widest tile of a frame nine.
    const double contrast = std::clamp(kNoiseSpan * noise_, settings_.min_contrast, 255.0);
    const ThresholdMap threshold = local_threshold(view, contrast, settings_.by_paper ? theta : 0);
    if (settings_.by_paper) {
        for (Start start : find_by_segments(view, threshold, settings_)) {
            start.outer.y += part.top;
            accept(image, start, -1);
        }
        return;
    }
    chords_.run(view, threshold);
    for (Seed seed : chords_.seeds()) {
        seed.x += float(part.left), seed.y += float(part.top);
        places_.push_back(seed);
    }
    for (Streak streak : chords_.streaks()) {
        streak.x += float(part.left), streak.y += float(part.top);
        streaks_.push_back(streak);
    }
}

/// Where there are more places than fits are allowed, the next frame begins with those that were left.
void Detector::fit_places(const ImageView& image) {
    const size_t n = places_.size(), first = size_t(begin_at_ * double(n));
    const int most = fits_ + kMaxFits;
    size_t looked_at = 0;
    for (; looked_at < n && fits_ < most; ++looked_at) {
        const Seed& seed = places_[(first + looked_at) % n];
        if (claims_.cover_quickly(double(seed.x), double(seed.y))) continue;
        accept(image, fit_circles(image, seed, settings_), -1);
    }
    postponed_ = int(n - looked_at);
    begin_at_ = postponed_ ? double((first + looked_at) % n) / double(n) : 0;
}

/// What is new and smeared: the streaks that look most like it are fitted.
void Detector::search_smeared(const ImageView& image) {
    std::vector<SmearedStart> starts;
    for (const Streak& streak : streaks_) {
        if (claims_.cover_quickly(double(streak.x), double(streak.y))) continue;
        if (const auto start = smeared_.match(image, streak)) starts.push_back(*start);
    }
    std::sort(starts.begin(), starts.end(), [](const auto& a, const auto& b) { return a.misfit < b.misfit; });
    int fits = 0, failed = 0;
    for (const auto& [start, misfit] : starts) {
        if (failed == kMaxFailed || fits == kMaxMoving) break;
        if (claims_.cover(start.still.outer.x, start.still.outer.y)) continue;
        ++fits, failed += !keep(image, fit_moving(image, start, settings_, noise_), -1);
    }
}

/// Fits, tests and keeps a roundel, unless it was found before; whether it is there.
bool Detector::accept(const ImageView& image, const std::optional<Start>& start, int track) {
    if (!start) return false;
    if (claims_.cover(start->outer.x, start->outer.y)) return true;
    ++fits_;
    return keep(image, fit_roundel(image, *start, settings_, noise_, track >= 0), track);
}

bool Detector::keep(const ImageView& image, const std::optional<Fit>& fit, int track) {
    if (!fit || found_.size() >= kMaxRoundels || claims_.cover(fit->outer.x, fit->outer.y)) return false;
    if (is_bullseye(image, *fit)) return false;
    claims_.add(fit->outer);
    found_.push_back({*fit, track});
    return true;
}

void Detector::take_over(Detector& from) {
    if (&from == this) return;
    const std::scoped_lock lock(mutex_, from.mutex_);
    tracks_ = from.tracks_, theta_ = from.theta_;
}

void Detector::update_theta() {
    if (found_.empty()) return theta_.step();
    double dark = 0, bright = 0;
    for (const Roundel& roundel : found_) dark += roundel.fit.dark, bright += roundel.fit.bright;
    theta_.settle(dark / double(found_.size()), bright / double(found_.size()));
}

}  // namespace roundel
