// SPDX-License-Identifier: BSD-3-Clause
#include "fit/normal_equations.hpp"

#include <algorithm>

#include "numeric/gram.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kSample = 24;    // approximate number of lanes of a sample
constexpr int kHalvings = 10;  // of the interval of 256 grey levels

template <Edge edge>
ROUNDEL_INLINE void evaluate_part(const EdgePixels& pixels, const EdgePixels::EdgePart& part,
                                  const ModelOf<edge>& model, Gradient* chunks) {
    for (int done = 0; done < part.count; done += kChunk * kLanes) {
        const int begin = part.begin + done;
        model.evaluate(pixels.x + begin, pixels.y + begin, pixels.level + begin,
                       std::min(kChunk, (part.count - done) / kLanes), *chunks++);
    }
}

ROUNDEL_CLONES void evaluate(const EdgePixels& pixels, const EdgePixels::EdgePart& part,
                             const Parameters& pose, Gradient* chunks) {
    with_edge(part.edge, [&](auto edge) __attribute__((always_inline)) {
        evaluate_part<edge>(pixels, part, ModelOf<edge>(pose), chunks);
    });
}

template <Edge edge>
ROUNDEL_INLINE void add_products(const Gradient* chunks, int lanes, const Weighting& by, GramOf<edge>& gram) {
    constexpr int n = kUnknowns<edge>;
    Columns<n + 1> columns;
    for (; lanes > 0; lanes -= kChunk, ++chunks) {
        const int count = std::min(kChunk, lanes);
        for (int k = 0; k < count; ++k) {
            const Lanes root = root_weight<edge>(*chunks, k, chunks->residual[k], by);
            for (int i = 0; i < n; ++i) columns[i][k] = root * chunks->by[kBy<edge>[size_t(i)]][k];
            columns[n][k] = root * chunks->residual[k];
        }
        multiply_all<n + 1>(columns, count, gram);
    }
}

ROUNDEL_INLINE void add_sums(const GramOf<kAnyEdge>& gram, GaussNewtonSystem<kCount>& to) {
    for (int i = 0; i < kCount; ++i) {
        for (int j = 0; j <= i; ++j) to.H[i][j] += double(sum(gram[j][i]));
        to.g[i] += double(sum(gram[i][kCount]));
    }
}

/// Adds the products of a single edge's columns, transformed to the parameters on which its ellipse depends.
template <Edge edge>
ROUNDEL_INLINE void add_transformed(const GramOf<edge>& gram, const EdgeEllipse::Jacobian& J,
                                    GaussNewtonSystem<kCount>& to) {
    constexpr int n = kUnknowns<edge>, shape = EdgeEllipse::kShape, kRadius = kPoseCount;
    constexpr Parameter radius = edge == kCardEdge ? kCard : kRatio;
    const auto product = [&](int i, int j) { return double(sum(gram[std::min(i, j)][std::max(i, j)])); };
    std::array<EdgeEllipse::Row, n + 1> once{};  // products of the columns with those of pose and radius
    for (int i = 0; i <= n; ++i)
        for (int j = 0; j < shape; ++j) {
            const double each = product(i, kLevels + j);
            for (int m = 0; m <= kRadius; ++m) once[i][m] += each * J[j][m];
        }
    std::array<EdgeEllipse::Row, kRadius + 1> twice{};
    for (int m = 0; m <= kRadius; ++m)
        for (int j = 0; j < shape; ++j)
            for (int k = 0; k <= kRadius; ++k) twice[m][k] += J[j][m] * once[kLevels + j][k];
    for (int i = 0; i < kLevels; ++i) {
        const Parameter level = kBy<edge>[size_t(i)];
        for (int j = i; j < kLevels; ++j) {
            const Parameter other = kBy<edge>[size_t(j)];
            to.H[std::max(level, other)][std::min(level, other)] += product(i, j);
        }
        for (int m = 0; m < kPoseCount; ++m) to.H[kX + m][level] += once[i][m];
        to.H[radius][level] += once[i][kRadius];
        to.g[level] += product(i, n);
    }
    for (int m = 0; m < kPoseCount; ++m) {
        for (int k = 0; k <= m; ++k) to.H[kX + m][kX + k] += twice[m][k];
        to.H[kX + m][radius] += twice[m][kRadius];
        to.g[kX + m] += once[n][m];
    }
    to.H[radius][radius] += twice[kRadius][kRadius];
    to.g[radius] += once[n][kRadius];
}

ROUNDEL_CLONES void add_part(const Gradient* chunks, int lanes, Edge edge, const EdgeEllipse::Jacobian& J,
                             const Weighting& by, GaussNewtonSystem<kCount>& to) {
    with_edge(edge, [&](auto e) __attribute__((always_inline)) {
        GramOf<e> gram{};
        add_products<e>(chunks, lanes, by, gram);
        if constexpr (e == kAnyEdge)
            add_sums(gram, to);
        else
            add_transformed<e>(gram, J, to);
    });
}

struct LaneResidualSums {
    Lanes ring, agreeing, ring_rr, m, mm, mrr, mwrr, mpsi, ground, ground_rr, ground_ground;
};

