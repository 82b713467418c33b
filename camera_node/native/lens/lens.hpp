// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <optional>

#include "numeric/ellipse.hpp"

namespace roundel {

struct Point {
    double x, y;
};

inline Point operator*(const LinearMap& L, Point p) {
    return {L.xx * p.x + L.xy * p.y, L.yx * p.x + L.yy * p.y};
}

/// Intrinsics in OpenCV's models: pinhole with k1, k2, p1, p2, k3 to k6, s1 to s4, or `cv2.fisheye` with k1
/// to k4 (Kannala and Brandt 2006). `camera_node.geometry.lens` is the reference.
class Lens {
  public:
    static constexpr int kDistortion = 12;

    Lens(bool is_fisheye, double fx, double fy, double cx, double cy,
         const std::array<double, kDistortion>& distortion)
        : is_fisheye_(is_fisheye), fx_(fx), fy_(fy), cx_(cx), cy_(cy), k_(distortion) {}

    /// The pixel of a point x / z, y / z.
    Point project(Point xy) const;
    /// The point x / z, y / z of a pixel, by Newton's method; nothing where the lens has no inverse.
    std::optional<Point> normalise(Point pixel) const;
    /// The same for a pixel near one whose point and inverse derivative are known.
    std::optional<Point> normalise_near(Point pixel, Point start, const LinearMap& inverse) const;
    /// The derivative of `project`.
    LinearMap derivative(Point xy) const;

  private:
    Point distort(Point xy) const;

    bool is_fisheye_;
    double fx_, fy_, cx_, cy_;
    std::array<double, kDistortion> k_;
};

}  // namespace roundel
