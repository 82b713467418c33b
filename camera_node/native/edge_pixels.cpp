// SPDX-License-Identifier: BSD-3-Clause
#include "edge_pixels.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numbers>

#include "simd.hpp"

namespace roundel {

namespace {

constexpr int kMinRows = 10;  // fewer do not tell an ellipse
constexpr int kEdges = 3;
constexpr int kWideRows = 3;  // one in so many
constexpr int kNowhere = INT32_MIN / 2;

double square(double x) { return x * x; }

ROUNDEL_INLINE Bits floor_of(const Lanes& x) {
    const Bits near = __builtin_convertvector(x, Bits);
    return near + (__builtin_convertvector(near, Lanes) > x);  // a comparison that is true is -1
}

/// What lies within a distance of the edges, card's, outer and inner, as ellipses to be cut by rows: lanes 0
/// to 2 are those around the edges, lanes 4 to 6 the holes within them. Other lanes are empty.
class Strips {
  public:
    Strips(const Parameters& p, double distance, bool card) {
        for (int k = card ? 0 : 1; k < kEdges; ++k) {
            const CircleImage e = circle_image(p, k == 0 ? p[kCard] : k == 1 ? 1 : p[kRatio]);
            set(k, e, distance), set(4 + k, e, -distance);
            area_ += 2 * distance * std::numbers::pi * std::sqrt(2 * (e.shape.xx + e.shape.yy));
            const double whole = std::numbers::pi * square(std::sqrt(e.shape.xx + e.shape.yy) + distance);
            most_ = std::max(most_, whole);
        }
    }
    double area() const { return std::min(area_, most_); }  // about
    double top() const { return top_; }
    double bottom() const { return bottom_; }

    /// Columns [begin, end) of row y that lie inside.
    struct Spans {
        Bits begin, end;
        bool has(int k) const { return begin[k] < end[k]; }
    };
    ROUNDEL_INLINE Spans cut(float y) const {
        const Lanes dy = y - y_, t = dy * per_height_, left = 1.0f - t * t;
        const Bits inside = left > 1e-6f;
        const Lanes share = inside ? left : all(1), half = width_ * share * inverse_sqrt(share);
        const Lanes middle = x_ + lean_ * dy;
        return {inside ? -floor_of(half - middle) : Bits{} + kNowhere,
                inside ? floor_of(middle + half) + 1 : Bits{} + kNowhere};
    }

  private:
    /// Lane k is the ellipse `e` with both half axes a and b longer by `more`; empty where one vanishes.
    void set(int k, const CircleImage& e, double more) {
        const double ab = std::sqrt(std::max(e.shape.det(), 0.0)),
                     sum = std::sqrt(e.shape.xx + e.shape.yy + 2 * ab);
        const double product = ab + more * (sum + more);  // (a + more) (b + more)
        if (!(product > 0 && sum + 2 * more > 0)) return;
        // (S^(1/2) + more)^2, where S^(1/2) = (S + a b) / (a + b)
        const double scale = 1 + 2 * more / sum, yy = scale * e.shape.yy + more * (2 * ab / sum + more);
        const double height = std::sqrt(yy);
        x_[k] = float(e.x), y_[k] = float(e.y), per_height_[k] = float(1 / height);
        width_[k] = float(product / height), lean_[k] = float(scale * e.shape.xy / yy);
        top_ = std::min(top_, e.y - height), bottom_ = std::max(bottom_, e.y + height);
    }