template <Edge edge>
ROUNDEL_INLINE void add_residuals(const Lanes& r, const Gradient& at, int k, const Weighting& by,
                                  LaneResidualSums& sums) {
    const Lanes t = r * by.per_cut, root = root_weight(t), w = root * root, rr = r * r;
    const Lanes squared =
        (at.by[kX][k] * at.by[kX][k] + at.by[kY][k] * at.by[kY][k]) * ground_weight<edge>(at, k, by.spread);
    const Lanes ring = at.residual[k] < kAbsent ? at.ring[k] * at.ring[k] : all(0), m = w * squared;
    sums.ring += ring;
    sums.agreeing += w * ring;
    sums.ring_rr += ring * rr;
    sums.m += m;
    sums.mm += m * squared;
    sums.mrr += m * rr;
    sums.mwrr += m * w * rr;
    sums.mpsi += squared * root * (1.0f - 5.0f * t * t);
    if constexpr (edge == kOuterEdge || edge == kInnerEdge) return;
    const Lanes share = at.residual[k] < kAbsent ? at.by[kGround][k] : all(0), gg = share * share;
    sums.ground += gg;
    sums.ground_rr += gg * rr;
    sums.ground_ground += gg * gg;
}

/// `delta` is a step of the parameters of the part's gradient.
ROUNDEL_CLONES void add_residual_sums(const Gradient* chunks, int lanes, Edge edge, const float* delta,
                                      const Weighting& by, LaneResidualSums& sums) {
    with_edge(edge, [&](auto e) __attribute__((always_inline)) {
        for (; lanes > 0; lanes -= kChunk, ++chunks)
            for (int k = 0; k < std::min(kChunk, lanes); ++k) {
                Lanes r = chunks->residual[k];
                for (const int i : kBy<e>) r -= delta[i] * chunks->by[i][k];
                add_residuals<e>(r, *chunks, k, by, sums);
            }
    });
}

ROUNDEL_INLINE int count_below(const Lanes* values, int n, float limit) {
    Bits below{};
    for (int k = 0; k < n; ++k) below -= values[k] < limit;
    int count = 0;
    for (int i = 0; i < kLanes; ++i) count += below[i];
    return count;
}

/// Residuals and slopes of the ring's edges in some lanes.
struct Sample {
    Lanes residuals[kSample + kEdges], slopes[kSample + kEdges], most{};
    int n = 0;
};

ROUNDEL_INLINE void add_every(int step, const Gradient* chunks, int lanes, Sample& to) {
    for (int k = 0; k < lanes; k += step, ++to.n) {
        const Gradient& at = chunks[k / kChunk];
        const Lanes residual = magnitude(at.residual[k % kChunk]), slope = magnitude(at.ring[k % kChunk]);
        to.residuals[to.n] = residual;
        to.slopes[to.n] = slope;
        const Lanes seen = residual < kAbsent ? slope : all(0);
        to.most = seen > to.most ? seen : to.most;
    }
}

/// Finds the median by halving an interval (see NormalEquations::median_residual).
ROUNDEL_CLONES float median_of(std::span<const LinearPart> parts) {
    int lanes = 0;
    for (const LinearPart& part : parts) lanes += part.lanes;
    Sample sample;
    for (const LinearPart& part : parts)
        add_every((lanes + kSample - 1) / kSample, part.chunks, part.lanes, sample);
    auto& [residuals, slopes, most, n] = sample;
    float steep = 1e-3f;
    for (int i = 0; i < kLanes; ++i) steep = std::max(steep, most[i] / 2);
    for (int k = 0; k < n; ++k) residuals[k] = slopes[k] > steep ? residuals[k] : all(kAbsent);
    const int count = count_below(residuals, n, kAbsent);
    if (count < kLanes) return -1;
    float low = 0, high = 256;
    for (int k = 0; k < kHalvings; ++k) {
        const float middle = (low + high) / 2;
        (2 * count_below(residuals, n, middle) > count ? high : low) = middle;
    }
    return high;
}

}  // namespace

void NormalEquations::linearize(const EdgePixels& pixels, const Parameters& p) {
    part_count_ = pixels.part_count;
    Gradient* chunks = chunks_;
    for (int k = 0; k < part_count_; ++k) {
        const EdgePixels::EdgePart& from = pixels.parts[size_t(k)];
        LinearPart& part = parts_[size_t(k)];
        part.edge = from.edge;
        part.lanes = from.count / kLanes;
        part.begin = from.begin;
        part.chunks = chunks;
        if (part.edge == kAnyEdge) {
            evaluate(pixels, from, p, chunks);
        } else {
            const EdgeEllipse ellipse(p, part.edge);
            evaluate(pixels, from, ellipse.as_pose(), chunks);
            part.jacobian = ellipse.jacobian();
        }
        chunks += (part.lanes + kChunk - 1) / kChunk;
    }
}

double NormalEquations::median_residual() const { return double(median_of(parts())); }

GaussNewtonSystem<kCount> NormalEquations::accumulate(const Weighting& by) const {
    GaussNewtonSystem<kCount> system{};
    for (const LinearPart& part : parts())
        add_part(part.chunks, part.lanes, part.edge, part.jacobian, by, system);
    return system;
}

ResidualSums NormalEquations::residuals_after(const Parameters& delta, const Weighting& by) const {
    LaneResidualSums s{};
    for (const LinearPart& part : parts())
        add_residual_sums(part.chunks, part.lanes, part.edge, step_of(delta, part.edge, part.jacobian).data(),
                          by, s);
    return {.ring = double(sum(s.ring)),
            .agreeing = double(sum(s.agreeing)),
            .ring_rr = double(sum(s.ring_rr)),
            .m = double(sum(s.m)),
            .mm = double(sum(s.mm)),
            .mrr = double(sum(s.mrr)),
            .mwrr = double(sum(s.mwrr)),
            .mpsi = double(sum(s.mpsi)),
            .ground = double(sum(s.ground)),
            .ground_rr = double(sum(s.ground_rr)),
            .ground_ground = double(sum(s.ground_ground))};
}

}  // namespace roundel
