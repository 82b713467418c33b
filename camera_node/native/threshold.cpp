// SPDX-License-Identifier: BSD-3-Clause
#include "threshold.hpp"

#include <algorithm>
#include <cstring>

namespace roundel {

double saturated_share(const ImageView& image) {
    size_t count = 0;
    for (int y = 0; y < image.height; ++y) {
        const uint8_t* row = image.row(y);
        unsigned in_row = 0;
        for (int x = 0; x < image.width; ++x) in_row += row[x] >= 250;
        count += in_row;
    }
    return double(count) / (double(image.width) * image.height);
}

void Theta::settle(double dark, double bright) {
    value_ = (dark + bright) / 2;
    steps_ = 1;
}

void Theta::step() {
    steps_ = steps_ % 31 + 1;
    double share = 0, bit = 0.5;  // the binary digits of the step's number, mirrored at the point
    for (unsigned digits = steps_; digits; digits >>= 1, bit /= 2) share += (digits & 1) * bit;
    value_ = 256 * share;
}

void ThresholdMap::expand(int y, int width, uint8_t* out) const {
    const uint8_t* row = theta.data() + size_t(y / tile) * size_t(columns);
    for (int x = 0; x < width; x += tile)
        std::memset(out + x, row[x / tile], size_t(std::min(tile, width - x)));
}

ThresholdMap constant_threshold(int width, int height, uint8_t theta) {
    return {std::max({1, width, height}), 1, {theta}};
}

namespace {

/// The darkest and the brightest pixel of each tile.
struct Range {
    int columns, rows;
    std::vector<uint8_t> low, high;
    Range(int c, int r) : columns(c), rows(r), low(size_t(c) * size_t(r), 255), high(low.size(), 0) {}
    void include(size_t tile, uint8_t l, uint8_t h) {
        low[tile] = std::min(low[tile], l);
        high[tile] = std::max(high[tile], h);
    }
};

constexpr int kTile = 8;
constexpr int kLevels = 5;

Range tile_range(const ImageView& image) {
    Range range((image.width + kTile - 1) / kTile, (image.height + kTile - 1) / kTile);
    std::vector<uint8_t> low(size_t(image.width)), high(size_t(image.width));
    for (int y0 = 0; y0 < image.height; y0 += kTile) {
        std::fill(low.begin(), low.end(), 255);
        std::fill(high.begin(), high.end(), 0);
        for (int y = y0; y < std::min(y0 + kTile, image.height); ++y) {
            const uint8_t* row = image.row(y);
            for (int x = 0; x < image.width; ++x) {
                low[x] = std::min(low[x], row[x]);
                high[x] = std::max(high[x], row[x]);
            }
        }
        const size_t first = size_t(y0 / kTile) * size_t(range.columns);
        for (int x = 0; x < image.width; ++x) range.include(first + size_t(x / kTile), low[x], high[x]);
    }
    return range;
}

/// Each tile's range joined with those of its eight neighbours.
Range dilate(const Range& range) {
    Range wide(range.columns, range.rows);
    for (int y = 0; y < range.rows; ++y)
        for (int x = 0; x < range.columns; ++x)
            for (int v = std::max(0, y - 1); v <= std::min(y + 1, range.rows - 1); ++v)
                for (int u = std::max(0, x - 1); u <= std::min(x + 1, range.columns - 1); ++u) {
                    const size_t from = size_t(v) * size_t(range.columns) + size_t(u);
                    wide.include(size_t(y) * size_t(range.columns) + size_t(x), range.low[from],
                                 range.high[from]);
                }
    return wide;
}

/// Tiles of twice the side.
Range halve(const Range& range) {
    Range coarse((range.columns + 1) / 2, (range.rows + 1) / 2);
    for (int y = 0; y < range.rows; ++y)
        for (int x = 0; x < range.columns; ++x) {
            const size_t from = size_t(y) * size_t(range.columns) + size_t(x);
            coarse.include(size_t(y / 2) * size_t(coarse.columns) + size_t(x / 2), range.low[from],
                           range.high[from]);
        }
    return coarse;
}

}  // namespace

ThresholdMap local_threshold(const ImageView& image, double min_contrast, uint8_t theta) {
    std::vector<Range> pyramid{dilate(tile_range(image))};
    while (pyramid.size() < kLevels) pyramid.push_back(halve(pyramid.back()));
    const int columns = pyramid[0].columns, rows = pyramid[0].rows;
    ThresholdMap map{kTile, columns, std::vector<uint8_t>(size_t(columns) * size_t(rows), theta)};
    for (int y = 0; y < rows; ++y)
        for (int x = 0; x < columns; ++x)
            for (int level = 0; level < kLevels; ++level) {
                const Range& range = pyramid[size_t(level)];
                const size_t at = size_t(y >> level) * size_t(range.columns) + size_t(x >> level);
                if (range.high[at] - range.low[at] < min_contrast) continue;
                map.theta[size_t(y) * size_t(columns) + size_t(x)] =
                    uint8_t((range.low[at] + range.high[at] + 1) / 2);
                break;
            }
    return map;
}

}  // namespace roundel
