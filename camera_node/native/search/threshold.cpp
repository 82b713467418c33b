// SPDX-License-Identifier: BSD-3-Clause
#include "search/threshold.hpp"

#include <algorithm>
#include <array>
#include <cstring>
#include <numeric>

#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kSquare = 4;  // pixels of a side, the width of the ring of a roundel of 20

inline uint8_t least(uint8_t a, uint8_t b) { return a < b ? a : b; }
inline uint8_t greatest(uint8_t a, uint8_t b) { return a > b ? a : b; }

/// The difference of the brightest and the darkest pixel of a patch.
template <int width, int height>
int span_of(const ImageView& patch) {
    uint8_t low[width], high[width];
    std::copy_n(patch.data, width, low), std::copy_n(patch.data, width, high);
    for (int y = 1; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            low[x] = least(low[x], patch.row(y)[x]);
            high[x] = greatest(high[x], patch.row(y)[x]);
        }
    return *std::max_element(high, high + width) - *std::min_element(low, low + width);
}

/// What `measure` finds in the flattest of 256 patches of this size, a twentieth of which have less.
template <int width, int height, typename Measure>
double in_flat_patches(const ImageView& image, const Measure& measure) {
    constexpr int kPatches = 16;    // in either direction
    constexpr double kFlat = 0.05;  // share of the patches that are the flattest
    if (image.width < width || image.height < height) return 0;
    std::array<double, kPatches * kPatches> found;
    for (int k = 0; k < kPatches * kPatches; ++k) {
        const int x = (image.width - width) * (k % kPatches) / kPatches;
        const int y = (image.height - height) * (k / kPatches) / kPatches;
        found[size_t(k)] = measure(image.window(x, y, width, height));
    }
    const auto flat = found.begin() + ptrdiff_t(kFlat * double(found.size()));
    std::nth_element(found.begin(), flat, found.end());
    return *flat;
}

/// The variance of the sums of the 16 squares of a patch, for each of their 16 pixels.
double density_of(const ImageView& patch) {
    double sum = 0, squared = 0;
    for (int y = 0; y < 4 * kSquare; y += kSquare) {
        uint16_t columns[4 * kSquare] = {};
        for (int v = y; v < y + kSquare; ++v)
            for (int x = 0; x < 4 * kSquare; ++x) columns[x] = uint16_t(columns[x] + patch.row(v)[x]);
        for (const uint16_t* x = columns; x < std::end(columns); x += kSquare) {
            const double levels = std::accumulate(x, x + kSquare, 0);
            sum += levels;
            squared += levels * levels;
        }
    }
    return (squared - sum * sum / 16) / (15 * 16);
}

}  // namespace

double noise_level(const ImageView& image) {
    constexpr double kDeviations = 2.9;  // range of a flat patch, standard deviations
    return std::max(1.0, in_flat_patches<8, 4>(image, span_of<8, 4>) / kDeviations);
}

double noise_density(const ImageView& image) {
    constexpr double kLeast = 0.484;  // of the mean: a twentieth of chi-square with 15 degrees of freedom
    return std::max(1.0, in_flat_patches<4 * kSquare, 4 * kSquare>(image, density_of) / kLeast);
}

namespace {

constexpr int kShift = 3;  // 2^3 = kTile

/// Repeats each of n values `kTile` times.
ROUNDEL_CLONES void repeat(const uint8_t* from, int n, uint8_t* to) {
    for (int x = 0; x < n; ++x)
        for (int k = 0; k < kTile; ++k) to[kTile * x + k] = from[x];
}

}  // namespace

void ThresholdMap::expand(int y, int width, uint8_t* out) const {
    const uint8_t* row = theta.data() + size_t(y >> shift) * size_t(columns);
    if (shift == kShift) return repeat(row, (width + kTile - 1) / kTile, out);
    for (int x = 0; x < width; x += kTile) std::memset(out + x, row[x >> shift], kTile);
}

ThresholdMap constant_threshold(uint8_t theta) { return {30, 1, {theta}}; }

