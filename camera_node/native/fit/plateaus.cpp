// SPDX-License-Identifier: BSD-3-Clause
#include "fit/plateaus.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "fit/row_spans.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr double kMostPixels = 4000;  // of the disc: levels are then known to a thirtieth of the noise

/// Sums of levels and of their squares, below 2^31 for 30,000 pixels.
struct LevelSums {
    int count = 0, sum = 0, squares = 0;
    Bits sums{};        // `sum` by lanes
    Bits squares_of{};  // `squares` by lanes

    ROUNDEL_INLINE void add(const uint8_t* levels) {
        uint64_t bytes;
        __builtin_memcpy(&bytes, levels, sizeof bytes);
        const Bits level = widen(bytes);
        sums += level;
        squares_of += level * level;
    }
    Plateau mean() const {
        if (count == 0) return {};
        int64_t total = sum, of_squares = squares;
        for (int k = 0; k < kLanes; ++k) {
            total += sums[k];
            of_squares += squares_of[k];
        }
        const double m = double(total) / count;
        return {count, m, double(of_squares) / count - m * m};
    }
};

/// The rows of an image, relative to the origin of the parameters.
struct Rows {
    const ImageView& image;
    int origin_x, origin_y;

    /// Adds the pixels [begin, end) of row y that are inside the image.
    ROUNDEL_INLINE void add(int y, int begin, int end, LevelSums& sums) const {
        if (y + origin_y < 0 || y + origin_y >= image.height) return;
        begin = std::max(begin + origin_x, 0);
        end = std::min(end + origin_x, image.width);
        const uint8_t* row = image.row(y + origin_y);
        int u = begin;
        for (; u + kLanes <= end; u += kLanes) sums.add(row + u);
        for (; u < end; ++u) {
            sums.sum += row[u];
            sums.squares += row[u] * row[u];
        }
        sums.count += std::max(0, end - begin);
    }
};

/// The ellipses between which the plateaus lie, from the outside.
struct PlateauEdges {
    RowEllipse ring, around_hole, hole;
};

ROUNDEL_CLONES void add_up(const Rows& image, const PlateauEdges& edges, int step, LevelSums& ring,
                           LevelSums& hole) {
    const RowEllipses outer = RowEllipses::all_of(edges.ring),
                      middle = RowEllipses::all_of(edges.around_hole),
                      inner = RowEllipses::all_of(edges.hole);
    constexpr Lanes kSteps{0, 1, 2, 3, 4, 5, 6, 7};
    const int top = int(std::ceil(edges.ring.top)), bottom = int(std::floor(edges.ring.bottom));
    for (int y = top; y <= bottom; y += kLanes * step) {
        const Lanes rows = float(y) + float(step) * kSteps;
        const Spans whole = outer.cut(rows), open = middle.cut(rows), paper = inner.cut(rows);
        for (int k = 0; k < kLanes; ++k) {
            const int row = y + k * step;
            if (!whole.has(k)) continue;
            const bool is_open = open.has(k);
            image.add(row, whole.begin[k], is_open ? open.begin[k] : whole.end[k], ring);
            if (is_open) image.add(row, open.end[k], whole.end[k], ring);
            if (paper.has(k)) image.add(row, paper.begin[k], paper.end[k], hole);
        }
    }
}

}  // namespace

Plateaus read_plateaus(const ImageView& image, const Parameters& p, int origin_x, int origin_y,
                       double distance) {
    const CircleImage outer = circle_image(p, 1), inner = circle_image(p, p[kRatio]);
    const PlateauEdges edges{RowEllipse(outer, -distance), RowEllipse(inner, distance),
                             RowEllipse(inner, -distance)};
    const double area = std::numbers::pi * std::sqrt(std::max(0.0, outer.shape.det()));
    LevelSums ring, hole;
    add_up({image, origin_x, origin_y}, edges, 1 + int(area / kMostPixels), ring, hole);
    return {ring.mean(), hole.mean()};
}

}  // namespace roundel
