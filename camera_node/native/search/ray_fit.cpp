// SPDX-License-Identifier: BSD-3-Clause
#include "search/ray_fit.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <span>

#include "numeric/cholesky.hpp"
#include "numeric/lanes.hpp"
#include "numeric/ray.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kMinAgree = 9;              // crossings of each circle: 30 % of the disc may be occluded
constexpr int kMinAgreeOccluded = 6;      // on the rays of an unoccluded part,
constexpr int kMinOfPart = 14;            // of which so many cross
constexpr float kMaxRatioSpread = 0.35f;  // of unoccluded rays from within half a radius of the centre
constexpr int kMaxCasts = 2;              // the second if the centre or theta changed much
constexpr int kMaxReweights = 4;
constexpr double kRelative = 0.05;  // distance of an agreeing crossing from its ellipse, radii, and
constexpr double kAbsolute = 0.5;   // pixels

/// The points, as columns, at which rays cross the edges of the disc and of its hole, relative to the rays'
/// origin and in units of `unit` pixels. Values beyond `count` are 0.
struct Crossings {
    static constexpr int kMost = 2 * kRays;
    explicit Crossings(double length) : unit(length) {}
    alignas(4 * kLanes) float x[kMost]{}, y[kMost]{}, inner[kMost]{};  // inner is 1 or 0
    float ratio[kMost]{};  // inner over outer distance on the ray; 0 if it has only one
    int ray[kMost]{}, count = 0;
    uint16_t seen[2]{};  // one bit per ray: whether it crosses the disc's edge, and the hole's
    double unit;
    void add(int number, float at, bool is_inner, float its_ratio) {
        const Direction direction = kDirections[size_t(number)];
        const float away = at / float(unit);
        x[count] = away * direction.x, y[count] = away * direction.y, inner[count] = is_inner;
        ratio[count] = its_ratio, ray[count++] = number, seen[is_inner] |= uint16_t(1 << number);
    }
    int count_of(uint16_t rays) const {
        return std::popcount(uint16_t(seen[0] & rays)) + std::popcount(uint16_t(seen[1] & rays));
    }
};

/// The range of inner over outer distance on a ray from near the centre.
struct RatioRange {
    double least, most;
};

RatioRange ratios_near_centre(const RoundelLimits& limits) {
    const auto [low, high] = limits.ratio_range();
    const double slack = limits.ratio_tolerance + 0.1;  // for a quarter of a radius off the centre
    return {std::max(0.1, low - slack), std::min(0.95, high + slack)};
}

/// The order of the rays: diagonals first, then those between. The search has tested row and column already,
/// so few rays reject most false seeds.
constexpr std::array<int, kRays> kOrder{2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15, 0, 8, 4, 12};

struct Weights {
    alignas(4 * kLanes) float at[Crossings::kMost]{};
};

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
        missed += outer < 0, crossed += (inner >= 0) + (outer >= 0);
        walks[size_t(n)] = {kOrder[size_t(n)], inner, outer};
    }
    if (crossed < 2 * kMinAgreeOccluded + 2) return crossings;
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

/// The weight of a residual of `off` scales (Geman and McClure).
template <typename T>
ROUNDEL_INLINE T redescend(const T& off) {
    const T inverse = 1.0f / (1.0f + off * off);
    return inverse * inverse;
}

/// Two ellipses with the same centre and shape: p^T M p + v p = 1 is the outer one, = level the inner one.
struct Conics {
    double a, b, c, d, e, level;
    double at(double x, double y) const { return a * x * x + b * x * y + c * y * y + d * x + e * y; }
    double middle_x() const { return (b * e - 2 * c * d) / (4 * a * c - b * b); }
    double middle_y() const { return (b * d - 2 * a * e) / (4 * a * c - b * b); }
    bool are_ellipses() const { return a > 0 && 4 * a * c > b * b; }
};

/// Normal equations of weighted linear least squares.
struct ConicEquations {
    std::array<Vector<6>, 6> H;  // its lower triangle
    Vector<6> g;
};

ROUNDEL_CLONES void accumulate(const Crossings& crossings, const Weights& weights,
                               ConicEquations& equations) {
    Lanes H[6][6] = {}, g[5] = {};
    for (int k = 0; k < crossings.count; k += kLanes) {
        const Lanes x = load(crossings.x + k), y = load(crossings.y + k), inner = load(crossings.inner + k);
        const Lanes row[6] = {x * x, x * y, y * y, x, y, -inner}, w = load(weights.at + k);
        for (int i = 0; i < 6; ++i) {
            const Lanes weighed = w * row[i];
            for (int j = 0; j <= i; ++j) H[i][j] += weighed * row[j];
            if (i < 5) g[i] += weighed * (1.0f - inner);
        }
    }
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j <= i; ++j) equations.H[size_t(i)][size_t(j)] = double(sum(H[i][j]));
        equations.g[size_t(i)] = i < 5 ? double(sum(g[i])) : 0;
    }
}