namespace {

constexpr int kLevels = 5;
// The range of a hundred normal variables in standard deviations (Tippett 1925): about as many pixels of ink
// and of paper are in a tile and its neighbours.
constexpr double kExtremes = 5;

/// The darkest and the brightest pixel of each tile, row by row.
struct TileRange {
    int columns, rows;
    std::vector<uint8_t> low, high;
    TileRange(int c, int r) : columns(c), rows(r), low(size_t(c) * size_t(r), 255), high(low.size(), 0) {}
    size_t at(int x, int y) const { return size_t(y) * size_t(columns) + size_t(x); }
};

/// Extends n ranges by others.
inline void extend(const uint8_t* low, const uint8_t* high, int n, uint8_t* to_low, uint8_t* to_high) {
    for (int x = 0; x < n; ++x) {
        to_low[x] = least(to_low[x], low[x]);
        to_high[x] = greatest(to_high[x], high[x]);
    }
}

/// The extremes of four rows of n pixels.
inline void join_rows(const uint8_t* const rows[4], int n, uint8_t* low, uint8_t* high) {
    const uint8_t *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3];
    for (int x = 0; x < n; ++x) {
        low[x] = least(least(a[x], b[x]), least(c[x], d[x]));
        high[x] = greatest(greatest(a[x], b[x]), greatest(c[x], d[x]));
    }
}

/// The extremes of n pairs of adjacent columns.
inline void join_neighbours(const uint8_t* low, const uint8_t* high, int n, uint8_t* to_low,
                            uint8_t* to_high) {
    for (int x = 0; x < n; ++x) {
        to_low[x] = least(low[2 * x], low[2 * x + 1]);
        to_high[x] = greatest(high[2 * x], high[2 * x + 1]);
    }
}

/// Buffers for the extremes of single columns, of two and of four, as wide as whole tiles.
struct ColumnExtremes {
    std::vector<uint8_t> low[3], high[3];
    explicit ColumnExtremes(int tiles) {
        for (int k = 0; k < 3; ++k) {
            low[k].assign(size_t(tiles) * size_t(kTile >> k), 255);
            high[k].assign(low[k].size(), 0);
        }
    }
};

/// The range of every 8 columns in every second of some rows.
ROUNDEL_CLONES void range_of_tiles(const ImageView& rows, int tiles, ColumnExtremes& columns, uint8_t* to_low,
                                   uint8_t* to_high) {
    const uint8_t* four[4];
    for (int k = 0; k < 4; ++k) four[k] = rows.row(std::min(2 * k, (rows.height - 1) & ~1));
    auto& [low, high] = columns;
    join_rows(four, rows.width, low[0].data(), high[0].data());
    join_neighbours(low[0].data(), high[0].data(), 4 * tiles, low[1].data(), high[1].data());
    join_neighbours(low[1].data(), high[1].data(), 2 * tiles, low[2].data(), high[2].data());
    join_neighbours(low[2].data(), high[2].data(), tiles, to_low, to_high);
}

TileRange tile_range(const ImageView& image) {
    TileRange range((image.width + kTile - 1) / kTile, (image.height + kTile - 1) / kTile);
    ColumnExtremes columns(range.columns);
    for (int y = 0; y < image.height; y += kTile) {
        const size_t first = range.at(0, y / kTile);
        range_of_tiles(image.window(0, y, image.width, std::min(kTile, image.height - y)), range.columns,
                       columns, &range.low[first], &range.high[first]);
    }
    return range;
}

/// The extremes of three adjacent tiles of a row. The input has one more tile at each end.
inline void join_three(const uint8_t* low, const uint8_t* high, int n, uint8_t* to_low, uint8_t* to_high) {
    for (int x = 0; x < n; ++x) {
        to_low[x] = least(least(low[x], low[x + 1]), low[x + 2]);
        to_high[x] = greatest(greatest(high[x], high[x + 1]), high[x + 2]);
    }
}

/// Extends each tile's range by those of its eight neighbours.
ROUNDEL_CLONES TileRange dilate(const TileRange& range) {
    const int n = range.columns;
    TileRange wide(n, range.rows);
    std::vector<uint8_t> low(size_t(n) + 2, 255), high(size_t(n) + 2, 0);
    for (int y = 0; y < range.rows; ++y) {
        std::fill(low.begin(), low.end(), 255);
        std::fill(high.begin(), high.end(), 0);
        for (int v = std::max(y - 1, 0); v <= std::min(y + 1, range.rows - 1); ++v)
            extend(&range.low[range.at(0, v)], &range.high[range.at(0, v)], n, &low[1], &high[1]);
        join_three(low.data(), high.data(), n, &wide.low[wide.at(0, y)], &wide.high[wide.at(0, y)]);
    }
    return wide;
}

