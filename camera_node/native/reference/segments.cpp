// SPDX-License-Identifier: BSD-3-Clause
#include "reference/segments.hpp"

#include <algorithm>
#include <cstring>

namespace roundel {

Moments& Moments::operator+=(const Moments& other) {
    n += other.n;
    x += other.x;
    y += other.y;
    xx += other.xx;
    xy += other.xy;
    yy += other.yy;
    return *this;
}

namespace {

/// Sums over the pixels [begin, end) of row `y`, in closed form.
Moments run_moments(const SegmentRun& run, double y) {
    const double n = run.end - run.begin, middle = (run.begin + run.end - 1) / 2.0;
    const double x = n * middle;
    return {n, x, n * y, n * (middle * middle + (n * n - 1) / 12), x * y, n * y * y};
}

/// Appends the runs of a row; its mask is 1 at dark pixels.
void append_runs(const uint8_t* mask, int width, std::vector<SegmentRun>& runs) {
    for (int x = 0; x < width;) {
        const uint8_t side = mask[x];
        const uint64_t eight = side * 0x0101010101010101u;
        int end = x + 1;
        for (uint64_t word; end + 8 <= width; end += 8) {
            std::memcpy(&word, mask + end, 8);
            if (word != eight) break;
        }
        while (end < width && mask[end] == side) ++end;
        runs.push_back({x, end, int(runs.size()), side != 0});
        x = end;
    }
}

/// The root of a run's set (union-find with path halving).
int find_root(std::vector<SegmentRun>& runs, int k) {
    while (runs[size_t(k)].segment != k) {
        int& parent = runs[size_t(k)].segment;
        parent = runs[size_t(parent)].segment;
        k = parent;
    }
    return k;
}

void join(std::vector<SegmentRun>& runs, int a, int b) {
    a = find_root(runs, a);
    b = find_root(runs, b);
    runs[size_t(std::max(a, b))].segment = std::min(a, b);
}

/// Joins the runs of one row [middle, end) with those of the row above [begin, middle).
void join_rows(std::vector<SegmentRun>& runs, int begin, int middle, int end) {
    for (int above = begin, below = middle; above < middle && below < end;) {
        const SegmentRun a = runs[size_t(above)],
                         b = runs[size_t(below)];  // runs cover their rows, so these two touch
        if (a.dark == b.dark) join(runs, above, below);
        if (a.end == b.end && above + 1 < middle && a.dark != b.dark)  // two bright runs meet at a corner
            a.dark ? join(runs, above + 1, below) : join(runs, above, below + 1);
        above += a.end <= b.end;
        below += b.end <= a.end;
    }
}

void include(Segment& segment, const SegmentRun& run, int y) {
    segment.left = std::min(segment.left, run.begin);
    segment.right = std::max(segment.right, run.end - 1);
    segment.top = std::min(segment.top, y);
    segment.bottom = y;
    segment.moments += run_moments(run, y);
}

/// Replaces roots by numbers of segments and sums up each segment. A root precedes the runs of its set.
void number_segments(Segments& segments) {
    auto& runs = segments.runs;
    for (size_t y = 0; y + 1 < segments.row_begin.size(); ++y)
        for (int k = segments.row_begin[y]; k < segments.row_begin[y + 1]; ++k) {
            SegmentRun& run = runs[size_t(k)];
            const bool root = run.segment == k;
            run.segment = root ? int(segments.list.size()) : runs[size_t(run.segment)].segment;
            if (root) segments.list.emplace_back().dark = run.dark;
            include(segments.list[size_t(run.segment)], run, int(y));
        }
}

}  // namespace

int Segments::at(int x, int y) const {
    const auto begin = runs.begin() + row_begin[size_t(y)], end = runs.begin() + row_begin[size_t(y) + 1];
    return std::upper_bound(begin, end, x, [](int value, const SegmentRun& run) { return value < run.end; })
        ->segment;
}

Segments grow_segments(const ImageView& image, const ThresholdMap& threshold) {
    Segments segments;
    std::vector<uint8_t> theta(static_cast<size_t>(image.width) + 8), mask(theta.size());
    segments.row_begin.push_back(0);
    for (int y = 0; y < image.height; ++y) {
        if (threshold.changes(y)) threshold.expand(y, image.width, theta.data());
        const uint8_t* row = image.row(y);
        for (int x = 0; x < image.width; ++x) mask[size_t(x)] = row[x] < theta[size_t(x)];
        append_runs(mask.data(), image.width, segments.runs);
        const int middle = segments.row_begin.back();
        segments.row_begin.push_back(int(segments.runs.size()));
        if (y) join_rows(segments.runs, segments.row_begin[size_t(y) - 1], middle, segments.row_begin.back());
    }
    // Parents precede their children, so one pass finds every root.
    for (auto& run : segments.runs) run.segment = segments.runs[size_t(run.segment)].segment;
    number_segments(segments);
    return segments;
}

double mean_level(const ImageView& image, const Segments& segments, int segment) {
    const Segment& s = segments.list[size_t(segment)];
    double sum = 0;
    for (int y = s.top; y <= s.bottom; ++y)
        for (int k = segments.row_begin[size_t(y)]; k < segments.row_begin[size_t(y) + 1]; ++k) {
            const SegmentRun& run = segments.runs[size_t(k)];
            if (run.segment != segment) continue;
            for (int x = run.begin; x < run.end; ++x) sum += image.row(y)[x];
        }
    return sum / s.moments.n;
}

}  // namespace roundel