std::optional<Conics> solve(const Crossings& crossings, const Weights& weights) {
    ConicEquations equations;
    accumulate(crossings, weights, equations);
    const Cholesky<6> factor(equations.H);
    if (!factor.positive()) return std::nullopt;
    const Vector<6> s = factor.solve(equations.g);
    const Conics conics{s[0], s[1], s[2], s[3], s[4], s[5]};
    return conics.are_ellipses() ? std::optional(conics) : std::nullopt;
}

/// The centre of the conics, and the values of the centred form on both ellipses.
struct ConicFrame {
    double x, y, outer, inner;
    explicit ConicFrame(const Conics& c) : x(c.middle_x()), y(c.middle_y()) {
        const double least = c.at(x, y);  // negative
        outer = 1 - least, inner = c.level - least;
    }
    bool is_valid() const { return inner > 0 && inner < outer; }
};

/// The distance of each crossing from its ellipse over the tolerance; 0 beyond the last one.
struct Distances {
    alignas(4 * kLanes) float off[Crossings::kMost];
};

ROUNDEL_CLONES void measure(const Crossings& crossings, const Conics& c, const ConicFrame& frame,
                            Distances& to) {
    const float a = float(c.a), b = float(c.b), cc = float(c.c);
    const float per_outer = float(1 / frame.outer), per_inner = float(1 / frame.inner);
    const float absolute = float(kAbsolute / crossings.unit);
    for (int k = 0; k < crossings.count; k += kLanes) {
        const Lanes dx = load(crossings.x + k) - float(frame.x), dy = load(crossings.y + k) - float(frame.y);
        const Lanes inner = load(crossings.inner + k), square = dx * dx + dy * dy + 1e-12f;
        const Lanes radius = square * inverse_sqrt(square);
        const Lanes form = dx * (a * dx + b * dy) + cc * dy * dy;  // the value of the centred form
        const Lanes share = form * (inner > 0.5f ? all(per_inner) : all(per_outer)) + 1e-12f;
        const Lanes off = radius * (share * inverse_sqrt(share) - 1.0f);
        store(to.off + k, off / (float(kRelative) * radius + absolute));
    }
}

/// Sets the weights by the distance from the ellipses. Returns the number of crossings that agree, of the
/// circle with fewer of them.
int reweigh(const Crossings& crossings, const Conics& conics, Weights& weights) {
    const ConicFrame frame(conics);
    Distances distances;
    measure(crossings, conics, frame, distances);
    int agree[2] = {0, 0};
    for (int k = 0; k < crossings.count; ++k) {
        const float off = distances.off[k];
        agree[crossings.inner[k] > 0] += std::abs(off) < 1;
        weights.at[k] = redescend(2 * off) * (crossings.inner[k] > 0 ? float(frame.outer / frame.inner) : 1);
    }
    return std::min(agree[0], agree[1]);
}

/// Initial weights: from near the centre, the ratios of unoccluded rays are similar.
Weights initial_weights(const Crossings& crossings) {
    std::array<float, kRays> ratios;
    int n = 0;
    for (int k = 0; k < crossings.count; ++k)
        if (crossings.inner[k] == 0) ratios[size_t(n++)] = crossings.ratio[k];
    std::nth_element(ratios.begin(), ratios.begin() + n / 2, ratios.begin() + n);
    Weights weights;
    for (int k = 0; k < crossings.count; ++k)
        weights.at[k] = redescend((crossings.ratio[k] - ratios[size_t(n / 2)]) * 10);
    return weights;
}

/// Iteratively reweighted least squares. The number of crossings that agree must grow in each iteration, to
/// at least `least`.
std::optional<Conics> iterate(const Crossings& crossings, const Weights& first, int least) {
    Weights weights = first;
    std::optional<Conics> conics;
    for (int k = 0, agree = 0; k < kMaxReweights && 2 * agree < crossings.count; ++k) {
        conics = solve(crossings, weights);
        if (!conics || !ConicFrame(*conics).is_valid()) return std::nullopt;
        agree = reweigh(crossings, *conics, weights);
        if (agree < least - kMaxReweights + 1 + k) return std::nullopt;
    }
    return conics;
}

