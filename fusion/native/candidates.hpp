// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "outline.hpp"

namespace roundel::fusion {

/// A marker of a body that is followed. At a capture time tau after the instant the covariance of its place
/// in the world is at + tau rate + tau^2 drift.
struct ExpectedMarker {
    int64_t body;
    Vector marker;
    double radius;
    Matrix at, rate, drift;

    /// By its body's turn and covariance P (12 x 12) in order of the state's error.
    static ExpectedMarker of(int64_t body, const Vector& marker, double radius, const Matrix& R,
                             const double* P);
    Matrix covariance(double tau) const { return at + tau * rate + (tau * tau) * drift; }
};

/// N detections in order of their frames: undistorted centres, derivatives of pixels by these, noise in
/// pixels, and full major axes, NaN where unknown.
struct Detections {
    const int64_t* frame;
    Columns<2> xy;
    Columns<4> scale, cov;
    const double* major;

    size_t size() const { return xy.n; }
};

/// Detection `detection` may be of marker `marker`: `cost` is its negative log-likelihood, twice and but for
/// a constant (Bar-Shalom et al. 2001, section 6.4), by place and, where it is known, by size.
struct Candidate {
    int64_t marker, detection;
    double cost;
};

/// The pairs within the gates of markers that show their print. `focal` is that of each frame's camera.
std::vector<Candidate> find_candidates(const Poses& poses, const std::vector<ExpectedMarker>& markers,
                                       const Detections& seen, const double* focal);

}  // namespace roundel::fusion
