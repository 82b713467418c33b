// SPDX-License-Identifier: BSD-3-Clause
#include "blur/sums.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "numeric/gram.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kColumns = kMovingCount + 1;  // the gradient and the residual
constexpr double kMargin = 2.5;             // pixels around the disc's path

struct LaneSums {
    Gram<kColumns> gram;
    Lanes w, ring, ring_rr, ground, ground_rr, ground_ground;
};

ROUNDEL_INLINE void weigh(const MovingGradient& model, const Lanes& level, float spread, int k,
                          Columns<kColumns>& columns, LaneSums& sums) {
    const Lanes r = level - model.level[k], share = model.by[kStill + kGround][k], gg = share * share;
    const Bits counts = ~is_uninformative(level, model.level[k]);
    const Lanes w = counts ? 1.0f / (1.0f + spread * gg) : all(0);
    const Lanes root = w > 0.0f ? w * inverse_sqrt(w > 0.0f ? w : all(1)) : all(0);
    const Lanes &bx = model.by[kStill + kX][k], &by = model.by[kStill + kY][k];
    const Lanes slope = w * (bx * bx + by * by), seen = counts ? gg : all(0);
    for (int i = 0; i < kMovingCount; ++i) columns[i][k] = root * model.by[i][k];
    columns[kMovingCount][k] = root * r;
    sums.w += w;
    sums.ring += slope;
    sums.ring_rr += slope * r * r;
    sums.ground += seen;
    sums.ground_rr += seen * r * r;
    sums.ground_ground += seen * gg;
}

ROUNDEL_CLONES void add_up(const MovingPixels& pixels, const MovingModel& model, float spread,
                           LaneSums& sums) {
    MovingGradient gradient;
    Columns<kColumns> columns;
    for (int begin = 0; begin < pixels.count; begin += kChunk * kLanes) {
        const int count = std::min(kChunk, (pixels.count - begin) / kLanes);
        model.evaluate(pixels.x + begin, pixels.y + begin, count, gradient);
        for (int k = 0; k < count; ++k)
            weigh(gradient, load(pixels.level + begin + k * kLanes), spread, k, columns, sums);
        multiply_all<kColumns>(columns, count, sums.gram);
    }
}

/// The path of a disc's centre, for distances of points from it in radii of the disc.
class DiscPath {
  public:
    explicit DiscPath(const MovingParameters& p) : p_(still(p)) {
        det_ = p_[kAxx] * p_[kAyy] - p_[kAxy] * p_[kAxy];
        to_radii(p[kMotionX], p[kMotionY], u_, v_);
        length_ = u_ * u_ + v_ * v_ + 1e-12;
    }
    /// Square of the distance.
    double distance2(double x, double y) const {
        double u, v;
        to_radii(x - p_[kX], y - p_[kY], u, v);
        const double t = std::clamp((u * u_ + v * v_) / length_, -0.5, 0.5);
        return square(u - t * u_) + square(v - t * v_);
    }

  private:
    void to_radii(double x, double y, double& u, double& v) const {
        u = (p_[kAyy] * x - p_[kAxy] * y) / det_;
        v = (p_[kAxx] * y - p_[kAxy] * x) / det_;
    }
    Parameters p_;
    double det_, u_, v_, length_;
};

void append(const ImageView& image, int x, int y, MovingPixels& to) {
    const int u = x + to.origin_x, v = y + to.origin_y;
    ++to.expected;
    if (u < 0 || v < 0 || u >= image.width || v >= image.height || to.used == MovingPixels::kMax) return;
    to.x[to.used] = float(x);
    to.y[to.used] = float(y);
    to.level[to.used++] = float(image.row(v)[u]);
}

}  // namespace

void select_moving(const ImageView& image, const MovingParameters& p, int limit, MovingPixels& pixels) {
    const DiscPath path(p);
    const Eigen axes = eigen(circle_image(still(p), 1).shape);
    const double a = std::sqrt(axes.first), b = std::sqrt(axes.second);
    const double reach = 1 + kMargin / b, x0 = p[kStill + kX], y0 = p[kStill + kY];
    const double half_w = a * reach + std::abs(p[kMotionX]) / 2,
                 half_h = a * reach + std::abs(p[kMotionY]) / 2;
    const double area = reach * b * (std::numbers::pi * a * reach + 2 * std::hypot(p[kMotionX], p[kMotionY]));
    const int step = std::max(1, int(std::lround(std::sqrt(area / limit))));
    pixels.used = pixels.expected = 0;
    for (int y = int(y0 - half_h); y <= int(y0 + half_h); y += step)
        for (int x = int(x0 - half_w); x <= int(x0 + half_w); x += step)
            if (path.distance2(x, y) < reach * reach) append(image, x, y, pixels);
    pixels.pad();
}

MovingSums accumulate(const MovingPixels& pixels, const MovingParameters& p, double spacing, double spread) {
    LaneSums sums{};
    add_up(pixels, MovingModel(p, spacing), float(spread), sums);
    MovingSums e;
    auto& [H, g] = e.system;
    for (int i = 0; i < kMovingCount; ++i) {
        for (int j = 0; j <= i; ++j) H[i][j] = sum(sums.gram[j][i]);
        g[i] = sum(sums.gram[i][kMovingCount]);
    }
    e.wrr = sum(sums.gram[kMovingCount][kMovingCount]);
    e.w = sum(sums.w);
    e.ring = sum(sums.ring);
    e.ring_rr = sum(sums.ring_rr);
    e.ground = sum(sums.ground);
    e.ground_rr = sum(sums.ground_rr);
    e.ground_ground = sum(sums.ground_ground);
    return e;
}

}  // namespace roundel
