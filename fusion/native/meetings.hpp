// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "columns.hpp"

/// Where viewing rays of different cameras meet, by epipolar geometry and by the range that sizes allow.
namespace roundel::fusion {

/// Squared sine of 3 degrees: rays nearer to parallel tell no range.
constexpr double kMinParallax = 0.00273905;

/// A frame's camera, where it stood, and how far the fastest marker moves from the instant until the frame.
struct Viewpoint {
    int64_t camera;
    Vector centre;
    double moved;
};

/// N viewing rays: the frame that each is of, its unit direction, how far it may be off (metres by metre of
/// range), and for each of K sizes of marker the least and the largest range that it can have.
struct Rays {
    const int64_t* frame;
    const Vector* direction;
    const double* reach;
    const double* ranges;  // N x K x 2
    size_t n, n_sizes;

    bool fits(size_t ray, double range) const;
    double farthest(size_t ray) const;
};

/// (N,) the range at which most others meet a ray, the mean of those that agree; NaN where none does.
std::vector<double> densest_ranges(const Rays& rays, const std::vector<Viewpoint>& frames);

}  // namespace roundel::fusion