/// Sets of rays, one bit each, that an occluding object may leave visible: half of them, adjacent, or a
/// quarter on each side of a strip through the centre.
constexpr std::array<uint16_t, 12> kVisibleParts = [] {
    std::array<uint16_t, 12> whole{};
    for (int first = 0; first < kRays; first += 2)
        for (int k = 0; k < kRays / 2; ++k) whole[size_t(first / 2)] |= uint16_t(1 << (first + k) % kRays);
    for (int first = 0; first < kRays / 2; first += 2)
        for (int k = 0; k < kRays / 4; ++k)
            for (const int side : {0, kRays / 2})
                whole[size_t(kRays + first) / 2] |= uint16_t(1 << (first + k + side) % kRays);
    return whole;
}();

/// The spread of the ratios of a set of rays.
float ratio_spread(const Crossings& crossings, uint16_t rays) {
    float least = 1, most = 0;
    for (int k = 0; k < crossings.count; ++k)
        if (crossings.ratio[k] > 0 && rays >> crossings.ray[k] & 1)
            least = std::min(least, crossings.ratio[k]), most = std::max(most, crossings.ratio[k]);
    return most - least;
}

/// Starts from the visible part whose ellipses agree with the most crossings.
std::optional<Conics> fit_visible_part(const Crossings& crossings) {
    int most = kMinAgreeOccluded - kMaxReweights;  // fewer would not pass `iterate`
    std::optional<Weights> best;
    for (const uint16_t part : kVisibleParts) {
        if (crossings.count_of(part) < kMinOfPart || ratio_spread(crossings, part) > kMaxRatioSpread)
            continue;
        Weights weights;
        for (int k = 0; k < crossings.count; ++k) weights.at[k] = float(part >> crossings.ray[k] & 1);
        const auto conics = solve(crossings, weights);
        if (!conics || !ConicFrame(*conics).is_valid()) continue;
        if (const int agree = reweigh(crossings, *conics, weights); agree > most)
            most = agree, best = weights;
    }
    return best ? iterate(crossings, *best, kMinAgreeOccluded) : std::nullopt;
}

Ellipse outer_ellipse(const Conics& c, const ConicFrame& frame, double unit) {
    const double det = c.a * c.c - c.b * c.b / 4;
    const Eigen e = eigen({c.c / det, -c.b / 2 / det, c.a / det});  // of M^-1
    const double diameter = 2 * unit;
    return {unit * frame.x, unit * frame.y, diameter * std::sqrt(frame.outer * e.first),
            diameter * std::sqrt(frame.outer * e.second), e.angle};
}

double median_level(const ImageView& image, const Ellipse& e, double scale) {
    auto levels = levels_on(image, e, scale);
    std::nth_element(levels.begin(), levels.begin() + kRays / 2, levels.end());
    return double(levels[kRays / 2]);
}

std::optional<Conics> fit_conics(const Crossings& crossings) {
    if (crossings.count < 2 * kMinAgreeOccluded + 2) return std::nullopt;
    auto conics = crossings.count < 2 * kMinAgree ? std::nullopt
                                                  : iterate(crossings, initial_weights(crossings), kMinAgree);
    return conics ? conics : fit_visible_part(crossings);
}

/// The ellipse of a cast from `seed`, with the levels that it finds; nothing if it is not around the seed.
std::optional<InitialGuess> cast_and_fit(const ImageView& image, const Seed& seed, const RatioRange& ratios) {
    const Crossings crossings = cast(image, seed, ratios);
    const auto conics = fit_conics(crossings);
    if (!conics) return std::nullopt;
    const ConicFrame frame(*conics);
    Ellipse outer = outer_ellipse(*conics, frame, crossings.unit);
    const double ratio = std::sqrt(frame.inner / frame.outer);
    if (!(std::hypot(outer.x, outer.y) < outer.major)) return std::nullopt;
    outer.x += double(seed.x), outer.y += double(seed.y);
    return InitialGuess{outer, ratio, median_level(image, outer, (1 + ratio) / 2),
                        median_level(image, outer, ratio / 3)};
}

bool is_plausible(const InitialGuess& guess, const RoundelLimits& limits) {
    const double slack = limits.ratio_tolerance + 1 / guess.outer.minor;
    return limits.ratio_error(guess.ratio) < slack && guess.outer.major > 0.8 * limits.min_diameter &&
           guess.outer.major < 1.2 * limits.max_diameter && guess.outer.minor > 3 &&
           guess.bright - guess.dark > limits.min_contrast / 2;
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
