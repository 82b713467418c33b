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

constexpr int kLeast = 9;  // rays of each kind that must agree: what 30 % of a disc covered leaves
constexpr int kLeastOfHalf = 14, kLeastCovered = 6;
// Ratios of rays that nothing covers are less apart, from half a radius off the middle.
constexpr float kUnlike = 0.35f;
constexpr int kCasts = 2;           // at most; again where the middle or theta was far off
constexpr int kReweights = 4;       // at most, where crossings disagree
constexpr double kRelative = 0.05;  // of the radius that a crossing may be off its ellipse, and
constexpr double kAbsolute = 0.5;   // so many pixels

/// Where rays cross the edge of the disc or of the hole in it, from the rays' origin, in units of `unit`
/// pixels, as columns; those beyond `count` are 0.
struct Crossings {
    static constexpr int kMost = 2 * kRays;
    explicit Crossings(double length) : unit(length) {}
    alignas(4 * kLanes) float x[kMost]{}, y[kMost]{}, inner[kMost]{};  // inner is 1 or 0
    float ratio[kMost]{};  // of the ray's inner distance to its outer one; 0 where it has one only
    int ray[kMost]{}, count = 0;
    uint16_t seen[2]{};  // a bit a ray: which cross the disc's edge, and the hole's
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

/// Least and most of inner over outer distance on a ray from near the middle.
struct Ratios {
    double least, most;
};

Ratios ratios_near_middle(const Settings& settings) {
    const auto [low, high] = settings.ratio_range();
    const double slack = settings.ratio_tolerance + 0.1;  // a quarter of a radius off the middle
    return {std::max(0.1, low - slack), std::min(0.95, high + slack)};
}

/// Diagonals first, then what lies between: with the chords along row and column, few rays tell early that
/// nothing is there.
constexpr std::array<int, kRays> kOrder{2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15, 0, 8, 4, 12};

struct Weights {
    alignas(4 * kLanes) float at[Crossings::kMost]{};
};

/// A ray's number, and the pixels at which it leaves the disc and the ring; below 0 where it does not.
struct Walk {
    int number, inner, outer;
};

/// Where rays cross, between pixels; nothing where too few do, which whole pixels tell.
Crossings cast(const ImageView& image, const Seed& seed, const Ratios& ratios) {
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
    if (crossed < 2 * kLeastCovered + 2) return crossings;
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

/// The weight of what is off by so many scales (Geman and McClure).
template <typename T>
ROUNDEL_INLINE T redescend(const T& off) {
    const T inverse = 1.0f / (1.0f + off * off);
    return inverse * inverse;
}

/// Two ellipses of one centre and shape: p^T M p + v p = 1 is the outer one and = level the inner one.
struct Conics {
    double a, b, c, d, e, level;
    double at(double x, double y) const { return a * x * x + b * x * y + c * y * y + d * x + e * y; }
    double middle_x() const { return (b * e - 2 * c * d) / (4 * a * c - b * b); }
    double middle_y() const { return (b * d - 2 * a * e) / (4 * a * c - b * b); }
    bool are_ellipses() const { return a > 0 && 4 * a * c > b * b; }
};

/// Normal equations of linear least squares, each crossing with its weight.
struct Equations {
    std::array<Vector<6>, 6> H;  // its lower triangle
    Vector<6> g;
};

ROUNDEL_CLONES void accumulate(const Crossings& crossings, const Weights& weights, Equations& equations) {
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
    Equations equations;
    accumulate(crossings, weights, equations);
    const Cholesky<6> factor(equations.H);
    if (!factor.positive()) return std::nullopt;
    const Vector<6> s = factor.solve(equations.g);
    const Conics conics{s[0], s[1], s[2], s[3], s[4], s[5]};
    return conics.are_ellipses() ? std::optional(conics) : std::nullopt;
}

/// The conics' own frame: their middle, and the form's values there and on both ellipses.
struct Frame {
    double x, y, outer, inner;
    explicit Frame(const Conics& c) : x(c.middle_x()), y(c.middle_y()) {
        const double least = c.at(x, y);  // negative
        outer = 1 - least, inner = c.level - least;
    }
    bool is_valid() const { return inner > 0 && inner < outer; }
};

/// How far each crossing is from its ellipse, in what it may be; beyond the last one 0.
struct Distances {
    alignas(4 * kLanes) float off[Crossings::kMost];
};

ROUNDEL_CLONES void measure(const Crossings& crossings, const Conics& c, const Frame& frame, Distances& to) {
    const float a = float(c.a), b = float(c.b), cc = float(c.c);
    const float per_outer = float(1 / frame.outer), per_inner = float(1 / frame.inner);
    const float absolute = float(kAbsolute / crossings.unit);
    for (int k = 0; k < crossings.count; k += kLanes) {
        const Lanes dx = load(crossings.x + k) - float(frame.x), dy = load(crossings.y + k) - float(frame.y);
        const Lanes inner = load(crossings.inner + k), square = dx * dx + dy * dy + 1e-12f;
        const Lanes radius = square * inverse_sqrt(square);
        const Lanes form = dx * (a * dx + b * dy) + cc * dy * dy;  // 1 on either ellipse, times its size
        const Lanes share = form * (inner > 0.5f ? all(per_inner) : all(per_outer)) + 1e-12f;
        const Lanes off = radius * (share * inverse_sqrt(share) - 1.0f);
        store(to.off + k, off / (float(kRelative) * radius + absolute));
    }
}

/// Weights by distance from the ellipses; returns how many crossings agree, of the kind of which fewer do.
int reweigh(const Crossings& crossings, const Conics& conics, Weights& weights) {
    const Frame frame(conics);
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

/// Weights to begin with: from near the middle, rays that nothing covers have about the same ratio.
Weights weigh(const Crossings& crossings) {
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

/// Solves and weighs anew from some weights on, until ever more crossings agree and at last `least`.
std::optional<Conics> settle(const Crossings& crossings, const Weights& first, int least) {
    Weights weights = first;
    std::optional<Conics> conics;
    for (int k = 0, agree = 0; k < kReweights && 2 * agree < crossings.count; ++k) {
        conics = solve(crossings, weights);
        if (!conics || !Frame(*conics).is_valid()) return std::nullopt;
        agree = reweigh(crossings, *conics, weights);
        if (agree < least - kReweights + 1 + k) return std::nullopt;
    }
    return conics;
}

/// The rays, a bit each, of which something may have left whole: half of them side by side, or a quarter on
/// either side of a strip through the middle.
constexpr std::array<uint16_t, 12> kWhole = [] {
    std::array<uint16_t, 12> whole{};
    for (int first = 0; first < kRays; first += 2)
        for (int k = 0; k < kRays / 2; ++k) whole[size_t(first / 2)] |= uint16_t(1 << (first + k) % kRays);
    for (int first = 0; first < kRays / 2; first += 2)
        for (int k = 0; k < kRays / 4; ++k)
            for (const int side : {0, kRays / 2})
                whole[size_t(kRays + first) / 2] |= uint16_t(1 << (first + k + side) % kRays);
    return whole;
}();

/// How far apart the ratios of such rays are.
float most_apart(const Crossings& crossings, uint16_t rays) {
    float least = 1, most = 0;
    for (int k = 0; k < crossings.count; ++k)
        if (crossings.ratio[k] > 0 && rays >> crossings.ray[k] & 1)
            least = std::min(least, crossings.ratio[k]), most = std::max(most, crossings.ratio[k]);
    return most - least;
}

/// From those rays' crossings with which most of all agree.
std::optional<Conics> settle_covered(const Crossings& crossings) {
    int most = kLeastCovered - kReweights;  // what no less would do
    std::optional<Weights> best;
    for (const uint16_t whole : kWhole) {
        if (crossings.count_of(whole) < kLeastOfHalf || most_apart(crossings, whole) > kUnlike) continue;
        Weights weights;
        for (int k = 0; k < crossings.count; ++k) weights.at[k] = float(whole >> crossings.ray[k] & 1);
        const auto conics = solve(crossings, weights);
        if (!conics || !Frame(*conics).is_valid()) continue;
        if (const int agree = reweigh(crossings, *conics, weights); agree > most)
            most = agree, best = weights;
    }
    return best ? settle(crossings, *best, kLeastCovered) : std::nullopt;
}

Ellipse outer_ellipse(const Conics& c, const Frame& frame, double unit) {
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

}  // namespace

std::optional<Start> fit_circles(const ImageView& image, const Seed& seed, const Settings& settings) {
    const Ratios ratios = ratios_near_middle(settings);
    Seed from = seed;
    std::optional<Start> start;
    for (int k = 0; k < kCasts; ++k) {
        const Crossings crossings = cast(image, from, ratios);
        if (crossings.count < 2 * kLeastCovered + 2) return std::nullopt;
        auto conics =
            crossings.count < 2 * kLeast ? std::nullopt : settle(crossings, weigh(crossings), kLeast);
        if (!conics) conics = settle_covered(crossings);
        if (!conics) return std::nullopt;
        const Frame frame(*conics);
        Ellipse outer = outer_ellipse(*conics, frame, crossings.unit);
        const double ratio = std::sqrt(frame.inner / frame.outer), moved = std::hypot(outer.x, outer.y);
        if (!(moved < outer.major)) return std::nullopt;
        outer.x += double(from.x), outer.y += double(from.y);
        const double m_d = median_level(image, outer, (1 + ratio) / 2);
        const double m_b = median_level(image, outer, ratio / 3);
        start = Start{outer, ratio, m_d, m_b};
        const double theta = double(from.dark + from.bright) / 2;
        if (moved < 0.1 * outer.minor && std::abs((m_d + m_b) / 2 - theta) < 0.1 * (m_b - m_d)) break;
        from = {float(outer.x), float(outer.y), float(outer.major), int(m_d), int(m_b)};
    }
    const double slack = settings.ratio_tolerance + 1 / start->outer.minor;
    const bool ratio = settings.ratio_error(start->ratio) < slack;
    const bool size = start->outer.major > 0.8 * settings.min_diameter &&
                      start->outer.major < 1.2 * settings.max_diameter && start->outer.minor > 3;
    return ratio && size && start->bright - start->dark > settings.min_contrast / 2 ? start : std::nullopt;
}

}  // namespace roundel
