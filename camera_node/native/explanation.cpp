// SPDX-License-Identifier: BSD-3-Clause
#include "explanation.hpp"

#include <algorithm>
#include <cmath>

#include "search/chords.hpp"
#include "search/ray_fit.hpp"
#include "search/suppression.hpp"
#include "verify/level_check.hpp"

namespace roundel {

namespace {

// Limits within which a shape is ring-like.
constexpr double kMinDiameter = 6;
constexpr double kMaxDiameter = 10000;
constexpr double kRingSpan = 6;      // standard deviations of noise: least contrast
constexpr double kSameCentre = 0.3;  // minor axes, for two ellipses of one ring
constexpr double kSameSize = 1.5;    // factor, for two ellipses of one ring
constexpr size_t kMaxCandidates = 4096;

RoundelLimits ring_limits(double noise) {
    RoundelLimits limits;
    limits.prints = {{0.2}, {0.4}, {0.6}, {0.8}};
    limits.ratio_tolerance = 0.1;
    limits.min_diameter = kMinDiameter;
    limits.max_diameter = kMaxDiameter;
    limits.min_contrast = kRingSpan * noise;
    return limits;
}

/// The test that the ring at a guess fails, if any, with what was measured.
std::optional<RefusedRing> refuse(const ImageView& image, const InitialGuess& guess,
                                  const AcceptanceContext& context) {
    const RefusedRing seen{guess.outer, guess.ratio, guess.bright - guess.dark, 0, Refusal::kNoFit};
    InitialGuess start = guess;
    start.camera = context.camera.prior_at(guess.outer.x, guess.outer.y);
    start.camera.prints = {};
    if (const auto accepted = fit_roundel(image, start, context, false)) {
        const bool bullseye = is_bullseye(image, *accepted, has_known_ratio(*accepted, context.limits));
        const auto reason =
            bullseye ? Refusal::kBullseye : refusal_of_new(image, *accepted, noise_density(image));
        if (!reason) return std::nullopt;
        return RefusedRing{accepted->outer, accepted->ratio, accepted->contrast(), 0, *reason};
    }
    const auto fit = fit_photometric(image, start);  // without a prior on the print
    if (!fit) return seen;
    const auto reason = find_refusal(image, *fit, context);
    return RefusedRing{fit->outer, fit->ratio, fit->contrast(), fit->edge_residual / fit->contrast(),
                       reason.value_or(Refusal::kCover)};
}

}  // namespace

std::vector<RefusedRing> explain_refusals(const ImageView& image, const AcceptanceContext& context) {
    const RoundelLimits limits = ring_limits(context.noise);
    ChordSearch chords(limits, false);
    chords.run(image, local_threshold(image, limits.min_contrast, 0));
    Suppression accepted(image.width, image.height);
    std::vector<RefusedRing> refused;
    const auto is_listed = [&](const Ellipse& e) {
        return std::any_of(refused.begin(), refused.end(), [&](const RefusedRing& ring) {
            return std::hypot(ring.outer.x - e.x, ring.outer.y - e.y) < kSameCentre * ring.outer.minor &&
                   std::max(ring.outer.major, e.major) < kSameSize * std::min(ring.outer.major, e.major);
        });
    };
    size_t left = kMaxCandidates;
    for (const Seed& seed : chords.seeds()) {
        if (accepted.contains_fast(double(seed.x), double(seed.y))) continue;
        if (left-- == 0) break;
        const auto guess = fit_rays(image, seed, limits);
        if (!guess || is_listed(guess->outer) || accepted.contains(guess->outer.x, guess->outer.y)) continue;
        if (const auto ring = refuse(image, *guess, context))
            refused.push_back(*ring);
        else
            accepted.add(guess->outer);
    }
    return refused;
}

}  // namespace roundel
