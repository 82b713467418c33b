// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "numeric/ellipse.hpp"
#include "numeric/image.hpp"

namespace roundel {

constexpr int kRays = 16;

struct Direction {
    float x, y;
    float per_x;  // 1 / abs(x), at most 1e6
    float per_y;  // 1 / abs(y), at most 1e6
};

inline const std::array<Direction, kRays> kDirections = [] {
    std::array<Direction, kRays> directions;
    for (int k = 0; k < kRays; ++k) {
        const double angle = 2 * std::numbers::pi * k / kRays;
        const auto x = float(std::cos(angle)), y = float(std::sin(angle));
        directions[size_t(k)] = {x, y, 1 / std::max(std::abs(x), 1e-6f), 1 / std::max(std::abs(y), 1e-6f)};
    }
    return directions;
}();

/// The bilinearly interpolated grey level; negative outside of the image.
inline float sample(const ImageView& image, float x, float y) {
    const int u = int(x), v = int(y);
    if (!(x >= 0 && y >= 0 && u < image.width - 1 && v < image.height - 1)) return -1;
    const uint8_t *upper = image.row(v) + u, *lower = upper + image.stride;
    const float a = x - float(u), b = y - float(v);
    const float above = float(upper[0]) + a * (float(upper[1]) - float(upper[0]));
    const float below = float(lower[0]) + a * (float(lower[1]) - float(lower[0]));
    return above + b * (below - above);
}

/// A ray that walks outwards from (x, y) pixel by pixel, up to the edge of the image.
class Ray {
  public:
    Ray(const ImageView& image, float x, float y, Direction d)
        : image_(image),
          x_(x),
          y_(y),
          d_(d),
          end_(std::min(room(x, d.x, d.per_x, image.width), room(y, d.y, d.per_y, image.height))) {}
    /// The first pixel before `limit` at which the ray becomes darker than `theta` (`dark`), or no longer is
    /// (not `dark`); negative if there is none. The next walk continues from there.
    template <bool dark>
    int walk(int theta, float limit) {
        const int last = int(std::min(limit, end_));
        int t = t_, u = u_ + t * du_, v = v_ + t * dv_;  // in 1/65536 of a pixel
        const auto is_there = [&] { return (image_.row(v >> 16)[u >> 16] < theta) == dark; };
        while (t < last && is_there()) {
            ++t;
            u += du_;
            v += dv_;
        }
        while (t < last && !is_there()) {
            ++t;
            u += du_;
            v += dv_;
        }
        t_ = t;
        return t < last ? t : -1;
    }
    /// The position at which the level is theta, near the pixel that a walk found.
    float between(int pixel, float theta) const {
        float t = float(std::max(pixel - 2, 0)), before = level(t);
        for (int k = 0; k < 3; ++k) {
            const float after = level(t + 1);
            if ((before < theta) != (after < theta)) return t + (theta - before) / (after - before);
            before = after;
            t += 1;
        }
        return float(pixel) - 0.5f;
    }

  private:
    /// The length of a ray up to half a pixel before the image's last pixel; 0 from outside of the image.
    static float room(float at, float step, float per_step, int length) {
        if (!(at >= 0 && at <= float(length - 1))) return 0;
        const float left = step > 0 ? float(length) - 1.5f - at : at - 0.5f;
        return left < 0 ? 0 : left * per_step;
    }
    float level(float t) const { return sample(image_, x_ + t * d_.x, y_ + t * d_.y); }

    const ImageView& image_;
    float x_, y_;
    Direction d_;
    float end_;
    int u_ = int(65536 * x_) + 32768, v_ = int(65536 * y_) + 32768;
    int du_ = int(65536 * d_.x), dv_ = int(65536 * d_.y);
    int t_ = 0;
};

/// An ellipse of which levels are read.
class EllipseLevels {
  public:
    explicit EllipseLevels(const Ellipse& e) : e_(e), cos_(std::cos(e.angle)), sin_(std::sin(e.angle)) {}
    /// Grey levels at kRays points on the ellipse scaled by `scale`; negative outside of the image.
    std::array<float, kRays> at(const ImageView& image, double scale) const {
        std::array<float, kRays> levels;
        for (size_t k = 0; k < kRays; ++k) {
            const Point p = point(k, scale);
            levels[k] = sample(image, p.x, p.y);
        }
        return levels;
    }
    struct Point {
        float x, y;
    };
    /// The k-th of these points.
    Point point(size_t k, double scale) const {
        const double along = scale * e_.major / 2 * double(kDirections[k].x),
                     across = scale * e_.minor / 2 * double(kDirections[k].y);
        return {float(e_.x + cos_ * along - sin_ * across), float(e_.y + sin_ * along + cos_ * across)};
    }

  private:
    const Ellipse& e_;
    double cos_, sin_;
};

}  // namespace roundel
