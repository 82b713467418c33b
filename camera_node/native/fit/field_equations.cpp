// SPDX-License-Identifier: BSD-3-Clause
#include "fit/field_equations.hpp"

#include <algorithm>

#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kScoreStep = 2;  // every second lane is enough for score tests

/// The columns of linear shading.
struct ShadingBasis {
    static constexpr int kSize = 2;
    ROUNDEL_INLINE void columns(const Lanes& x, const Lanes& y, const Lanes& level, const Lanes&,
                                Lanes* to) const {
        to[0] = level * x;
        to[1] = level * y;
    }
};

/// The columns of all fields. The card's edge does not count for a bend: cards are cut by hand.
struct FieldBasis {
    static constexpr int kSize = kFields;
    FieldPlane plane;
    ROUNDEL_INLINE void columns(const Lanes& x, const Lanes& y, const Lanes& level, const Lanes& ring,
                                Lanes* to) const {
        Lanes X = x, Y = y, f[kLightFields];
        plane.map(X, Y);
        functions_of_light(X, Y, f);
        for (int i = 0; i < kLightFields; ++i) {
            to[kLight + i] = level * f[i];
            to[kGloss + i] = f[i];
        }
        const Lanes by = -2.0f * ring * X * plane.stretch(X, Y);
        to[kBend] = by * f[2];
        to[kBend + 1] = by * f[3];
    }
};

/// Products of N further columns with those of the parameters and, last, with the residuals.
template <int N>
struct FurtherSums {
    Lanes by[N][kCount + 1], own[N][N];
};

/// Adds the products of two weighted columns with those from the j-th on, four at a time: eight sums that do
/// not depend on each other. The last column is that of the residuals.
template <Edge edge, int j>
ROUNDEL_INLINE void multiply_pair(const Lanes (*weighted)[kChunk], const Gradient& at, int count,
                                  Lanes (*sums)[kCount + 1]) {
    constexpr int all = kUnknowns<edge> + 1, n = std::min(4, all - j);
    const Lanes* columns[n];
    Lanes s[2][n];
    const auto target = [](int m) { return j + m < all - 1 ? int(kBy<edge>[size_t(j + m)]) : int(kCount); };
    for (int m = 0; m < n; ++m) {
        columns[m] = target(m) < kCount ? at.by[target(m)] : at.residual;
        s[0][m] = sums[0][target(m)], s[1][m] = sums[1][target(m)];
    }
    for (int k = 0; k < count; ++k)
        for (int m = 0; m < n; ++m)
            s[0][m] += weighted[0][k] * columns[m][k], s[1][m] += weighted[1][k] * columns[m][k];
    for (int m = 0; m < n; ++m) sums[0][target(m)] = s[0][m], sums[1][target(m)] = s[1][m];
    if constexpr (j + n < all) multiply_pair<edge, j + n>(weighted, at, count, sums);
}

/// A part's pixels: columns from its first one on.
struct PartPixels {
    const float *x, *y, *level;
    PartPixels(const EdgePixels& pixels, const LinearPart& part)
        : x(pixels.x + part.begin), y(pixels.y + part.begin), level(pixels.level + part.begin) {}
    ROUNDEL_INLINE void next_chunk() {
        x += kChunk * kLanes;
        y += kChunk * kLanes;
        level += kChunk * kLanes;
    }
};

template <Edge edge, typename Basis>
ROUNDEL_INLINE void add_products(const Gradient* chunks, int lanes, PartPixels at, const Basis& basis,
                                 const Weighting& weighting, FurtherSums<Basis::kSize>& sums) {
    constexpr int N = Basis::kSize;
    static_assert(N % 2 == 0);
    Lanes weighted[N][kChunk], columns[N];
    for (; lanes > 0; lanes -= kChunk, ++chunks) {
        const int count = std::min(kChunk, lanes);
        for (int k = 0; k < count; ++k, at.x += kLanes, at.y += kLanes, at.level += kLanes) {
            const Lanes residual = chunks->residual[k];
            const Lanes root = root_weight<edge>(*chunks, k, residual, weighting);
            basis.columns(load(at.x), load(at.y), shown(load(at.level)) - residual, chunks->ring[k], columns);
            for (int a = 0; a < N; ++a) {
                weighted[a][k] = root * root * columns[a];
                for (int b = 0; b <= a; ++b) sums.own[a][b] += weighted[a][k] * columns[b];
            }
        }
        for (int a = 0; a < N; a += 2) multiply_pair<edge, 0>(&weighted[a], *chunks, count, &sums.by[a]);
    }
}

ROUNDEL_CLONES void add_shading(const LinearPart& part, PartPixels at, const Weighting& weighting,
                                FurtherSums<2>& sums) {
    with_edge(part.edge, [&](auto e) __attribute__((always_inline)) {
        add_products<e>(part.chunks, part.lanes, at, ShadingBasis(), weighting, sums);
    });
}

