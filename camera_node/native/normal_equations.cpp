// SPDX-License-Identifier: BSD-3-Clause
#include "normal_equations.hpp"

#include <algorithm>

#include "simd.hpp"

namespace roundel {

namespace {

constexpr int kColumns = kCount + 1;  // the gradient and the residual
constexpr int kHigh = 2, kWide = 4;   // products of so many columns stay in registers

struct Sums {
    Lanes gram[kColumns][kColumns];
    Lanes w, ring, ring_rr, agreeing, m, mm, mrr, mwrr, mpsi;
};

using Columns = Lanes[kColumns][kChunk];

/// Products of columns i .. i + m with columns j .. j + n.
template <int i, int j, int m, int n>
ROUNDEL_INLINE void multiply(const Columns& columns, int count, Sums& sums) {
    Lanes s[m][n];
    for (int a = 0; a < m; ++a)
        for (int b = 0; b < n; ++b) s[a][b] = sums.gram[i + a][j + b];
    for (int k = 0; k < count; ++k)
        for (int a = 0; a < m; ++a)
            for (int b = 0; b < n; ++b) s[a][b] += columns[i + a][k] * columns[j + b][k];
    for (int a = 0; a < m; ++a)
        for (int b = 0; b < n; ++b) sums.gram[i + a][j + b] = s[a][b];
}

/// All products of the columns, tile by tile, the upper triangle only.
template <int i, int j>
ROUNDEL_INLINE void multiply_all(const Columns& columns, int count, Sums& sums) {
    constexpr int m = std::min(kHigh, kColumns - i), n = std::min(kWide, kColumns - j);
    multiply<i, j, m, n>(columns, count, sums);
    if constexpr (j + n < kColumns)
        multiply_all<i, j + n>(columns, count, sums);
    else if constexpr (i + m < kColumns)
        multiply_all<i + m, i + m>(columns, count, sums);
}

/// Gives each column of eight pixels the root of their weight.
ROUNDEL_INLINE void weigh(const Gradient& model, const Lanes& level, float per_cut, int k, Columns& columns,
                          Sums& sums) {
    const Lanes r = level - model.level[k], t = r * per_cut, left = 1.0f - t * t;
    // What is clipped tells no more than that the level is beyond the scale.
    const Bits clipped = ((level > 254.5f) & (model.level[k] > 255.0f)) |
                         ((level < 0.5f) & (level >= 0.0f) & (model.level[k] < 0.0f));
    const Bits counts = (left > 0.0f) & (level >= 0.0f) & ~clipped;
    const Lanes root = counts ? left : all(0), w = root * root;
    const Lanes& bx = model.by[kX][k];
    const Lanes& by = model.by[kY][k];
    const Lanes ring = level >= 0.0f ? model.ring[k] * model.ring[k] : all(0), m = w * (bx * bx + by * by);
    for (int i = 0; i < kCount; ++i) columns[i][k] = root * model.by[i][k];
    columns[kCount][k] = root * r;
    sums.w += w;
    sums.ring += ring;
    sums.ring_rr += ring * r * r;
    sums.agreeing += w * ring;
    sums.m += m;
    sums.mm += m * (bx * bx + by * by);
    sums.mrr += m * r * r;
    sums.mwrr += m * w * r * r;
    sums.mpsi += root > 0.0f ? m / root * (1.0f - 5.0f * t * t) : all(0);
}

ROUNDEL_CLONES void add_up(const EdgePixels& pixels, const Model& model, float per_cut, Sums& sums) {
    Gradient gradient;
    Columns columns;
    for (int begin = 0; begin < pixels.count; begin += kChunk * kLanes) {
        const int count = std::min(kChunk, (pixels.count - begin) / kLanes);
        model.evaluate(pixels.x + begin, pixels.y + begin, count, gradient);
        for (int k = 0; k < count; ++k)
            weigh(gradient, load(pixels.level + begin + k * kLanes), per_cut, k, columns, sums);
        multiply_all<0, 0>(columns, count, sums);
    }
}

ROUNDEL_CLONES int add_residuals(const EdgePixels& pixels, const Model& model, int step, float* residuals,
                                 float* slopes) {
    Gradient gradient;
    int n = 0;
    for (int begin = 0; begin + kLanes <= pixels.used; begin += step * kLanes, n += kLanes) {
        model.evaluate(pixels.x + begin, pixels.y + begin, 1, gradient);
        const Lanes r = magnitude(load(pixels.level + begin) - gradient.level[0]);
        const Lanes slope = magnitude(gradient.ring[0]);
        __builtin_memcpy(residuals + n, &r, sizeof r);
        __builtin_memcpy(slopes + n, &slope, sizeof slope);
    }
    return n;
}

}  // namespace

NormalEquations accumulate(const EdgePixels& pixels, const Parameters& p, double scale) {
    Sums sums{};
    add_up(pixels, Model(p), float(1 / (kTukey * scale)), sums);
    NormalEquations e;
    for (int i = 0; i < kCount; ++i) {
        for (int j = 0; j <= i; ++j) e.H[i][j] = sum(sums.gram[j][i]);
        e.g[i] = sum(sums.gram[i][kCount]);
    }
    e.wrr = sum(sums.gram[kCount][kCount]), e.w = sum(sums.w);
    e.ring = sum(sums.ring), e.ring_rr = sum(sums.ring_rr), e.agreeing = sum(sums.agreeing);
    e.m = sum(sums.m), e.mm = sum(sums.mm);
    e.mrr = sum(sums.mrr), e.mwrr = sum(sums.mwrr), e.mpsi = sum(sums.mpsi);
    return e;
}

int sample_residuals(const EdgePixels& pixels, const Parameters& p, float* residuals) {
    float slopes[kSample + kLanes];
    const int step = (pixels.count + kSample - 1) / kSample;
    const int n = add_residuals(pixels, Model(p), step, residuals, slopes);
    const float steep = n > 0 ? *std::max_element(slopes, slopes + n) / 2 : 0;
    int kept = 0;
    for (int k = 0; k < n; ++k)
        if (slopes[k] > steep) residuals[kept++] = residuals[k];
    return kept;
}

}  // namespace roundel
