// SPDX-License-Identifier: BSD-3-Clause
#include "search/ray_fit.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <span>

#include "numeric/ray.hpp"
#include "search/conic_fit.hpp"

namespace roundel {

namespace {

constexpr int kMaxCasts = 2;  // the second if the centre or theta changed much

/// The range of inner over outer distance on a ray from near the centre.
struct RatioRange {
    double least, most;
};

RatioRange ratios_near_centre(const RoundelLimits& limits) {
    const auto [low, high] = limits.ratio_range(limits.any_print);
    constexpr double kSlack = 0.1;  // for a quarter of a radius off the centre
    return {std::max(0.1, low - kSlack), std::min(0.95, high + kSlack)};
}

/// The order of the rays: diagonals first, then those between. The search has tested row and column already,
/// so few rays reject most false seeds.
constexpr std::array<int, kRays> kOrder{2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15, 0, 8, 4, 12};

/// A ray's number, and the pixels at which it leaves the disc and the ring; negative if it does not.
struct Walk {
    int number, inner, outer;
};

/// Finds the crossings with subpixel interpolation; none if walks along whole pixels find too few.
Crossings cast(const ImageView& image, const Seed& seed, const RatioRange& ratios) {
    const float theta = float(seed.dark + seed.bright) / 2;
    const int below = int(std::ceil(theta));
    Crossings crossings(std::max(1.0, double(seed.reach)));
    std::array<Walk, kRays> walks;
    int n = 0, missed = 0, crossed = 0;
    for (; n < kRays && missed <= 2 + n / 3; ++n) {
        Ray ray(image, seed.x, seed.y, kDirections[size_t(kOrder[size_t(n)])]);
        const int inner = ray.walk<true>(below, seed.reach);
        int outer = inner < 0 ? -1 : ray.walk<false>(below, (float(inner) - 0.5f) / float(ratios.least) + 2);
        if (inner >= ratios.most * outer + 1) outer = -1;
        missed += outer < 0;
        crossed += (inner >= 0) + (outer >= 0);
        walks[size_t(n)] = {kOrder[size_t(n)], inner, outer};
    }
    if (crossed < kMinCrossings) return crossings;
    for (const auto [number, inner, outer] : std::span(walks.data(), size_t(n))) {
        if (inner < 0) continue;
        const Ray ray(image, seed.x, seed.y, kDirections[size_t(number)]);
        const float near = ray.between(inner, theta), far = outer < 0 ? 0 : ray.between(outer, theta);
        const float ratio = outer < 0 ? 0 : near / far;
        crossings.add(number, near, true, ratio);
        if (outer >= 0) crossings.add(number, far, false, ratio);
    }
    return crossings;
}

double median_level(const ImageView& image, const EllipseLevels& on, double scale) {
    auto levels = on.at(image, scale);
    std::nth_element(levels.begin(), levels.begin() + kRays / 2, levels.end());
    return double(levels[kRays / 2]);
}

/// The ellipse of a cast from `seed`, with the levels that it finds; nothing if it is not around the seed.
std::optional<InitialGuess> cast_and_fit(const ImageView& image, const Seed& seed, const RatioRange& ratios) {
    const Crossings crossings = cast(image, seed, ratios);
    const auto circles = fit_ellipses(crossings);
    if (!circles) return std::nullopt;
    auto [outer, ratio] = *circles;
    if (!(std::hypot(outer.x, outer.y) < outer.major)) return std::nullopt;
    outer.x += double(seed.x);
    outer.y += double(seed.y);
    const EllipseLevels on(outer);
    return InitialGuess{outer, ratio, median_level(image, on, (1 + ratio) / 2),
                        median_level(image, on, ratio / 3)};
}

bool is_plausible(const InitialGuess& guess, const RoundelLimits& limits) {
    const bool is_print = limits.print_error(guess.ratio) < limits.ratio_tolerance + 1 / guess.outer.minor;
    const double by_tone = kMaxCurvature * ratio_by_curvature(guess.outer, guess.ratio, kInitialBlur);
    return (is_print || limits.may_be_print(guess.ratio, guess.outer.major, by_tone)) &&
           guess.outer.major > 0.8 * limits.min_diameter && guess.outer.major < 1.2 * limits.max_diameter &&
           guess.outer.minor > 3 && guess.bright - guess.dark > limits.min_contrast / 2;
}

}  // namespace

std::optional<InitialGuess> fit_rays(const ImageView& image, const Seed& seed, const RoundelLimits& limits) {
    const RatioRange ratios = ratios_near_centre(limits);
    Seed from = seed;
    std::optional<InitialGuess> guess;
    for (int k = 0; k < kMaxCasts; ++k) {
        guess = cast_and_fit(image, from, ratios);
        if (!guess) return std::nullopt;
        const Ellipse& outer = guess->outer;
        const double dark = guess->dark, bright = guess->bright, theta = double(from.dark + from.bright) / 2;
        const double moved = std::hypot(outer.x - double(from.x), outer.y - double(from.y));
        const double change = std::abs((dark + bright) / 2 - theta);
        if (moved < 0.1 * outer.minor && change < 0.1 * (bright - dark)) break;
        from = {float(outer.x), float(outer.y), float(outer.major), int(dark), int(bright)};
    }
    return is_plausible(*guess, limits) ? guess : std::nullopt;
}

}  // namespace roundel
