// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "outline.hpp"

namespace roundel::fusion {

constexpr double kSlackPx = 0.7;  // calibration error, added to the noise of detections in gates

/// A marker of a tracked body. The covariance of its world position at a capture time tau after the time of
/// the states is at + tau rate + tau^2 drift.
struct ExpectedMarker {
    int64_t body, code;  // 0 for no code
    DiscOnBody disc;
    Matrix at, rate, drift;

    /// From the rotation R and the state covariance P (12 x 12) of its body.
    static ExpectedMarker of(int64_t body, int64_t code, const DiscOnBody& disc, const Matrix& R,
                             const double* P);
    Matrix covariance(double tau) const { return at + tau * rate + (tau * tau) * drift; }
};

/// The covariance of the world position of a point of a body, from its rotation and state covariance.
Matrix position_covariance(const Vector& position, const Matrix& R, const double* P);

/// Markers, and the bounds of each group of successive markers of one body.
class ExpectedMarkers {
  public:
    /// A sphere around the origin of the body contains its discs; the variance of their positions in any
    /// direction is at + |tau| rate + tau^2 drift at most.
    struct Group {
        int64_t body;
        size_t first, last;
        double radius, at, rate, drift;
    };

    explicit ExpectedMarkers(std::vector<ExpectedMarker> markers);
    const std::vector<ExpectedMarker>& all() const { return markers_; }
    const std::vector<Group>& groups() const { return groups_; }

  private:
    std::vector<ExpectedMarker> markers_;
    std::vector<Group> groups_;
};

/// N detections sorted by frame: undistorted centres, Jacobians of raw pixels with respect to them, pixel
/// covariances, full major axes (NaN where unknown), the codes (-1 for none), and the times from the frame to
/// the capture of the detection's row by a rolling shutter, seconds.
struct Detections {
    const int64_t* frame;
    Columns<2> xy;
    Columns<4> scale, cov;
    const double *major, *code, *delay;

    size_t size() const { return xy.n; }
};

/// A pair of a marker and a detection within its gates. `cost` is twice the negative log-likelihood up to a
/// constant (Bar-Shalom et al. 2001, section 6.4), from the position and, where known, the size.
struct Candidate {
    int64_t marker, detection;
    double cost;
};

/// Finds the candidates of all markers that face their camera, by frame. `focal` is the focal length of each
/// frame's camera in pixels.
///
/// A detection with another code is none: a code is certain to 1e-6, and twice the negative logarithm of that
/// is above the gates of association.
std::vector<Candidate> find_candidates(const FramePoses& poses, const ExpectedMarkers& markers,
                                       const Detections& detections, const double* focal);

}  // namespace roundel::fusion
