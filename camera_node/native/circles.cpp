// SPDX-License-Identifier: BSD-3-Clause
#include "circles.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "cholesky.hpp"
#include "ray.hpp"

namespace roundel {

namespace {

constexpr int kLeast = 9;  // rays of each kind that must agree: what 30 % of a disc covered leaves
constexpr int kLeastOfHalf = 14, kLeastCovered = 6;
constexpr int kCasts = 2;           // at most; again where the middle or theta was far off
constexpr int kReweights = 4;       // at most, where crossings disagree
constexpr double kRelative = 0.05;  // of the radius that a crossing may be off its ellipse, and
constexpr double kAbsolute = 0.5;   // so many pixels

/// Where a ray crosses the edge of the disc or of the hole in it, from the ray's origin.
struct Crossing {
    double x, y;
    bool outer;
    float ratio;  // of the ray's inner distance to its outer one; 0 where it has one only
    int ray;
};

struct Crossings {
    std::array<Crossing, 2 * kRays> list;
    int count = 0;
    void add(int ray, double at, bool outer, float ratio) {
        const Direction direction = kDirections[size_t(ray)];
        list[size_t(count++)] = {at * double(direction.x), at * double(direction.y), outer, ratio, ray};
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

using Weights = std::array<double, 2 * kRays>;

Crossings cast(const ImageView& image, const Seed& seed, const Ratios& ratios) {
    const float theta = float(seed.dark + seed.bright) / 2;
    Crossings crossings;
    int missed = 0;
    for (int k = 0; k < kRays && missed <= 2 + k / 3; ++k) {
        const int number = kOrder[size_t(k)];
        Ray ray(image, seed.x, seed.y, kDirections[size_t(number)]);
        const float inner = ray.turn(true, theta, seed.reach);
        const float outer = inner < 0 ? -1 : ray.turn(false, theta, inner / float(ratios.least) + 2);
        const bool both = outer >= 0 && double(inner) < ratios.most * double(outer) + 1;
        const float ratio = both ? inner / outer : 0;
        if (inner >= 0) crossings.add(number, double(inner), false, ratio);
        if (both) crossings.add(number, double(outer), true, ratio);
        missed += !both;
    }
    return crossings;
}

/// The weight of what is off by so many scales (Geman and McClure).
double redescend(double off) { return 1 / ((1 + off * off) * (1 + off * off)); }

/// Two ellipses of one centre and shape: p^T M p + v p = 1 is the outer one and = level the inner one.
struct Conics {
    double a, b, c, d, e, level;
    double at(double x, double y) const { return a * x * x + b * x * y + c * y * y + d * x + e * y; }
    double middle_x() const { return (b * e - 2 * c * d) / (4 * a * c - b * b); }
    double middle_y() const { return (b * d - 2 * a * e) / (4 * a * c - b * b); }
    bool are_ellipses() const { return a > 0 && 4 * a * c > b * b; }
};

/// Linear least squares, each crossing with its weight.
std::optional<Conics> solve(const Crossings& crossings, const Weights& weights) {
    std::array<Vector<6>, 6> H{};
    Vector<6> g{};
    for (int k = 0; k < crossings.count; ++k) {
        const Crossing& p = crossings.list[size_t(k)];
        const Vector<6> row{p.x * p.x, p.x * p.y, p.y * p.y, p.x, p.y, p.outer ? 0.0 : -1.0};
        const double w = weights[size_t(k)];
        for (int i = 0; i < 6; ++i) {
            for (int j = 0; j <= i; ++j) H[i][j] += w * row[i] * row[j];
            g[i] += p.outer ? w * row[i] : 0;
        }
    }
    const Cholesky<6> factor(H);
    if (!factor.positive()) return std::nullopt;
    const Vector<6> s = factor.solve(g);
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

/// Weights by distance from the ellipses; returns how many crossings agree, of the kind of which fewer do.
int reweigh(const Crossings& crossings, const Conics& conics, Weights& weights) {
    const Frame frame(conics);
    int agree[2] = {0, 0};
    for (int k = 0; k < crossings.count; ++k) {
        const Crossing& p = crossings.list[size_t(k)];
        const double dx = p.x - frame.x, dy = p.y - frame.y, radius = std::sqrt(dx * dx + dy * dy);
        const double share = (conics.at(p.x, p.y) - 1 + frame.outer) / (p.outer ? frame.outer : frame.inner);
        const double off = radius * (std::sqrt(std::max(share, 0.0)) - 1) / (kRelative * radius + kAbsolute);
        agree[p.outer] += std::abs(off) < 1;
        weights[size_t(k)] = redescend(2 * off) / (p.outer ? 1 : frame.inner / frame.outer);
    }
    return std::min(agree[0], agree[1]);
}

/// Weights to begin with: from near the middle, rays that nothing covers have about the same ratio.
Weights weigh(const Crossings& crossings) {
    std::array<float, 2 * kRays> ratios;
    int n = 0;
    for (int k = 0; k < crossings.count; ++k)
        if (const Crossing& p = crossings.list[size_t(k)]; p.outer) ratios[size_t(n++)] = p.ratio;
    std::nth_element(ratios.begin(), ratios.begin() + n / 2, ratios.begin() + n);
    Weights weights;
    for (int k = 0; k < crossings.count; ++k)
        weights[size_t(k)] = redescend(double(crossings.list[size_t(k)].ratio - ratios[size_t(n / 2)]) / 0.1);
    return weights;
}

/// Solves and weighs anew from some weights on, until ever more crossings agree and at last `least`.
std::optional<Conics> settle(const Crossings& crossings, Weights weights, int least) {
    std::optional<Conics> conics;
    for (int k = 0, agree = 0; k < kReweights && 2 * agree < crossings.count; ++k) {
        conics = solve(crossings, weights);
        if (!conics || !Frame(*conics).is_valid()) return std::nullopt;
        agree = reweigh(crossings, *conics, weights);
        if (agree < least - kReweights + 1 + k) return std::nullopt;
    }
    return conics;
}

/// Of the crossings on half of the rays, side by side, those with which most agree: something covers the
/// rest.
std::optional<Conics> settle_half(const Crossings& crossings) {
    int most = 0;
    Weights best{};
    for (int first = 0; first < kRays; first += 2) {
        Weights weights;
        int n = 0;
        for (int k = 0; k < crossings.count; ++k) {
            const bool in = (crossings.list[size_t(k)].ray - first + kRays) % kRays < kRays / 2;
            weights[size_t(k)] = in, n += in;
        }
        if (n < kLeastOfHalf) continue;
        const auto conics = solve(crossings, weights);
        if (!conics || !Frame(*conics).is_valid()) continue;
        if (const int agree = reweigh(crossings, *conics, weights); agree > most)
            most = agree, best = weights;
    }
    return most ? settle(crossings, best, kLeastCovered) : std::nullopt;
}

Ellipse outer_ellipse(const Conics& c, const Frame& frame) {
    const double det = c.a * c.c - c.b * c.b / 4;
    const Eigen e = eigen({c.c / det, -c.b / 2 / det, c.a / det});  // of M^-1
    return {frame.x, frame.y, 2 * std::sqrt(frame.outer * e.first), 2 * std::sqrt(frame.outer * e.second),
            e.angle};
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
        if (!conics) conics = settle_half(crossings);
        if (!conics) return std::nullopt;
        const Frame frame(*conics);
        Ellipse outer = outer_ellipse(*conics, frame);
        const double ratio = std::sqrt(frame.inner / frame.outer), moved = std::hypot(frame.x, frame.y);
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
