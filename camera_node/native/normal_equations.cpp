// SPDX-License-Identifier: BSD-3-Clause
#include "normal_equations.hpp"

#include <algorithm>

#include "gram.hpp"
#include "simd.hpp"

namespace roundel {

namespace {

constexpr int kColumns = kCount + 1;  // the gradient and the residual
constexpr int kSample = 24;           // lanes
constexpr int kHalvings = 10;         // of 256 grey levels

/// The root of Tukey's weight of residuals that are `t` cuts.
ROUNDEL_INLINE Lanes root_weight(const Lanes& t) {
    const Lanes left = 1.0f - t * t;
    return left > 0.0f ? left : all(0);
}

ROUNDEL_CLONES void evaluate_all(const EdgePixels& pixels, const Model& model, Gradient* chunks) {
    for (int begin = 0; begin < pixels.count; begin += kChunk * kLanes)
        model.evaluate(pixels.x + begin, pixels.y + begin, pixels.level + begin,
                       std::min(kChunk, (pixels.count - begin) / kLanes), *chunks++);
}

ROUNDEL_CLONES void add_up(const Gradient* chunks, int lanes, float per_cut, Gram<kColumns>& gram) {
    Columns<kColumns> columns;
    for (; lanes > 0; lanes -= kChunk, ++chunks) {
        const int count = std::min(kChunk, lanes);
        for (int k = 0; k < count; ++k) {
            const Lanes root = root_weight(chunks->residual[k] * per_cut);
            for (int i = 0; i < kCount; ++i) columns[i][k] = root * chunks->by[i][k];
            columns[kCount][k] = root * chunks->residual[k];
        }
        multiply_all<kColumns>(columns, count, gram);
    }
}

struct Sums {
    Lanes ring, agreeing, ring_rr, m, mm, mrr, mwrr, mpsi;
};

ROUNDEL_INLINE void add_residuals(const Lanes& r, const Gradient& at, int k, float per_cut, Sums& sums) {
    const Lanes t = r * per_cut, root = root_weight(t), w = root * root, rr = r * r;
    const Lanes squared = at.by[kX][k] * at.by[kX][k] + at.by[kY][k] * at.by[kY][k];
    const Lanes ring = at.residual[k] < kAbsent ? at.ring[k] * at.ring[k] : all(0), m = w * squared;
    sums.ring += ring;
    sums.agreeing += w * ring;
    sums.ring_rr += ring * rr;
    sums.m += m;
    sums.mm += m * squared;
    sums.mrr += m * rr;
    sums.mwrr += m * w * rr;
    sums.mpsi += squared * root * (1.0f - 5.0f * t * t);
}

ROUNDEL_CLONES void add_leftover(const Gradient* chunks, int lanes, const float* delta, float per_cut,
                                 Sums& sums) {
    for (; lanes > 0; lanes -= kChunk, ++chunks)
        for (int k = 0; k < std::min(kChunk, lanes); ++k) {
            Lanes r = chunks->residual[k];
            for (int i = 0; i < kCount; ++i) r -= delta[i] * chunks->by[i][k];
            add_residuals(r, *chunks, k, per_cut, sums);
        }
}

ROUNDEL_INLINE int count_below(const Lanes* values, int n, float limit) {
    Bits below{};
    for (int k = 0; k < n; ++k) below -= values[k] < limit;
    int count = 0;
    for (int i = 0; i < kLanes; ++i) count += below[i];
    return count;
}

/// As Linearisation::median_residual, by halving an interval.
ROUNDEL_CLONES float median_of(const Gradient* chunks, int lanes) {
    Lanes residuals[kSample], slopes[kSample], most{};
    const int step = (lanes + kSample - 1) / kSample;
    int n = 0;
    for (int k = 0; k < lanes; k += step, ++n) {
        const Gradient& at = chunks[k / kChunk];
        residuals[n] = magnitude(at.residual[k % kChunk]), slopes[n] = magnitude(at.ring[k % kChunk]);
        const Lanes slope = residuals[n] < kAbsent ? slopes[n] : all(0);
        most = slope > most ? slope : most;
    }
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

void Linearisation::evaluate(const EdgePixels& pixels, const Parameters& p) {
    count_ = pixels.count / kLanes;
    evaluate_all(pixels, Model(p), chunks_);
}

double Linearisation::median_residual() const { return double(median_of(chunks_, count_)); }

NormalEquations Linearisation::accumulate(double scale) const {
    Gram<kColumns> gram{};
    add_up(chunks_, count_, float(1 / (kTukey * scale)), gram);
    NormalEquations e;
    for (int i = 0; i < kCount; ++i) {
        for (int j = 0; j <= i; ++j) e.H[i][j] = double(sum(gram[j][i]));
        e.g[i] = double(sum(gram[i][kCount]));
    }
    return e;
}

Leftover Linearisation::after(const Parameters& delta, double scale) const {
    float step[kCount];
    for (int i = 0; i < kCount; ++i) step[i] = float(delta[i]);
    Sums s{};
    add_leftover(chunks_, count_, step, float(1 / (kTukey * scale)), s);
    return {.ring = double(sum(s.ring)),
            .agreeing = double(sum(s.agreeing)),
            .ring_rr = double(sum(s.ring_rr)),
            .m = double(sum(s.m)),
            .mm = double(sum(s.mm)),
            .mrr = double(sum(s.mrr)),
            .mwrr = double(sum(s.mwrr)),
            .mpsi = double(sum(s.mpsi))};
}

}  // namespace roundel
