// SPDX-License-Identifier: BSD-3-Clause
#include "search/conic_fit.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>

#include "numeric/cholesky.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kMinAgree = 9;              // crossings of each circle: 30 % of the disc may be occluded
constexpr int kMinAgreeOccluded = 6;      // on the rays of an unoccluded part,
constexpr int kMinOfPart = 14;            // of which so many cross
constexpr float kMaxRatioSpread = 0.35f;  // of unoccluded rays from within half a radius of the centre
constexpr int kMaxReweights = 4;
constexpr double kRelative = 0.05;  // distance of an agreeing crossing from its ellipse, radii, and
constexpr double kAbsolute = 0.5;   // pixels

struct CrossingWeights {
    alignas(4 * kLanes) float at[Crossings::kMost]{};
};

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

ROUNDEL_CLONES void accumulate(const Crossings& crossings, const CrossingWeights& weights,
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

std::optional<Conics> solve(const Crossings& crossings, const CrossingWeights& weights) {
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
        outer = 1 - least;
        inner = c.level - least;
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
int reweigh(const Crossings& crossings, const Conics& conics, CrossingWeights& weights) {
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
CrossingWeights initial_weights(const Crossings& crossings) {
    std::array<float, kRays> ratios;
    int n = 0;
    for (int k = 0; k < crossings.count; ++k)
        if (crossings.inner[k] == 0) ratios[size_t(n++)] = crossings.ratio[k];
    std::nth_element(ratios.begin(), ratios.begin() + n / 2, ratios.begin() + n);
    CrossingWeights weights;
    for (int k = 0; k < crossings.count; ++k)
        weights.at[k] = redescend((crossings.ratio[k] - ratios[size_t(n / 2)]) * 10);
    return weights;
}

/// Iteratively reweighted least squares. The number of crossings that agree must grow in each iteration, to
/// at least `least`.
std::optional<Conics> iterate(const Crossings& crossings, const CrossingWeights& first, int least) {
    CrossingWeights weights = first;
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
    for (unsigned left = rays & crossings.seen[0] & crossings.seen[1]; left; left &= left - 1) {
        const float ratio = crossings.ratio_of[std::countr_zero(left)];
        least = std::min(least, ratio);
        most = std::max(most, ratio);
    }
    return most - least;
}

/// Starts from the visible part whose ellipses agree with the most crossings.
std::optional<Conics> fit_visible_part(const Crossings& crossings) {
    int most = kMinAgreeOccluded - kMaxReweights;  // fewer would not pass `iterate`
    std::optional<CrossingWeights> best;
    for (const uint16_t part : kVisibleParts) {
        if (crossings.count_of(part) < kMinOfPart || ratio_spread(crossings, part) > kMaxRatioSpread)
            continue;
        CrossingWeights weights;
        for (int k = 0; k < crossings.count; ++k) weights.at[k] = float(part >> crossings.ray[k] & 1);
        const auto conics = solve(crossings, weights);
        if (!conics || !ConicFrame(*conics).is_valid()) continue;
        if (const int agree = reweigh(crossings, *conics, weights); agree > most) {
            most = agree;
            best = weights;
        }
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

std::optional<Conics> fit_conics(const Crossings& crossings) {
    if (crossings.count < kMinCrossings) return std::nullopt;
    auto conics = crossings.count < 2 * kMinAgree ? std::nullopt
                                                  : iterate(crossings, initial_weights(crossings), kMinAgree);
    return conics ? conics : fit_visible_part(crossings);
}

}  // namespace

std::optional<CirclePair> fit_ellipses(const Crossings& crossings) {
    const auto conics = fit_conics(crossings);
    if (!conics) return std::nullopt;
    const ConicFrame frame(*conics);
    return CirclePair{outer_ellipse(*conics, frame, crossings.unit), std::sqrt(frame.inner / frame.outer)};
}

}  // namespace roundel
