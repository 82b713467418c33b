// SPDX-License-Identifier: BSD-3-Clause
#include "chords.hpp"

#include <algorithm>
#include <bit>
#include <cmath>

#include "simd.hpp"

namespace roundel {

namespace {

// In sixteenths of a pixel, or of one.
constexpr int kSlack = 24;        // by which a run may be off its proportion: a pixel's edge and blur
constexpr int kCoarseLeast = 6;   // pixels, which are sqrt(8) as wide on a diagonal;
constexpr int kCoarseSlack = 16;  // sixteenths of them
constexpr int kUneven = 26;       // of one dark run to the other, in a chord that nothing covers
constexpr int kDrift = 3;         // pixels that the middle may move from one line to the next
constexpr int kStreakLines = 3, kStreakWidth = 14;  // the least; pixels
constexpr float kStreakLong = 0.5f;  // of its width, and less where bars pass each other aslant:
constexpr float kAside = 0.45f;      // sine of a slant off a diagonal that rows or columns see better
constexpr int kTurns = 4;            // pictures in which both diagonals have their turn
constexpr float kPassing = 0.83f;    // so much of the width by the slant's sine

/// The places of the bits of a word. Eight are written without asking how many there are.
inline int* append_bits(uint64_t bits, int base, int* to) {
    const int count = std::popcount(bits);
    for (int k = 0; k < count; k += 8)
        for (int j = k; j < k + 8; ++j, bits &= bits - 1) to[j] = base + std::countr_zero(bits);
    return to + count;
}

/// Where a line turns dark and bright again, in turns; returns how many dark runs. Beyond it all is bright.
ROUNDEL_CLONES int find_runs(const uint64_t* line, int words, int length, int* edges) {
    int* to = edges;
    uint64_t carry = 0;
    for (int n = 0; n < words; ++n) {
        to = append_bits(line[n] ^ (line[n] << 1 | carry), n * 64, to);
        carry = line[n] >> 63;
    }
    if (carry && (length & 63) == 0) *to++ = length;
    return int(to - edges) / 2;
}

/// Which bright runs lie in the middle of a roundel, by their lengths and those of the dark runs beside them.
/// All in sixteenths of a pixel, so that whole numbers do.
ROUNDEL_CLONES void test_chords(const int* edges, int count, const Proportions& limits, int* passes) {
    const Proportions p = limits;  // a copy that `passes` can't overlap
    for (int k = 0; k + 1 < count; ++k) {
        const int left = edges[2 * k + 1] - edges[2 * k], right = edges[2 * k + 3] - edges[2 * k + 2];
        const int inner = edges[2 * k + 2] - edges[2 * k + 1];
        const int dark = left < right ? left : right, uneven = left < right ? right : left;
        const int total = inner + 2 * dark;
        passes[k] = (total >= p.least) & (total <= p.most) & (16 * dark <= p.thick * inner + p.slack) &
                    (16 * dark + p.slack >= p.thin * inner) & (16 * uneven <= kUneven * dark + p.slack);
    }
}

/// The numbers of the `count` flags that are set.
ROUNDEL_CLONES int collect(const int* flags, int count, int* numbers) {
    int n = 0;
    for (int k = 0; k < count; ++k) {
        numbers[n] = k;
        n += flags[k];
    }
    return n;
}

/// The darkest of three pixels in the middle of a run: a thin ring is that dark on one of them only.
template <typename Level>
int darkest(const Level& level, int begin, int end) {
    const int middle = (begin + end) / 2;
    int least = level(middle);
    for (const int k : {middle - 1, middle + 1})
        if (k >= begin && k < end) least = std::min(least, level(k));
    return least;
}

}  // namespace

ChordSearch::ChordSearch(const Settings& settings) {
    const auto [low, high] = settings.ratio_range();
    const double r = std::max(0.05, low - settings.ratio_tolerance);
    const double R = std::min(0.95, high + settings.ratio_tolerance);
    // The shortest chord through the centre is the minor axis.
    const int thick = int(std::lround(16 * (1 - r) / (2 * r))),
              thin = int(std::lround(16 * (1 - R) / (2 * R)));
    fine_ = {int(0.65 * settings.min_diameter), int(settings.max_diameter + 2), thick, thin, kSlack};
    coarse_ = {kCoarseLeast, int(settings.max_diameter / 2.8) + 2, thick, thin, kCoarseSlack};
    min_contrast_ = int(settings.min_contrast / 2);
    partial_ = settings.search_share < 1;
}

bool ChordSearch::is_diametral(int dark, int inner) const {
    return dark > 0 && inner + 2 * dark <= limits_.most &&
           16 * dark <= limits_.thick * inner + limits_.slack &&
           16 * dark + limits_.slack >= limits_.thin * inner;
}

void ChordSearch::find_chords(const BitImage& along, int line) {
    chords_.clear();
    const int count = find_runs(along.line(line), along.words, along.length, edges_.data());
    if (count < 2) return;
    test_chords(edges_.data(), count, limits_, passes_.data());
    const int found = collect(passes_.data(), count - 1, numbers_.data());
    for (int k = 0; k < found; ++k) {
        const int* edge = &edges_[2 * size_t(numbers_[size_t(k)])];
        const int b = edge[1], c = edge[2];
        chords_.push_back({(b + c - 1) / 2, c - b, line, line, (b + c - 1) / 2, edge[3] - edge[0]});
    }
}

/// Puts the chords of a line on the stacks that they continue. Both are in the order of their middles.
void ChordSearch::link(int line) {
    next_.clear();
    auto chord = chords_.begin();
    for (const Stack& stack : open_) {
        while (chord != chords_.end() && chord->middle < stack.middle - kDrift) next_.push_back(*chord++);
        const bool same = chord != chords_.end() && chord->middle <= stack.middle + kDrift &&
                          std::abs(chord->inner - stack.inner) <= 2 + stack.inner / 4;
        if (same)
            next_.push_back({chord->middle, chord->inner, stack.first, line, stack.begin,
                             std::max(stack.outer, chord->outer)}),
                ++chord;
        else if (stack.last + 2 > line)
            next_.push_back(stack);
        else
            close(stack);
    }
    next_.insert(next_.end(), chord, chords_.end());
    open_.swap(next_);
}

/// A stack of two chords or more is tried across its middle.
void ChordSearch::close(const Stack& stack) {
    if (stack.first == stack.last) return;
    add_streak(stack);
    if (!across_) return;
    const BitImage& across = *across_;
    const int at = stack.middle, line = at / 2, middle = stack.first + stack.last;  // two pixels a line
    if (across.is_dark(line, middle)) return;
    const int b = across.run_begin(line, middle), c = across.run_end(line, middle);
    const int a = b > 0 ? across.run_begin(line, b - 1) : b;
    const int d = c < across.length ? across.run_end(line, c) : c;
    if (!is_diametral(b - a, c - b) && !is_diametral(d - c, c - b)) return;
    if (6 * (stack.last - stack.first + 1) < c - b) return;  // much of the hole's lines are diametral
    const auto level = [&](int k) -> int { return along_rows_ ? image_->row(k)[at] : image_->row(at)[k]; };
    const bool upper = b > a && (d == c || b - a <= d - c);
    const int m_d = upper ? darkest(level, a, b) : darkest(level, c, d), m_b = level((b + c - 1) / 2);
    if (m_b - m_d < min_contrast_) return;
    const float x = float(at), y = float(b + c - 1) / 2;
    const auto reach =
        float(std::max(c - b, stack.inner) + 2);  // of a slanted hole, twice what its chords do
    seeds_.push_back({along_rows_ ? x : y, along_rows_ ? y : x, reach, m_d, m_b});
}

/// A stack as long as the bars of a roundel that is smeared along it.
void ChordSearch::add_streak(const Stack& stack) {
    const int lines = stack.last - stack.first + 1;
    if (lines < kStreakLines) return;
    const Raster& r = raster_;
    const float drift = float(stack.middle - stack.begin) / float(lines - 1);
    const float x = r.line_x + drift * r.step_x, y = r.line_y + drift * r.step_y;  // along the bars
    const float per_line = 1 / std::hypot(x, y), step = std::hypot(r.step_x, r.step_y);
    const float sine = std::abs(r.step_x * x + r.step_y * y) * per_line / step;  // of the slant
    const float cosine = std::abs(r.step_x * y - r.step_y * x) * per_line / step;
    const float width = float(stack.outer) * step * cosine, length = float(lines) * cosine / per_line;
    if (!across_ && sine > kAside) return;
    if (width < kStreakWidth || length < kStreakLong * width * (cosine - kPassing * sine)) return;
    const float at = float(stack.middle + stack.begin) / 2, line = float(stack.first + stack.last) / 2;
    streaks_.push_back({r.x + at * r.step_x + line * r.line_x, r.y + at * r.step_y + line * r.line_y,
                        x * per_line, y * per_line, width});
}

void ChordSearch::scan(const BitImage& along, const BitImage* across, const Raster& raster,
                       const Proportions& limits) {
    across_ = across, along_rows_ = raster.step_y == 0, raster_ = raster, limits_ = limits;
    edges_.resize(size_t(along.length) + 80);  // append_bits writes up to 8 more than there are
    passes_.resize(edges_.size() / 2), numbers_.resize(edges_.size() / 2);
    open_.clear();
    for (int line = 0; line < along.lines; ++line) {
        find_chords(along, line);
        link(line);
    }
    for (const Stack& stack : open_) close(stack);
}

/// For smeared ones alone.
void ChordSearch::scan_diagonals() {
    for (const bool growing : {true, false}) {
        if (!both_ && turn_ != (growing ? 0 : kTurns / 2)) continue;
        shear(rows_, growing, diagonals_);
        const Raster raster =
            growing ? Raster{float(-2 * (rows_.lines - 1)), 0.5f, 2, 2, 4, 0} : Raster{0, 0.5f, -2, 2, 4, 0};
        scan(diagonals_, nullptr, raster, coarse_);
    }
    both_ = partial_, turn_ = (turn_ + 1) % kTurns;
}

const std::vector<Seed>& ChordSearch::run(const ImageView& image, const ThresholdMap& threshold) {
    seeds_.clear(), streaks_.clear();
    image_ = &image;
    binarise(image, threshold, rows_, columns_);
    scan(rows_, &columns_, {0, 0.5f, 1, 0, 0, 2}, fine_);
    scan(columns_, &rows_, {0.5f, 0, 0, 1, 2, 0}, fine_);
    scan_diagonals();
    return seeds_;
}

}  // namespace roundel