    Lanes x_{}, y_{}, per_height_ = all(1e6f), width_{}, lean_{};
    double area_ = 0, most_ = 0, top_ = 1e9, bottom_ = -1e9;
};

/// Eight grey levels, of which `left` are in the image. (Wider by two steps: compilers take bytes to words of
/// four times their size one by one.)
ROUNDEL_INLINE Lanes load_levels(const uint8_t* from, int left) {
    typedef uint8_t Bytes __attribute__((vector_size(2 * kLanes)));
    typedef int16_t Wide __attribute__((vector_size(4 * kLanes)));
    typedef uint64_t Pair __attribute__((vector_size(2 * kLanes)));
    uint64_t seen = 0;
    if (left >= kLanes)
        std::memcpy(&seen, from, kLanes);
    else
        for (int i = 0; i < left; ++i) seen |= uint64_t(from[i]) << (8 * i);
    const Wide wide = __builtin_convertvector(Bytes(Pair{seen, 0}), Wide);
    return __builtin_convertvector(
        __builtin_convertvector(__builtin_shufflevector(wide, wide, 0, 1, 2, 3, 4, 5, 6, 7), Bits), Lanes);
}

/// Appends columns [begin, end) of row y, as far as they are inside the image; eight at a time, where what is
/// written beyond the end is overwritten by what comes next.
ROUNDEL_INLINE void append(const ImageView& image, int y, int begin, int end, EdgePixels& to) {
    to.expected += std::max(0, end - begin);
    if (y < 0 || y >= image.height) return;
    begin = std::max(begin, 0), end = std::min({end, image.width, begin + EdgePixels::kMax - to.used});
    const uint8_t* row = image.row(y);
    constexpr Lanes kSteps{0, 1, 2, 3, 4, 5, 6, 7};
    for (int u = begin; u < end; u += kLanes) {
        const int at = to.used + u - begin;
        store(to.x + at, float(u - to.origin_x) + kSteps);
        store(to.y + at, all(float(y - to.origin_y)));
        store(to.level + at, load_levels(row + u, image.width - u));
    }
    to.used += std::max(0, end - begin);
}

/// Appends what row y has of the strips, left to right and each pixel once.
ROUNDEL_INLINE void append_row(const ImageView& image, int y, const Strips& strips, EdgePixels& to) {
    const Strips::Spans spans = strips.cut(float(y - to.origin_y));
    int begin[2 * kEdges], end[2 * kEdges];  // left of the middle, then right
    for (int k = 0; k < kEdges; ++k) {
        const bool hole = spans.has(4 + k);
        begin[k] = spans.begin[k], end[k] = hole ? spans.begin[4 + k] : spans.end[k];
        begin[2 * kEdges - 1 - k] = hole ? spans.end[4 + k] : kNowhere;
        end[2 * kEdges - 1 - k] = spans.end[k];
    }
    int done = kNowhere;
    for (int k = 0; k < 2 * kEdges; ++k) {
        const int from = std::max(begin[k], done);
        if (from < end[k]) append(image, y, from + to.origin_x, end[k] + to.origin_x, to), done = end[k];
    }
}

/// Every `step`-th row.
ROUNDEL_CLONES void append_rows(const ImageView& image, const Strips& narrow, const Strips& wide, int step,
                                EdgePixels& to) {
    const int top = int(std::ceil(wide.top())), bottom = int(std::floor(wide.bottom()));
    for (int y = top, k = 0; y <= bottom; y += step, ++k)
        append_row(image, y + to.origin_y, k % kWideRows ? narrow : wide, to);
}

struct Mean {
    Lanes sum, n;
};

ROUNDEL_CLONES void add_outside(const EdgePixels& pixels, const CircleImage& card, Mean& mean) {
    const double det = card.shape.det();
    const float xx = float(card.shape.yy / det), xy = float(-2 * card.shape.xy / det);
    const float yy = float(card.shape.xx / det), x0 = float(card.x), y0 = float(card.y);
    for (int k = 0; k < pixels.count; k += kLanes) {
        const Lanes dx = load(pixels.x + k) - x0, dy = load(pixels.y + k) - y0,
                    level = load(pixels.level + k);
        const Bits outside = (dx * (xx * dx + xy * dy) + yy * dy * dy > 1.0f) & (level >= 0.0f);
        mean.sum += outside ? level : all(0), mean.n += outside ? all(1) : all(0);
    }
}

}  // namespace

double level_beyond_card(const EdgePixels& pixels, const Parameters& p) {
    Mean mean{};
    add_outside(pixels, circle_image(p, p[kCard]), mean);
    const double n = double(sum(mean.n));
    return n > 0 ? double(sum(mean.sum)) / n : p[kBright];
}

void select_pixels(const ImageView& image, const Parameters& p, const Band& band, int limit,
                   EdgePixels& pixels) {
    const Strips narrow(p, band.narrow, band.card), wide(p, band.wide, band.card);
    const double area = narrow.area() + (wide.area() - narrow.area()) / kWideRows;
    pixels.used = pixels.expected = 0;
    const int rows = int(wide.bottom() - wide.top());
    const int step = std::max(1, std::min(int(std::ceil(area / limit)), rows / kMinRows));
    append_rows(image, narrow, wide, step, pixels);
    pixels.fill_up();
}

}  // namespace roundel
