// SPDX-License-Identifier: BSD-3-Clause
#include "tracks.hpp"

#include <algorithm>
#include <cmath>

namespace roundel {

namespace {

constexpr int kMaxMissed = 30;     // frames after which a lost track is deleted
constexpr int kNumbers = 1 << 30;  // numbers restart at 0 after these
constexpr double kSteady = 0.3;  // pixels from the predicted position: one step of a fit converges from there

}  // namespace

std::vector<ExpectedRoundel> Tracks::expect() const {
    std::vector<ExpectedRoundel> expected;
    for (const Track& t : tracks_) {
        if (t.missed) continue;
        const auto x = float(t.fit.outer.x + t.vx), y = float(t.fit.outer.y + t.vy);
        const auto reach = float(t.fit.outer.major);
        expected.push_back(
            {{x, y, reach, int(t.fit.dark), int(t.fit.bright)}, t.number, t.fit, t.vx, t.vy, t.steady});
    }
    return expected;
}

std::vector<Ellipse> Tracks::lost() const {
    std::vector<Ellipse> lost;
    for (const Track& t : tracks_)
        if (t.missed) lost.push_back(t.fit.outer);
    return lost;
}

InitialGuess ExpectedRoundel::guess() const {
    InitialGuess guess{fit.outer, fit.ratio, fit.dark, fit.bright, {}, fit.p, fit.noise, fit.ground};
    guess.outer.x += vx;
    guess.outer.y += vy;
    (*guess.model)[kX] += vx;
    (*guess.model)[kY] += vy;
    // The parameters beside fields are no solution without them: a single step from there leaves residuals
    // that would show the fields again.
    if (fit.fields.any()) guess.model.reset();
    return guess;
}

/// The distance of a roundel from a track's predicted position, pixels.
double Tracks::distance(const Track& t, const RoundelFit& fit) {
    return std::hypot(t.fit.outer.x + t.vx - fit.outer.x, t.fit.outer.y + t.vy - fit.outer.y);
}

/// The nearest of the tracks that are not taken, within a diameter.
const Tracks::Track* Tracks::nearest(const RoundelFit& fit, const std::vector<bool>& taken) const {
    const Track* best = nullptr;
    double least = fit.outer.major;
    for (size_t k = 0; k < tracks_.size(); ++k) {
        const Track& t = tracks_[k];
        if (taken[k]) continue;
        const double apart = distance(t, fit);
        if (apart < least) {
            least = apart;
            best = &t;
        }
    }
    return best;
}

void Tracks::forget_models() {
    for (Track& t : tracks_) t.steady = false;
}

void Tracks::update(std::vector<TrackedFit>& found) {
    std::vector<bool> taken(tracks_.size(), false);
    std::vector<Track> now;
    const auto continue_track = [&](TrackedFit& roundel, const Track& t) {
        taken[size_t(&t - tracks_.data())] = true;
        roundel.track = t.number;
        const double frames = t.missed + 1;
        now.push_back({t.number, size_t(&roundel - found.data()), roundel.fit,
                       (roundel.fit.outer.x - t.fit.outer.x) / frames,
                       (roundel.fit.outer.y - t.fit.outer.y) / frames, 0,
                       roundel.fit.unoccluded && distance(t, roundel.fit) < kSteady, t.code});
    };
    for (TrackedFit& roundel : found)
        for (const Track& t : tracks_)
            if (roundel.track >= 0 && t.number == roundel.track) continue_track(roundel, t);
    for (TrackedFit& roundel : found) {
        if (roundel.track >= 0) continue;
        if (const Track* t = nearest(roundel.fit, taken)) {
            continue_track(roundel, *t);
        } else {
            roundel.track = next_;
            next_ = (next_ + 1) % kNumbers;
            now.push_back({roundel.track, size_t(&roundel - found.data()), roundel.fit, 0, 0, 0, false});
        }
    }
    for (size_t k = 0; k < tracks_.size(); ++k)
        if (!taken[k] && tracks_[k].missed < kMaxMissed) {
            now.push_back(tracks_[k]);
            now.back().missed += 1;
            now.back().vx = now.back().vy = 0;  // unknown: a lost roundel is expected where it was last seen
        }
    tracks_.swap(now);
}

void Tracks::read_codes(std::vector<TrackedFit>& found, const ImageView& image) {
    for (Track& t : tracks_)
        if (!t.missed) found[t.row].code = t.code.add(image, found[t.row].fit);
}

}  // namespace roundel
