// SPDX-License-Identifier: BSD-3-Clause
#include "tracks.hpp"

#include <algorithm>
#include <cmath>

namespace roundel {

namespace {

constexpr int kPatience = 30;      // frames that a lost track keeps its number
constexpr int kNumbers = 1 << 30;  // numbers begin anew after these
constexpr double kSteady = 0.3;    // pixels off its expected place: a fit's step converges from there

}  // namespace

std::vector<Tracks::Expected> Tracks::expect() const {
    std::vector<Expected> expected;
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

Start Tracks::Expected::start() const {
    Start start{fit.outer, fit.ratio, fit.dark, fit.bright, {}, {}, fit.p, fit.noise};
    start.outer.x += vx, start.outer.y += vy;
    (*start.model)[kX] += vx, (*start.model)[kY] += vy;
    return start;
}

/// How far from where a track is expected a roundel is seen, pixels.
double Tracks::off(const Track& t, const Fit& fit) {
    return std::hypot(t.fit.outer.x + t.vx - fit.outer.x, t.fit.outer.y + t.vy - fit.outer.y);
}

/// The free track that is expected nearest to a roundel, within a diameter.
const Tracks::Track* Tracks::nearest(const Fit& fit, const std::vector<bool>& taken) const {
    const Track* best = nullptr;
    double least = fit.outer.major;
    for (size_t k = 0; k < tracks_.size(); ++k) {
        const Track& t = tracks_[k];
        if (taken[k]) continue;
        const double apart = off(t, fit);
        if (apart < least) least = apart, best = &t;
    }
    return best;
}

void Tracks::update(std::vector<Roundel>& found) {
    std::vector<bool> taken(tracks_.size(), false);
    std::vector<Track> now;
    const auto continue_track = [&](Roundel& roundel, const Track& t) {
        taken[size_t(&t - tracks_.data())] = true;
        roundel.track = t.number;
        const double frames = t.missed + 1;
        now.push_back({t.number, roundel.fit, (roundel.fit.outer.x - t.fit.outer.x) / frames,
                       (roundel.fit.outer.y - t.fit.outer.y) / frames, 0,
                       roundel.fit.plain && off(t, roundel.fit) < kSteady});
    };
    for (Roundel& roundel : found)
        for (const Track& t : tracks_)
            if (roundel.track >= 0 && t.number == roundel.track) continue_track(roundel, t);
    for (Roundel& roundel : found) {
        if (roundel.track >= 0) continue;
        if (const Track* t = nearest(roundel.fit, taken)) {
            continue_track(roundel, *t);
        } else {
            roundel.track = next_, next_ = (next_ + 1) % kNumbers;
            now.push_back({roundel.track, roundel.fit, 0, 0, 0, false});
        }
    }
    for (size_t k = 0; k < tracks_.size(); ++k)
        if (!taken[k] && tracks_[k].missed < kPatience) {
            now.push_back(tracks_[k]);
            now.back().missed += 1;
            now.back().vx = now.back().vy =
                0;  // where it went is not known: it is looked for where it was last
        }
    tracks_.swap(now);
}

}  // namespace roundel
