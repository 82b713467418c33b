// SPDX-License-Identifier: BSD-3-Clause
#include "lens/lens.hpp"

#include <cmath>

namespace roundel {

namespace {

constexpr double kStep = 1e-4;      // of the differences, in focal lengths
constexpr double kExact = 1e-7;     // pixels
constexpr int kNewtonSteps = 20;    // from the pixel itself
constexpr int kNearbySteps = 12;    // with a derivative a few tens of pixels away, which is off by percents
constexpr double kMaxTangent = 57;  // of the angle to the axis: 89 degrees

}  // namespace

Point Lens::distort(Point p) const {
    const double rr = p.x * p.x + p.y * p.y;
    if (is_fisheye_) {
        const double r = std::sqrt(rr), t = std::atan(r), tt = t * t;
        const double angle = t * (1 + tt * (k_[0] + tt * (k_[1] + tt * (k_[2] + tt * k_[3]))));
        const double scale = r > 1e-9 ? angle / r : 1;
        return {scale * p.x, scale * p.y};
    }
    const double radial =
        (1 + rr * (k_[0] + rr * (k_[1] + rr * k_[4]))) / (1 + rr * (k_[5] + rr * (k_[6] + rr * k_[7])));
    const double xy = 2 * p.x * p.y;
    return {p.x * radial + k_[2] * xy + k_[3] * (rr + 2 * p.x * p.x) + rr * (k_[8] + rr * k_[9]),
            p.y * radial + k_[2] * (rr + 2 * p.y * p.y) + k_[3] * xy + rr * (k_[10] + rr * k_[11])};
}

Point Lens::project(Point xy) const {
    const Point d = distort(xy);
    return {fx_ * d.x + cx_, fy_ * d.y + cy_};
}

LinearMap Lens::derivative(Point p) const {
    const Point right = project({p.x + kStep, p.y}), left = project({p.x - kStep, p.y});
    const Point down = project({p.x, p.y + kStep}), up = project({p.x, p.y - kStep});
    return {(right.x - left.x) / (2 * kStep), (down.x - up.x) / (2 * kStep), (right.y - left.y) / (2 * kStep),
            (down.y - up.y) / (2 * kStep)};
}

std::optional<Point> Lens::normalise(Point pixel) const {
    Point xy{(pixel.x - cx_) / fx_, (pixel.y - cy_) / fy_};
    for (int k = 0; k < kNewtonSteps; ++k) {
        const Point at = project(xy), off{pixel.x - at.x, pixel.y - at.y};
        if (std::hypot(off.x, off.y) < kExact) return xy;
        const LinearMap J = derivative(xy);
        // A lens whose distortion folds the picture has a determinant of 0 at the fold.
        if (!(J.det() > 0) || !(std::hypot(xy.x, xy.y) < kMaxTangent)) return std::nullopt;
        const Point step = J.inverse() * off;
        xy.x += step.x;
        xy.y += step.y;
    }
    return std::nullopt;
}

std::optional<Point> Lens::normalise_near(Point pixel, Point xy, const LinearMap& inverse) const {
    for (int k = 0; k < kNearbySteps; ++k) {
        const Point at = project(xy), off{pixel.x - at.x, pixel.y - at.y};
        if (std::hypot(off.x, off.y) < kExact) return xy;
        const Point step = inverse * off;
        xy.x += step.x;
        xy.y += step.y;
    }
    return std::nullopt;
}

}  // namespace roundel
