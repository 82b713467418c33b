// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "columns.hpp"

/// Intersects viewing rays of different cameras, within the ranges that the apparent sizes allow.
namespace roundel::fusion {

/// Squared sine of 3 degrees: rays closer to parallel do not determine a range.
constexpr double kMinParallax = 0.00273905;

/// The camera of a frame, and its centre of projection.
struct Viewpoint {
    int64_t camera;
    Vector centre;
};

/// N viewing rays: frame, unit direction, tolerance (metres per metre of range), how far the fastest marker
/// moves between the time of the frame set and that of the ray (signed as the time), and the smallest and
/// largest possible range for each of K marker sizes.
struct Rays {
    const int64_t* frame;
    const Vector* direction;
    const double* reach;
    const double* moved;
    const double* ranges;  // N x K x 2
    size_t n, n_sizes;

    bool allows(size_t ray, double range) const;
    double max_range(size_t ray) const;
};

/// Two rays of different cameras that pass each other: the miss in tolerances of both, and the range on the
/// first one.
struct RayPair {
    int64_t first, second;
    double miss, range;
};

/// All pairs that miss each other by less than `most` tolerances, at ranges that the sizes allow.
std::vector<RayPair> ray_pairs(const Rays& rays, const std::vector<Viewpoint>& frames, double most);

/// The range of each ray on which most intersections agree, averaged over these; NaN without intersections.
std::vector<double> densest_ranges(const Rays& rays, const std::vector<Viewpoint>& frames);

}  // namespace roundel::fusion
