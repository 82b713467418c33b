// SPDX-License-Identifier: BSD-3-Clause
#include "edge_pixels.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace roundel {

namespace {

constexpr int kMinRows = 10;  // fewer do not tell an ellipse

/// An ellipse, to be cut by rows.
class Outline {
  public:
    Outline() = default;
    /// The ellipse `e` with both half axes longer by `more`; nothing is left of it where one vanishes.
    Outline(const CircleImage& e, double more) : x_(e.x), y_(e.y) {
        const Eigen axes = eigen(e.shape);
        const double a = std::sqrt(axes.first) + more, b = std::sqrt(std::max(axes.second, 0.0)) + more;
        if (b <= 0) return;
        const double c = std::cos(axes.angle), s = std::sin(axes.angle);
        const double yy = a * a * s * s + b * b * c * c;
        height_ = std::sqrt(yy), width_ = a * b / height_, lean_ = (a * a - b * b) * c * s / yy;
    }
    double top() const { return y_ - height_; }
    double bottom() const { return y_ + height_; }
    /// Columns [begin, end) of row y that lie inside.
    struct Span {
        int begin, end;
    };
    Span cut(double y) const {
        const double t = (y - y_) / height_, left = 1 - t * t;
        if (!(height_ > 0) || left <= 0) return {0, 0};
        const double middle = x_ + lean_ * (y - y_), half = width_ * std::sqrt(left);
        return {int(std::ceil(middle - half)), int(std::floor(middle + half)) + 1};
    }

  private:
    double x_ = 0, y_ = 0, height_ = 0, width_ = 0, lean_ = 0;
};

/// The bands along the edges, from the outside in.
struct Bands {
    Outline from[3], to[3];
    double area;  // about
};

Bands bands(const Parameters& p, double band) {
    Bands b{};
    const double r[3] = {p[kCard], 1, p[kRatio]};
    for (int k = 0; k < 3; ++k) {
        const CircleImage e = circle_image(p, r[k]);
        b.from[k] = Outline(e, band), b.to[k] = Outline(e, -band);
        b.area += 2 * band * std::numbers::pi * std::sqrt(2 * (e.shape.xx + e.shape.yy));
    }
    const Symmetric& whole = circle_image(p, p[kCard]).shape;
    const double a = std::sqrt(whole.xx + whole.yy) + band;
    b.area = std::min(b.area, std::numbers::pi * a * a);
    return b;
}

/// Appends columns [begin, end) of row y, as far as they are inside the image.
void append(const ImageView& image, int y, int begin, int end, EdgePixels& to) {
    to.expected += std::max(0, end - begin);
    if (y < 0 || y >= image.height) return;
    begin = std::max(begin, 0), end = std::min({end, image.width, begin + EdgePixels::kMax - to.used});
    const uint8_t* row = image.row(y);
    float *x = to.x + to.used - begin, *level = to.level + to.used - begin;
    for (int u = begin; u < end; ++u) x[u] = float(u - to.origin_x), level[u] = float(row[u]);
    std::fill(to.y + to.used, to.y + to.used + std::max(0, end - begin), float(y - to.origin_y));
    to.used += std::max(0, end - begin);
}

/// Appends what row y has of the bands, left to right and each pixel once.
void append_row(const ImageView& image, int y, const Bands& bands, EdgePixels& to) {
    Outline::Span from[3], hole[3];
    for (int k = 0; k < 3; ++k)
        from[k] = bands.from[k].cut(y - to.origin_y), hole[k] = bands.to[k].cut(y - to.origin_y);
    int done = INT32_MIN / 2;
    const auto add = [&](int begin, int end) {
        append(image, y, std::max(begin, done) + to.origin_x, end + to.origin_x, to);
        done = std::max(done, end);
    };
    for (int k = 0; k < 3; ++k) add(from[k].begin, hole[k].begin < hole[k].end ? hole[k].begin : from[k].end);
    for (int k = 2; k >= 0; --k)
        if (hole[k].begin < hole[k].end) add(hole[k].end, from[k].end);
}

}  // namespace

int select_pixels(const ImageView& image, const Parameters& p, double band, int limit, EdgePixels& pixels) {
    const Bands all = bands(p, band);
    pixels.used = pixels.expected = 0;
    const int top = int(std::ceil(all.from[0].top())), bottom = int(std::floor(all.from[0].bottom()));
    const int step = std::max(1, std::min(int(std::ceil(all.area / limit)), (bottom - top) / kMinRows));
    for (int y = top; y <= bottom; y += step) append_row(image, y + pixels.origin_y, all, pixels);
    pixels.fill_up();
    return step;
}

}  // namespace roundel
