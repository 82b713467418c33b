// SPDX-License-Identifier: BSD-3-Clause
#include "search/chords.hpp"

#include <algorithm>
#include <bit>
#include <cmath>

#include "numeric/lanes.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kSlack = 24;             // tolerance of a run, sixteenths of a pixel: edge and blur
constexpr int kCoarseLeast = 6;        // least length on a diagonal, whose pixels are sqrt(8) wide, and
constexpr int kCoarseSlack = 16;       // tolerance, sixteenths of them
constexpr int kUneven = 26;            // longer dark run over the shorter one without occlusion, sixteenths
constexpr int kDrift = 3;              // pixels that the middle may move from one line to the next
constexpr int kStreakLines = 3;        // least number of lines
constexpr int kStreakWidth = 14;       // least width, pixels
constexpr float kStreakLength = 0.5f;  // least length over the width; less for oblique bars:
constexpr float kOblique = 0.83f;      // width times the sine of the slant by which the length is shorter
constexpr float kMaxSine = 0.45f;      // of the slant off a diagonal; rows or columns are better beyond

constexpr int kBatch = 16;                        // lines scanned together
constexpr int kPadding = 2 * kWord + 4 * kLanes;  // numbers that are read beyond the last one
constexpr int kGroup = 8;  // numbers that are written without testing how many there are

/// Appends the positions of the bits of a word. The writes are volatile because the compiler would gather
/// them in vectors otherwise, which takes longer.
ROUNDEL_INLINE int* append_bits(uint64_t bits, int base, int* to) {
    const int count = std::popcount(bits);
    for (int k = 0; k < count; k += kGroup)
        for (int j = k; j < k + kGroup; ++j, bits &= bits - 1)
            *static_cast<volatile int*>(to + j) = base + std::countr_zero(bits);
    return to + count;
}

/// Lines [first, last) of an image. A position in them is a single number: the line's number, counted from
/// `first`, times 2^shift, plus the pixel's.
struct LineRange {
    int first, last, shift;
};

/// Writes the begins and ends of the dark runs of some lines; returns the number of runs. Pixels beyond the
/// end of a line are bright.
ROUNDEL_INLINE int find_runs(const BitImage& picture, const LineRange& range, int* edges) {
    const int words = picture.words, shift = range.shift;
    int* to = edges;
    for (int line = range.first; line < range.last; ++line) {
        const uint64_t* word = picture.line(line);
        uint64_t carry = 0;
        for (int n = 0; n < words; ++n) {
            const uint64_t turns = word[n] ^ (word[n] << 1 | carry);
            carry = word[n] >> (kWord - 1);
            if (turns) to = append_bits(turns, ((line - range.first) << shift) + n * kWord, to);
        }
        if (carry) *to++ = ((line - range.first) << shift) + picture.length;
    }
    const int last_edge = to > edges ? to[-1] : 0;
    for (int k = 0; k < kPadding; ++k) to[k] = last_edge;  // empty runs
    return int(to - edges) / 2;
}

/// Begins and ends of eight consecutive dark runs.
struct DarkRuns {
    Bits begin, end;
    ROUNDEL_INLINE explicit DarkRuns(const int* edges) {
        Bits a, b;
        __builtin_memcpy(&a, edges, sizeof a);
        __builtin_memcpy(&b, edges + kLanes, sizeof b);
        begin = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14);
        end = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15);
    }
};

/// Bit k is set if lane k is.
ROUNDEL_INLINE uint32_t lanes_set(const Bits& lanes) {
    typedef int32_t Half __attribute__((vector_size(2 * kLanes)));
    const Bits v = lanes & Bits{1, 2, 4, 8, 16, 32, 64, 128};
    const Half h = __builtin_shufflevector(v, v, 0, 1, 2, 3) | __builtin_shufflevector(v, v, 4, 5, 6, 7);
    const Half q = h | __builtin_shufflevector(h, h, 2, 3, 0, 1);
    return uint32_t(q[0] | q[1]);
}

