// SPDX-License-Identifier: BSD-3-Clause
#include "detector.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "search/ray_fit.hpp"
#include "verify/level_check.hpp"

namespace roundel {

namespace {

constexpr size_t kMaxRoundels = 4096;  // limit of a message
constexpr int kMaxFits = 512;          // of seeds in a frame
constexpr size_t kMaxLost = 8;         // lost roundels of a frame that are searched with motion blur
constexpr int kMaxMovingFits = 32;     // of streaks in a frame,
constexpr int kMaxFailures = 3;        // of which so many may fail; but one, unless one succeeded,
constexpr double kPoorMisfit = 0.085;  // from this misfit on: 5 % of moving roundels have more, and clutter

constexpr int kOverlap = 64;            // rows that a searched band shares with the one before
constexpr int kSearchInterval = 16;     // frames in which all of the image is searched once
constexpr double kMaxPartsShare = 0.5;  // of a frame: beyond it the whole frame is searched
constexpr double kMinChange = 1 / 8.0;  // of the least contrast: change of a tile's mean
// Noise alone spans 8 standard deviations in 10,000 pixels, and 9 in the widest tile of a frame.
constexpr double kNoiseSpan = 9.5;

}  // namespace

/// Whether the edge of a shadow lies across a roundel, so that others may be crossed, too.
static bool shows_shadow(const std::vector<TrackedFit>& found) {
    return std::any_of(found.begin(), found.end(),
                       [](const TrackedFit& roundel) { return roundel.fit.shadowed; });
}

Detector::Detector(RoundelLimits limits, double search_share, bool by_paper)
    : limits_(std::move(limits)),
      search_share_(search_share),
      chords_(limits_, limits_.any_print),
      matcher_(limits_),
      camera_(limits_.prints, limits_.any_print) {
    if (by_paper) paper_.emplace();
    limits_.prints = camera_.prints();
}

Detector::FrameState::FrameState(const ImageView& given, const ImageView& linearized, bool known)
    : encoded(given),
      image(linearized),
      noise(noise_level(linearized)),
      decided(known),
      suppression(given.width, given.height) {}

FrameResult Detector::detect(const ImageView& image) {
    const std::lock_guard lock(mutex_);
    if (image.width < 3 || image.height < 3) return {};
    // 1. Grey levels in proportion to light, as far as the response of this camera is known.
    FrameState frame(image, camera_.linearize(image), camera_.is_known());
    // 2. The roundels of the last frame, at their predicted positions.
    const std::vector<ExpectedRoundel> lost = fit_tracked(frame);
    // 3. New ones: local thresholds and chords give seeds, rays from these a conic, the photometric fit the
    // ellipse, which is verified.
    std::vector<Box> parts;
    Candidates candidates;
    if (paper_) {
        fit_by_paper(frame);
    } else {
        parts = parts_to_search(frame);
        find_candidates(frame, parts, camera_.exponent_in_use(), candidates);
        // All of the image was searched in the frame before, as that of a linear camera.
        if (n_frames_ == 2 && !camera_.exponent() && search_share_ >= 1)
            find_candidates(frame, {{0, 0, image.width, image.height}}, kPriorExponent, candidates);
        n_postponed_ = fit_seeds(candidates.seeds, frame);
        // Between ink in full light and paper in shade lies the middle of the logarithm of light, the limit
        // of the exponent 0. The middle of light itself may make that paper dark.
        if (n_frames_ == 1 && search_share_ >= 1 && !n_postponed_ && shows_shadow(frame.found)) {
            Candidates in_shade;
            find_candidates(frame, {{0, 0, image.width, image.height}}, 0, in_shade);
            n_postponed_ = fit_seeds(in_shade.seeds, frame);
        }
    }
    // 4. Roundels that moved during the exposure.
    fit_moving_tracked(lost, frame);
    fit_moving_streaks(candidates.streaks, frame);
    const bool observed = decide(frame);
    // 5. Tracks, and what the next frame needs not search again.
    tracks_.update(frame.found);
    if (paper_)
        update_theta(frame.found);
    else
        mark_searched(parts, frame.found);
    // 6. What the roundels show of their prints and of the camera, and their codes.
    if (!observed) observe(frame);
    for (TrackedFit& roundel : frame.found) camera_.claim(roundel.fit);
    tracks_.read_codes(frame.found, frame.image);
    return {std::move(frame.found), n_postponed_};
}

/// Casts rays in the picture as the camera gives it, in which contrast is judged, and converts the levels.
std::optional<InitialGuess> Detector::guess(const Seed& seed, const FrameState& frame) const {
    auto guess = fit_rays(frame.encoded, seed, limits_);
    if (!guess) return guess;
    guess->dark = camera_.linear(guess->dark);
    guess->bright = camera_.linear(guess->bright);
    return guess;
}

/// Fits the roundels of the last frame: steady ones from their last model, others by rays from their
/// predicted positions. Returns those that it does not find.
std::vector<ExpectedRoundel> Detector::fit_tracked(FrameState& frame) const {
    std::vector<ExpectedRoundel> lost;
    for (const ExpectedRoundel& expected : tracks_.expect()) {
        if (expected.steady && fit_and_accept(expected.guess(), expected.track, true, frame)) continue;
        Seed seed = expected.seed;
        seed.dark = int(camera_.encoded(seed.dark));
        seed.bright = int(camera_.encoded(seed.bright));
        if (!fit_and_accept(guess(seed, frame), expected.track, true, frame)) lost.push_back(expected);
    }
    return lost;
}

/// The parts that changed, except for those under roundels that were found already; a band of the frame if
/// they are too large.
std::vector<Box> Detector::parts_to_search(const FrameState& frame) {
    if (n_frames_ == kSearchInterval || n_postponed_) {
        change_mask_.invalidate();
        n_frames_ = 0;
    }
    if (std::abs(std::log(camera_.exponent_in_use() / searched_with_)) >= kMinTone) {
        searched_with_ = camera_.exponent_in_use();
        change_mask_.invalidate();  // the thresholds are others
    }
    ++n_frames_;
    change_mask_.update(frame.encoded);
    for (const TrackedFit& roundel : frame.found) change_mask_.mask(roundel.fit.outer);
    auto parts =
        change_mask_.changed(kMinChange * limits_.min_contrast, std::min(kMaxPartsShare, search_share_));
    const double area = double(frame.image.width) * frame.image.height;
    const bool whole = parts.size() == 1 && parts[0].area() == area;
    return whole ? std::vector{next_band(frame.encoded)} : parts;
}

/// The rows that are searched if all of the image changed.
Box Detector::next_band(const ImageView& image) {
    if (search_share_ >= 1) return {0, 0, image.width, image.height};
    if (searched_to_ > 1 - 1e-9) searched_to_ = 0;
    const int top = std::max(0, int(searched_to_ * image.height) - kOverlap);
    searched_to_ = std::min(1.0, searched_to_ + search_share_);
    const int bottom = std::clamp(int(std::ceil(searched_to_ * image.height)), 3, image.height);
    return {0, std::min(top, bottom - 3), image.width, bottom};
}

static ImageView window(const ImageView& image, const Box& part) {
    return image.window(part.left, part.top, part.right - part.left, part.bottom - part.top);
}

/// The contrast that a tile needs for a threshold of its own: more than noise alone makes.
static double tile_contrast(double noise, const RoundelLimits& limits) {
    return std::clamp(kNoiseSpan * noise, limits.min_contrast, 255.0);
}

/// Searches the parts of the image for the chords of rings, and for the streaks of moving ones. `exponent` is
/// that of the camera's tone curve.
void Detector::find_candidates(const FrameState& frame, const std::vector<Box>& parts, double exponent,
                               Candidates& candidates) {
    const bool linear = camera_.exponent_in_use() == 1;
    const double noise = linear ? frame.noise : noise_level(frame.encoded);
    for (const Box& part : parts) {
        const ImageView view = window(frame.encoded, part);
        chords_.run(view, local_threshold(view, tile_contrast(noise, limits_), 0, {exponent, noise}));
        const float left = float(part.left), top = float(part.top);
        for (Seed seed : chords_.seeds()) {
            seed.x += left;
            seed.y += top;
            candidates.seeds.push_back(seed);
        }
        for (Streak streak : chords_.streaks()) {
            streak.x += left;
            streak.y += top;
            candidates.streaks.push_back(streak);
        }
    }
}

/// Fits the seeds. Returns how many are left if there are more than the fits allowed: the next frame begins
/// with those.
int Detector::fit_seeds(const std::vector<Seed>& seeds, FrameState& frame) {
    const size_t n = seeds.size(), first = size_t(begin_at_ * double(n));
    const int most = frame.n_fits + kMaxFits;
    size_t done = 0;
    for (; done < n && frame.n_fits < most; ++done) {
        const Seed& seed = seeds[(first + done) % n];
        if (frame.suppression.contains_fast(double(seed.x), double(seed.y))) continue;
        fit_and_accept(guess(seed, frame), -1, false, frame);
    }
    begin_at_ = done < n ? double((first + done) % n) / double(n) : 0;
    return int(n - done);
}

void Detector::fit_by_paper(FrameState& frame) {
    const Box part = next_band(frame.image);
    const ImageView view = window(frame.image, part);
    for (InitialGuess guess : paper_->find(view, tile_contrast(frame.noise, limits_), limits_)) {
        guess.outer.y += part.top;
        fit_and_accept(guess, -1, false, frame);
    }
}

/// Fits lost roundels with motion blur: the fastest ones, if a light that went out took many.
void Detector::fit_moving_tracked(std::vector<ExpectedRoundel> lost, FrameState& frame) const {
    const auto speed = [](const ExpectedRoundel& e) { return std::hypot(e.vx, e.vy); };
    const auto last = lost.begin() + std::ptrdiff_t(std::min(lost.size(), kMaxLost));
    std::partial_sort(lost.begin(), last, lost.end(),
                      [&](const auto& a, const auto& b) { return speed(a) > speed(b); });
    for (auto expected = lost.begin(); expected != last; ++expected) {
        const auto is_same = [&](const TrackedFit& r) {
            const double apart = std::hypot(r.fit.outer.x - double(expected->seed.x),
                                            r.fit.outer.y - double(expected->seed.y));
            return r.track < 0 && apart < r.fit.outer.major;
        };
        if (std::any_of(frame.found.begin(), frame.found.end(), is_same)) continue;
        const KnownRoundel known{expected->fit, expected->vx, expected->vy};
        accept(fit_known_moving(frame.image, known, context(frame)), expected->track, true, frame);
    }
}

/// Fits new moving roundels at the streaks that match best. A streak in the middle of which the card of
/// another roundel lies is made by that one's edge.
void Detector::fit_moving_streaks(const std::vector<Streak>& streaks, FrameState& frame) const {
    std::vector<MovingMatch> matches;
    for (const Streak& streak : streaks) {
        if (frame.suppression.contains(double(streak.x), double(streak.y), kCardRatio)) continue;
        if (const auto match = matcher_.match_streak(frame.image, streak)) matches.push_back(*match);
    }
    std::sort(matches.begin(), matches.end(),
              [](const auto& a, const auto& b) { return a.misfit < b.misfit; });
    int fits = 0, failures = 0;
    for (const auto& [guess, misfit] : matches) {
        const int may_fail = misfit < kPoorMisfit || fits > failures ? kMaxFailures : 1;
        if (failures >= may_fail || fits == kMaxMovingFits) break;
        if (frame.suppression.contains(guess.still.outer.x, guess.still.outer.y)) continue;
        ++fits;
        failures += !accept(fit_new_moving(frame.image, guess, context(frame)), -1, false, frame);
    }
}

/// Whether the camera's response is all that shapes the levels of a roundel.
static bool shows_camera(const RoundelFit& fit) { return fit.unoccluded && !fit.fields.has_light(); }

/// Decides on the rings of a frame by what its roundels, and those that may be some, show together of a
/// camera that was not known. If they show another tone curve, its roundels and the rings that were refused
/// are fitted and tested again, too, as in the next frame. Returns whether the fits of the frame have been
/// observed.
bool Detector::decide(FrameState& frame) {
    if (frame.decided) return false;
    frame.decided = true;
    const auto shown = std::count_if(frame.found.begin(), frame.found.end(),
                                     [](const TrackedFit& roundel) { return shows_camera(roundel.fit); });
    const bool learns = size_t(shown) + frame.undecided.size() >= kMinWitnesses;
    const double before = camera_.exponent_in_use();
    const bool is_other = learns && observe(frame);
    const auto raise = [power = camera_.exponent_in_use() / before](auto& ring) {
        for (double* level : {&ring.dark, &ring.bright}) *level = CameraModel::to_power(*level, power);
    };
    const auto fit_again = [&](RoundelFit fit, int track, bool known) {
        raise(fit);
        if (fit.motion_x != 0 || fit.motion_y != 0)
            accept(fit_known_moving(frame.image, {fit, 0, 0}, context(frame)), track, known, frame);
        else
            fit_and_accept(InitialGuess{fit.outer, fit.ratio, fit.dark, fit.bright}, track, known, frame);
    };
    const auto undecided = std::exchange(frame.undecided, {});
    auto refused = std::exchange(frame.refused, {});
    if (is_other) {
        const auto found = std::move(frame.found);
        frame = FrameState(frame.encoded, camera_.linearize(frame.encoded), true);
        for (const auto& [fit, track, code] : found) fit_again(fit, track, true);
    }
    for (const RoundelFit& fit : undecided) fit_again(fit, -1, false);
    if (is_other)
        for (InitialGuess& ring : refused) {
            raise(ring);
            fit_and_accept(ring, -1, false, frame);
        }
    return learns && !is_other;
}

/// Learns what the roundels of a frame, and those that are not decided yet, show of the camera. Returns
/// whether another tone curve is in use.
bool Detector::observe(const FrameState& frame) {
    std::vector<Observation> roundels;
    for (const TrackedFit& roundel : frame.found)
        if (shows_camera(roundel.fit)) roundels.push_back({&roundel.fit, roundel.track});
    for (const RoundelFit& fit : frame.undecided) roundels.push_back({&fit, -1});
    const bool is_other = camera_.observe(roundels, frame.image);
    use_camera();
    return is_other;
}

/// Rings of other ratios than those of the camera's prints count as roundels all the same.
void Detector::use_camera() {
    limits_.prints = camera_.prints();
    matcher_.use_prints(limits_.prints);
    if (limits_.linearized_by == camera_.exponent_in_use()) return;
    limits_.linearized_by = camera_.exponent_in_use();
    tracks_.forget_models();
}

/// Section III-B of the paper: theta follows the mean levels of the roundels.
void Detector::update_theta(const std::vector<TrackedFit>& found) {
    if (found.empty()) return paper_->step();
    double dark = 0, bright = 0;
    for (const TrackedFit& roundel : found) {
        dark += roundel.fit.dark;
        bright += roundel.fit.bright;
    }
    paper_->set_levels(dark / double(found.size()), bright / double(found.size()));
}

/// Marks the searched parts, except under roundels and where tracks were lost.
void Detector::mark_searched(const std::vector<Box>& parts, const std::vector<TrackedFit>& found) {
    for (const TrackedFit& roundel : found) change_mask_.mask(roundel.fit.outer);
    for (const Box& part : parts) change_mask_.mark_searched(part);
    for (const Ellipse& lost : tracks_.lost()) change_mask_.invalidate(lost);
}

/// Whether there is a roundel at the guess: one found before, or one that the fit accepts and adds.
bool Detector::fit_and_accept(const std::optional<InitialGuess>& guess, int track, bool known,
                              FrameState& frame) const {
    if (!guess) return false;
    if (frame.suppression.contains(guess->outer.x, guess->outer.y)) return true;
    ++frame.n_fits;
    if (accept(fit_roundel(frame.image, *guess, context(frame), known), track, known, frame)) return true;
    if (!frame.decided) frame.refused.push_back(*guess);
    return false;
}

bool Detector::accept(const std::optional<RoundelFit>& fit, int track, bool known, FrameState& frame) const {
    if (!fit || frame.found.size() >= kMaxRoundels) return false;
    if (frame.suppression.contains(fit->outer.x, fit->outer.y)) return false;
    if (!known) {
        if (!frame.density) frame.density = noise_density(frame.image);
        if (refusal_of_new(frame.image, *fit, *frame.density)) return false;
    }
    if (is_bullseye(frame.image, *fit, has_known_ratio(*fit, limits_))) return false;
    if (fit->provisional) {
        const auto is_same = [&](const RoundelFit& other) {
            return std::hypot(other.outer.x - fit->outer.x, other.outer.y - fit->outer.y) <
                   fit->outer.minor / 2;
        };
        if (std::none_of(frame.undecided.begin(), frame.undecided.end(), is_same))
            frame.undecided.push_back(*fit);
        return false;
    }
    frame.suppression.add(fit->outer);
    frame.found.push_back({*fit, track});
    return true;
}

std::vector<RefusedRing> Detector::explain(const ImageView& image) {
    const std::lock_guard lock(mutex_);
    if (image.width < 3 || image.height < 3) return {};
    const ImageView linear = camera_.linearize(image);
    return explain_refusals(linear, context(noise_level(linear)));
}

std::optional<double> Detector::theta() const {
    const std::lock_guard lock(mutex_);
    return paper_ ? std::optional(paper_->theta()) : std::nullopt;
}

std::vector<double> Detector::found_ratios() const {
    const std::lock_guard lock(mutex_);
    return camera_.recurring();
}

std::optional<double> Detector::tone_exponent() const {
    const std::lock_guard lock(mutex_);
    return camera_.exponent();
}

void Detector::take_over(Detector& from) {
    if (&from == this) return;
    const std::scoped_lock lock(mutex_, from.mutex_);
    tracks_ = from.tracks_;
    camera_.take_over(from.camera_);
    limits_.linearized_by = camera_.exponent_in_use();
    use_camera();
    if (paper_ && from.paper_) paper_ = from.paper_;
}

}  // namespace roundel
