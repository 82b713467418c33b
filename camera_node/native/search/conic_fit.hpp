// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <bit>
#include <cstdint>
#include <optional>

#include "numeric/ellipse.hpp"
#include "numeric/lanes.hpp"
#include "numeric/ray.hpp"

namespace roundel {

/// The points, as columns, at which rays cross the edges of the disc and of its hole, relative to the rays'
/// origin and in units of `unit` pixels. Values beyond `count` are 0.
struct Crossings {
    static constexpr int kMost = 2 * kRays;
    explicit Crossings(double length) : unit(length) {}
    alignas(4 * kLanes) float x[kMost]{}, y[kMost]{}, inner[kMost]{};  // inner is 1 or 0
    float ratio[kMost]{};   // inner over outer distance on the ray; 0 if it has only one
    float ratio_of[kRays];  // the same by ray, of those that cross both
    int ray[kMost]{}, count = 0;
    uint16_t seen[2]{};  // one bit per ray: whether it crosses the disc's edge, and the hole's
    double unit;
    void add(int number, float at, bool is_inner, float its_ratio) {
        const Direction direction = kDirections[size_t(number)];
        const float away = at / float(unit);
        x[count] = away * direction.x;
        y[count] = away * direction.y;
        inner[count] = is_inner;
        ratio_of[number] = ratio[count] = its_ratio;
        ray[count++] = number;
        seen[is_inner] |= uint16_t(1 << number);
    }
    int count_of(uint16_t rays) const {
        return std::popcount(uint16_t(seen[0] & rays)) + std::popcount(uint16_t(seen[1] & rays));
    }
};

/// The images of both circles, approximated by ellipses with the same centre and shape. The outer one is in
/// pixels relative to the rays' origin; `ratio` is inner over outer diameter.
struct CirclePair {
    Ellipse outer;
    double ratio;
};

/// Fewer crossings are never sufficient for `fit_ellipses`.
constexpr int kMinCrossings = 14;

/// Robust least-squares fit of both ellipses. Crossings that disagree with the others, as on an occluding
/// edge, are rejected. Returns nothing if fewer than nine crossings of either circle agree (six on the rays
/// of one half of the disc, or on both sides of a strip).
std::optional<CirclePair> fit_ellipses(const Crossings& crossings);

}  // namespace roundel