/// Tests whether each of eight bright runs may be the middle of a roundel, by its length and those of the
/// dark runs on either side: bit k is for the k-th. Integers in sixteenths are sufficient.
ROUNDEL_INLINE uint32_t test_chords(const int* edges, const Proportions& p) {
    const DarkRuns before(edges), behind(edges + 2);
    const Bits left = before.end - before.begin, right = behind.end - behind.begin;
    const Bits inner = behind.begin - before.end;
    const Bits dark = left < right ? left : right, uneven = left < right ? right : left;
    const Bits total = inner + 2 * dark;
    const Bits pass = (total >= p.least) & (total <= p.most) & (16 * dark <= p.thick * inner + p.slack) &
                      (16 * dark + p.slack >= p.thin * inner) & (16 * uneven <= kUneven * dark + p.slack);
    return lanes_set(pass);
}

/// Finds the bright runs of some lines that may be the middle of a roundel, and returns how many there are:
/// `numbers` are the numbers of the dark runs before them. (A run from one line to the next is too long.)
ROUNDEL_CLONES int find_chords(const BitImage& picture, const LineRange& range, const Proportions& limits,
                               int* edges, int* numbers) {
    const Proportions p = limits;  // a copy, which cannot alias the output
    const int count = find_runs(picture, range, edges) - 1;
    int* number = numbers;
    for (int begin = 0; begin < count; begin += kWord) {
        uint64_t passes = 0;
        for (int k = 0; k < kWord; k += kLanes)
            passes |= uint64_t(test_chords(edges + 2 * (begin + k), p)) << k;
        if (count - begin < kWord) passes &= (uint64_t(1) << (count - begin)) - 1;
        number = append_bits(passes, begin, number);
    }
    return int(number - numbers);
}

/// The darkest of three pixels in the middle of a run. Only one of them may be fully dark in a thin ring.
template <typename Level>
int darkest(const Level& level, int begin, int end) {
    const int middle = (begin + end) / 2;
    int least = level(middle);
    for (const int k : {middle - 1, middle + 1})
        if (k >= begin && k < end) least = std::min(least, level(k));
    return least;
}

}  // namespace

void ChordSearch::set_limits(const RoundelLimits& limits, bool any) {
    const auto [low, high] = limits.ratio_range(any);
    const double r = std::max(0.05, low), R = std::min(0.95, high);
    // The shortest chord through the centre is the minor axis.
    const int thick = int(std::lround(16 * (1 - r) / (2 * r))),
              thin = int(std::lround(16 * (1 - R) / (2 * R)));
    fine_ = {int(0.65 * limits.min_diameter), int(limits.max_diameter + 2), thick, thin, kSlack};
    coarse_ = {kCoarseLeast, int(limits.max_diameter / 2.8) + 2, thick, thin, kCoarseSlack};
    min_contrast_ = int(limits.min_contrast / 2);
}

bool ChordSearch::is_diametral(int dark, int inner) const {
    return dark > 0 && inner + 2 * dark <= fine_.most && 16 * dark <= fine_.thick * inner + fine_.slack &&
           16 * dark + fine_.slack >= fine_.thin * inner;
}

void ChordSearch::scan_lines(const BitImage& along, int first, int last) {
    Proportions limits = limits_;
    limits.most = std::min(limits.most, along.length);
    const int shift = std::bit_width(unsigned(along.length + limits.most));
    const int found = find_chords(along, {first, last, shift}, limits, edges_.get(), numbers_.get());
    for (int n = 0; n < found; ++n) {
        const int* edge = &edges_[2 * size_t(numbers_[size_t(n)])];
        const int line = edge[1] >> shift, b = edge[1] - (line << shift), inner = edge[2] - edge[1];
        add_chord(b + (inner - 1) / 2, inner, edge[3] - edge[0], first + line);
    }
}

/// Adds a chord to the stack that it continues, with at most one line between them, or begins a stack.
/// Without a branch, since it would be unpredictable.
void ChordSearch::add_chord(int middle, int inner, int outer, int line) {
    int* near = &nearest_[size_t(middle)];  // begins `kDrift` pixels before the middle
    Stack& before = stacks_[size_t(near[kDrift])];
    const bool same = (before.last + 2 >= line) & (before.last < line) &
                      (std::abs(inner - before.inner) <= 2 + before.inner / 4);
    const int mask = -int(same);
    before.continued |= same;
    const int first = (before.first & mask) | (line & ~mask),
              begin = (before.begin & mask) | (middle & ~mask);
    const int longest = std::max(outer, before.outer & mask);
    std::fill_n(near, 2 * kDrift + 1, int(stacks_.size()));
    stacks_.push_back({middle, inner, first, line, begin, longest, false});
}

