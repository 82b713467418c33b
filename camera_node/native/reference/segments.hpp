// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstdint>
#include <vector>

#include "numeric/image.hpp"
#include "search/threshold.hpp"

namespace roundel {

/// Sums over pixels that give area, centre and covariance.
struct Moments {
    double n = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0;
    Moments& operator+=(const Moments& other);
};

/// A connected set of pixels on one side of the threshold. The box includes its last row and column.
struct Segment {
    bool dark = false;
    int left = INT32_MAX, top = INT32_MAX, right = -1, bottom = -1;
    Moments moments;
    int width() const { return right - left + 1; }
    int height() const { return bottom - top + 1; }
};

/// Pixels [begin, end) of a row on one side of the threshold.
struct SegmentRun {
    int begin, end, segment;
    bool dark;
};

/// All dark and all bright segments of an image, as runs in the order of the rows. Dark pixels are
/// 4-connected and bright pixels 8-connected, so that a thin bright line separates dark segments.
struct Segments {
    std::vector<SegmentRun> runs;
    std::vector<int> row_begin;  // (height + 1) first run of each row
    std::vector<Segment> list;
    /// The number of the segment that contains a pixel of the image.
    int at(int x, int y) const;
};

/// Region growing of the whole frame: joins the runs of adjacent rows that touch.
Segments grow_segments(const ImageView& image, const ThresholdMap& threshold);

/// Mean grey level of one segment.
double mean_level(const ImageView& image, const Segments& segments, int segment);

}  // namespace roundel