ROUNDEL_CLONES void add_fields(const LinearPart& part, PartPixels at, const FieldBasis& basis,
                               const Weighting& weighting, FurtherSums<kFields>& sums) {
    with_edge(part.edge, [&](auto e) __attribute__((always_inline)) {
        add_products<e>(part.chunks, part.lanes, at, basis, weighting, sums);
    });
}

/// Transforms products with the columns of a part's gradient to those of all parameters.
Parameters to_parameters(const Lanes (&by)[kCount + 1], Edge edge, const EdgeEllipse::Jacobian& J) {
    Parameters to{};
    for (size_t i = 0; i < kCount; ++i) to[i] = double(sum(by[i]));
    if (edge == kAnyEdge) return to;
    const Parameters of_ellipse = to;
    for (int m = 0; m < kPoseCount; ++m) to[kX + m] = 0;
    for (int j = 0; j < EdgeEllipse::kShape; ++j) {
        for (int m = 0; m < kPoseCount; ++m) to[kX + m] += J[j][m] * of_ellipse[kX + j];
        if (edge != kOuterEdge)
            to[edge == kInnerEdge ? kRatio : kCard] += J[j][kPoseCount] * of_ellipse[kX + j];
    }
    return to;
}

template <int N>
void add_sums(const FurtherSums<N>& sums, const LinearPart& part, FurtherProducts<N>& to) {
    for (size_t a = 0; a < N; ++a) {
        const Parameters of_part = to_parameters(sums.by[a], part.edge, part.jacobian);
        for (size_t i = 0; i < kCount; ++i) to.parameters[a][i] += of_part[i];
        for (size_t b = 0; b <= a; ++b) to.own[a][b] += double(sum(sums.own[a][b]));
        to.residuals[a] += double(sum(sums.by[a][kCount]));
    }
}

struct ScoreSums {
    Lanes cos3, sin3, bend, cos2, sin2, light;
};

/// `delta` is a step of the parameters of the part's gradient.
ROUNDEL_CLONES void add_scores(const LinearPart& part, PartPixels at, const FieldPlane& plane,
                               const float* delta, const Weighting& weighting, ScoreSums& sums) {
    with_edge(part.edge, [&](auto e) __attribute__((always_inline)) {
        const Gradient* chunks = part.chunks;
        for (int lanes = part.lanes; lanes > 0; lanes -= kChunk, ++chunks, at.next_chunk())
            for (int k = 0; k < std::min(kChunk, lanes); k += kScoreStep) {
                Lanes r = chunks->residual[k];
                for (const int i : kBy<e>) r -= delta[i] * chunks->by[i][k];
                const Lanes root = root_weight(r * weighting.per_cut), w = root * root, wr = w * r;
                Lanes X = load(at.x + k * kLanes), Y = load(at.y + k * kLanes);
                plane.map(X, Y);
                const Lanes xx = X * X, yy = Y * Y, xy = X * Y, rr = xx + yy;
                const Lanes by = -chunks->ring[k] * plane.stretch(X, Y), by_r = wr * by;
                sums.cos3 += by_r * X * (xx - 3.0f * yy);
                sums.sin3 += by_r * Y * (3.0f * xx - yy);
                sums.bend += w * by * by * rr * rr * rr;
                const Bits card = plane.is_card(rr);
                const Lanes on_card = card ? wr : all(0), w_card = card ? w : all(0);
                sums.cos2 += on_card * (xx - yy);
                sums.sin2 += on_card * xy;
                sums.light += w_card * rr * rr;
            }
    });
}

double score(const Lanes& one, const Lanes& other, const Lanes& squared) {
    const double variance = double(sum(squared)) / 2;
    return variance > 0 ? (square(double(sum(one))) + square(double(sum(other)))) / variance : 0;
}

}  // namespace

FurtherProducts<2> shading_products(const NormalEquations& equations, const EdgePixels& pixels,
                                    const Weighting& weighting) {
    FurtherProducts<2> products;
    for (const LinearPart& part : equations.parts()) {
        FurtherSums<2> sums{};
        add_shading(part, {pixels, part}, weighting, sums);
        add_sums(sums, part, products);
    }
    return products;
}

FurtherProducts<kFields> field_products(const NormalEquations& equations, const EdgePixels& pixels,
                                        const FieldFrame& frame, const Weighting& weighting) {
    FurtherProducts<kFields> products;
    for (const LinearPart& part : equations.parts()) {
        FurtherSums<kFields> sums{};
        add_fields(part, {pixels, part}, {FieldPlane(frame)}, weighting, sums);
        add_sums(sums, part, products);
    }
    return products;
}

FieldScores score_fields(const NormalEquations& equations, const EdgePixels& pixels, const FieldFrame& frame,
                         const Parameters& step, const Weighting& weighting) {
    ScoreSums sums{};
    const FieldPlane plane(frame);
    for (const LinearPart& part : equations.parts())
        add_scores(part, {pixels, part}, plane, step_of(step, part.edge, part.jacobian).data(), weighting,
                   sums);
    return {score(sums.cos3, sums.sin3, sums.bend), score(sums.cos2, 2 * sums.sin2, sums.light),
            double(sum(sums.bend)) / 2};
}

}  // namespace roundel