/// Tests the line across the middle of a stack of two chords or more.
void ChordSearch::test_across(const Stack& stack) {
    const BitImage& across = *across_;
    const int at = stack.middle, line = at / 2, middle = stack.first + stack.last;  // two pixels a line
    if (across.is_dark(line, middle)) return;
    const int b = across.run_begin(line, middle), c = across.run_end(line, middle);
    const int a = b > 0 ? across.run_begin(line, b - 1) : b;
    const int d = c < across.length ? across.run_end(line, c) : c;
    if (!is_diametral(b - a, c - b) && !is_diametral(d - c, c - b)) return;
    if (6 * (stack.last - stack.first + 1) < c - b)
        return;  // many lines of the hole have diametral proportions
    const auto level = [&](int k) -> int { return along_rows_ ? image_->row(k)[at] : image_->row(at)[k]; };
    const bool upper = b > a && (d == c || b - a <= d - c);
    const int m_d = upper ? darkest(level, a, b) : darkest(level, c, d), m_b = level((b + c - 1) / 2);
    if (m_b - m_d < min_contrast_) return;
    const float x = float(at), y = float(b + c - 1) / 2;
    const auto reach = float(std::max(c - b, stack.inner) + 2);  // twice the chord's for a slanted hole
    seeds_.push_back({along_rows_ ? x : y, along_rows_ ? y : x, reach, m_d, m_b});
}

bool ChordSearch::is_inside(int x, int y) const {
    return x >= 0 && x < image_->width && y >= 0 && y < image_->height;
}

/// The number of pixels from (x, y) on, in steps of (dx, dy), that are dark, or bright, like the first one.
int ChordSearch::run_length(int x, int y, int dx, int dy) const {
    if (!is_inside(x, y)) return 0;
    const int across = dx > 0 ? image_->width - x : x + 1, down = dy > 0 ? image_->height - y : y + 1;
    const int most = std::min({across, down, fine_.most});
    const bool dark = rows_.is_dark(y >> 1, x);
    int n = 1;
    while (n < most && rows_.is_dark((y += dy) >> 1, x += dx) == dark) ++n;
    return n;
}

/// Whether the chord through a point is unoccluded at full resolution, too.
bool ChordSearch::is_unoccluded(int x, int y, int dx, int dy) const {
    const int to = run_length(x, y, dx, dy), back = run_length(x, y, -dx, -dy), inner = to + back - 1;
    const int after = run_length(x + to * dx, y + to * dy, dx, dy);
    if (!is_diametral(after, inner)) return false;
    const int before = run_length(x - back * dx, y - back * dy, -dx, -dy);
    if (!is_diametral(before, inner) ||
        16 * std::max(before, after) > kUneven * std::min(before, after) + kSlack)
        return false;
    const auto level = [&](int k) -> int { return image_->row(y + k * dy)[x + k * dx]; };
    const int one = darkest(level, to, to + after);
    const int other = darkest([&](int k) { return level(-k); }, back, back + before);
    return 4 * std::abs(one - other) < level(0) - std::min(one, other);  // both runs have the same ink
}

/// Tests the line across a stack of diagonal chords. Rows and columns may be occluded although a diagonal is
/// not.
void ChordSearch::test_across_diagonal(const Stack& stack) {
    const Raster& r = raster_;
    const int dx = r.step_x > 0 ? 1 : -1;  // across the diagonal
    const int dy = -1;                     // upwards
    const float at = float(stack.middle + stack.begin) / 2, line = float(stack.first + stack.last) / 2;
    const int x = int(r.x + at * r.step_x + line * r.line_x), y = int(r.y + at * r.step_y + line * r.line_y);
    if (!is_inside(x, y) || rows_.is_dark(y / 2, x)) return;
    if (!is_unoccluded(x, y, -dx * dy, 1)) return;
    const int up = run_length(x, y, dx, dy), down = run_length(x, y, -dx, -dy), inner = up + down - 1;
    if (6 * (stack.last - stack.first + 1) < inner) return;
    const int above = run_length(x + up * dx, y + up * dy, dx, dy);
    const int below = run_length(x - down * dx, y - down * dy, -dx, -dy);
    if (!is_diametral(above, inner) && !is_diametral(below, inner)) return;
    const bool upper = above > 0 && (below == 0 || above <= below);
    const auto level = [&](int k) -> int { return image_->row(y + k * dy)[x + k * dx]; };
    const int begin = upper ? up : down, end = begin + (upper ? above : below), middle = (up - down) / 2;
    const int m_d = darkest([&](int k) { return level(upper ? k : -k); }, begin, end), m_b = level(middle);
    if (m_b - m_d < min_contrast_) return;
    const float reach = std::max(std::sqrt(2.0f) * float(inner), std::sqrt(8.0f) * float(stack.inner)) + 2;
    seeds_.push_back({float(x + middle * dx), float(y + middle * dy), reach, m_d, m_b});
}