/// Extends ranges by those of pairs of adjacent tiles; `n` is even.
inline void join_pairs(const uint8_t* low, const uint8_t* high, int n, uint8_t* to_low, uint8_t* to_high) {
    for (int x = 0; x < n / 2; ++x) {
        to_low[x] = least(to_low[x], least(low[2 * x], low[2 * x + 1]));
        to_high[x] = greatest(to_high[x], greatest(high[2 * x], high[2 * x + 1]));
    }
}

/// The ranges of tiles of twice the side.
ROUNDEL_CLONES TileRange halve(const TileRange& range) {
    const int n = range.columns;
    TileRange coarse((n + 1) / 2, (range.rows + 1) / 2);
    for (int y = 0; y < range.rows; ++y) {
        const uint8_t *low = &range.low[range.at(0, y)], *high = &range.high[range.at(0, y)];
        uint8_t *to_low = &coarse.low[coarse.at(0, y / 2)], *to_high = &coarse.high[coarse.at(0, y / 2)];
        join_pairs(low, high, n & ~1, to_low, to_high);
        if (n % 2) extend(low + n - 1, high + n - 1, 1, to_low + n / 2, to_high + n / 2);
    }
    return coarse;
}

/// The least contrast of a threshold, the exponent of the camera's tone curve, and by how much noise widens
/// the range of a tile and its neighbours.
struct ThresholdLimits {
    uint8_t min_contrast;
    double exponent, noise_range;
};

/// Sets the threshold half way between the extremes' light if there is contrast; otherwise the coarser
/// level's value remains. With the exponent e, light is the level to the power e: to second order, the level
/// half way from a to b is (a + b) / 2 + (e - 1) (b - a)^2 / (4 (a + b)). Noise widens the range b - a
/// equally at both ends.
ROUNDEL_CLONES void set_thresholds(const uint8_t* low, const uint8_t* high, int n,
                                   const ThresholdLimits& limits, uint8_t* theta) {
    const auto bend = float((limits.exponent - 1) / 4), noise_range = float(limits.noise_range);
    const uint8_t min_contrast = limits.min_contrast;
    for (int x = 0; x < n; ++x) {
        const auto contrast = uint8_t(high[x] - low[x]);
        const float beyond = float(contrast) - noise_range, sum = float(low[x] + high[x] + 1);
        const float difference = beyond > 0 ? beyond : 0;
        const auto middle = uint8_t(0.5f * sum + bend * difference * difference / sum);
        theta[x] = contrast >= min_contrast ? middle : theta[x];
    }
}

/// Repeats each value twice.
ROUNDEL_CLONES void double_row(const uint8_t* from, int n, uint8_t* to) {
    for (int x = 0; x < n / 2; ++x) to[2 * x] = to[2 * x + 1] = from[x];
    if (n % 2) to[n - 1] = from[n / 2];
}

std::vector<uint8_t> refine_thresholds(const TileRange& range, const ThresholdLimits& limits,
                                       const std::vector<uint8_t>& coarser) {
    std::vector<uint8_t> theta(range.low.size());
    const size_t columns = (size_t(range.columns) + 1) / 2;
    for (int y = 0; y < range.rows; ++y) {
        const size_t first = range.at(0, y);
        double_row(&coarser[size_t(y / 2) * columns], range.columns, &theta[first]);
        set_thresholds(&range.low[first], &range.high[first], range.columns, limits, &theta[first]);
    }
    return theta;
}

}  // namespace

ThresholdMap local_threshold(const ImageView& image, double min_contrast, uint8_t theta, const Tone& tone) {
    std::vector<TileRange> pyramid{dilate(tile_range(image))};
    while (pyramid.size() < kLevels) pyramid.push_back(halve(pyramid.back()));
    std::vector<uint8_t> thresholds(pyramid.back().low.size(), theta);
    for (auto range = pyramid.rbegin(); range != pyramid.rend(); ++range)
        thresholds = refine_thresholds(*range, {uint8_t(min_contrast), tone.exponent, kExtremes * tone.noise},
                                       thresholds);
    return {kShift, pyramid[0].columns, std::move(thresholds)};
}

}  // namespace roundel
