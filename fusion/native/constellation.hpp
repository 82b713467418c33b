// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>
#include <cstdint>
#include <vector>

#include "columns.hpp"

namespace roundel::fusion {

/// How exactly the distances of triangulated markers are known: slack_m + sigmas standard deviations.
struct DistanceTolerance {
    double slack_m, sigmas;
};

/// A triangulated marker: its position, covariance, and the vectors to the cameras that saw it.
struct CloudPoint {
    Vector position;
    Matrix covariance;
    std::vector<Vector> to_cameras;
};

/// The smallest and the largest angle at a marker between the direction to another one and those to its
/// cameras.
struct ViewAngles {
    double smallest = kRightAngle, largest = kRightAngle;

    static constexpr double kRightAngle = 1.5707963267948966;

    static ViewAngles of(const CloudPoint& point, const Vector& direction);
    /// Whether all cameras can see a print whose normal has this angle with the direction. The angle between
    /// the normal and a camera is at least the difference of both angles, and below 90 degrees.
    bool allow(double normal_angle, double slack) const {
        return largest < normal_angle + kRightAngle + slack && smallest > normal_angle - kRightAngle - slack;
    }
};

/// Triangulated markers, and for each the others within the reach of a constellation.
class MarkerCloud {
  public:
    /// A neighbour of a marker: its number, the distance, the tolerance of the distance, and the views of the
    /// marker itself and of the neighbour relative to the line between them.
    struct Neighbour {
        size_t point;
        double distance, tolerance;
        ViewAngles here, there;
    };

    /// `reach_m` is the largest distance between two markers of one constellation.
    MarkerCloud(std::vector<CloudPoint> points, DistanceTolerance tolerance, double reach_m);

    size_t size() const { return points_.size(); }
    const std::vector<Neighbour>& near(size_t point) const { return near_[point]; }

    /// The neighbour `b` of `a`; null if they are farther apart than the reach.
    const Neighbour* find(size_t a, size_t b) const;

  private:
    Neighbour neighbour(size_t a, size_t b) const;

    std::vector<CloudPoint> points_;
    DistanceTolerance tolerance_;
    std::vector<std::vector<Neighbour>> near_;  // each sorted by point
};

/// The M markers of a constellation: distances between them, and angles of their normals to the directions
/// from one marker (row) to another one (column); M x M.
struct Constellation {
    size_t size;
    const double *distances, *angles;

    /// Whether markers `m` and `k` can be at a point and its neighbour.
    bool allows(size_t m, size_t k, const MarkerCloud::Neighbour& at) const {
        const size_t forth = m * size + k, back = k * size + m;
        const double slack = at.tolerance / std::fmax(at.distance, 1e-9);
        return std::abs(at.distance - distances[forth]) < at.tolerance &&
               at.here.allow(angles[forth], slack) && at.there.allow(angles[back], slack);
    }
};

/// The largest work for one constellation: steps of the search, and mappings with one number of markers.
struct SearchLimits {
    size_t steps, mappings;
};

constexpr int64_t kUnseen = -1;
constexpr size_t kMinMarkers = 3;  // of an identified constellation

/// Mappings of a constellation to points, one after the other: for each of its markers a point or `kUnseen`.
struct Mappings {
    std::vector<int64_t> points;
    bool complete = true;  // false: there are more, with as many markers as the limit allows or fewer
};

/// Finds all maximal mappings of three or more markers with all distances within tolerance, whose normals
/// allow the views. Of mappings with too many alternatives it returns none.
///
/// `usable` says which points may be markers.
Mappings find_mappings(const MarkerCloud& cloud, const Constellation& constellation, const bool* usable,
                       const SearchLimits& limits);

}  // namespace roundel::fusion