/// Adds a stack as a streak if it is as long as the bars of a roundel that moves along it.
void ChordSearch::add_streak(const Stack& stack) {
    const int lines = stack.last - stack.first + 1;
    const Raster& r = raster_;
    const float step = r.step_length();
    if (lines < kStreakLines || float(stack.outer) * step < kStreakWidth) return;
    const float drift = float(stack.middle - stack.begin) / float(lines - 1);
    const float x = r.line_x + drift * r.step_x, y = r.line_y + drift * r.step_y;  // along the bars
    const float per_line = 1 / std::sqrt(x * x + y * y);
    const float sine = std::abs(r.step_x * x + r.step_y * y) * per_line / step;  // of the slant
    const float cosine = std::abs(r.step_x * y - r.step_y * x) * per_line / step;
    const float width = float(stack.outer) * step * cosine, length = float(lines) * cosine / per_line;
    if (!across_ && sine > kMaxSine) return;
    if (width < kStreakWidth || length < kStreakLength * width * (cosine - kOblique * sine)) return;
    const float at = float(stack.middle + stack.begin) / 2, line = float(stack.first + stack.last) / 2;
    streaks_.push_back({r.x + at * r.step_x + line * r.line_x, r.y + at * r.step_y + line * r.line_y,
                        x * per_line, y * per_line, width});
}

void ChordSearch::scan(const BitImage& along, const BitImage* across, const Raster& raster,
                       const Proportions& limits) {
    across_ = across;
    along_rows_ = raster.step_y == 0;
    raster_ = raster;
    limits_ = limits;
    const size_t most = size_t(kBatch) * size_t(along.length + 1) + kPadding;
    if (most > room_) {
        edges_ = std::make_unique_for_overwrite<int[]>(most);
        numbers_ = std::make_unique_for_overwrite<int[]>(room_ = most);
    }
    nearest_.assign(size_t(along.length + 2 * kDrift), 0);
    stacks_.assign(1, {0, 0, 0, -kGroup, 0, 0, true});
    for (int line = 0; line < along.lines; line += kBatch)
        scan_lines(along, line, std::min(line + kBatch, along.lines));
    for (const Stack& stack : stacks_) {
        if (stack.continued || stack.first == stack.last) continue;
        add_streak(stack);
        across_ ? test_across(stack) : test_across_diagonal(stack);
    }
}

/// Finds motion-blurred roundels, and those whose rows and columns are occluded.
void ChordSearch::scan_diagonals() {
    subsample(rows_, sparse_);
    shear(sparse_, true, diagonals_);
    scan(diagonals_, nullptr, {float(-4 * (rows_.lines / 2)), 0.5f, 2, 2, 4, 0}, coarse_);
    shear(sparse_, false, diagonals_);
    scan(diagonals_, nullptr, {0, 0.5f, -2, 2, 4, 0}, coarse_);
}

void ChordSearch::run(const ImageView& image, const ThresholdMap& threshold) {
    seeds_.clear();
    streaks_.clear();
    image_ = &image;
    binarize(image, threshold, rows_, columns_);
    scan(rows_, &columns_, {0, 0.5f, 1, 0, 0, 2}, fine_);
    scan(columns_, &rows_, {0.5f, 0, 0, 1, 2, 0}, fine_);
    scan_diagonals();
}

}  // namespace roundel
