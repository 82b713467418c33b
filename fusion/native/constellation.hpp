// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstdint>
#include <vector>

#include "geometry.hpp"

namespace roundel::fusion {

/// How exactly the distances of triangulated markers are known: slack_m + sigmas standard deviations.
struct DistanceTolerance {
    double slack_m, sigmas;
};

/// Triangulated markers, and for each the others within the reach of a constellation.
class MarkerCloud {
  public:
    /// A neighbour of a marker: its number, the distance, and the tolerance of the distance.
    struct Neighbour {
        size_t point;
        double distance, tolerance;
    };

    /// `reach_m` is the largest distance between two markers of one constellation.
    MarkerCloud(std::vector<Vector> positions, std::vector<Matrix> covariances, DistanceTolerance tolerance,
                double reach_m);

    size_t size() const { return positions_.size(); }
    const std::vector<Neighbour>& near(size_t point) const { return near_[point]; }

    /// Whether two points can be `distance_m` apart.
    bool allows(size_t a, size_t b, double distance_m) const;

  private:
    Neighbour neighbour(size_t a, size_t b) const;

    std::vector<Vector> positions_;
    std::vector<Matrix> covariances_;
    DistanceTolerance tolerance_;
    std::vector<std::vector<Neighbour>> near_;
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

/// Finds all maximal mappings of three or more markers with all distances within tolerance. Of mappings with
/// too many alternatives it returns none.
///
/// `distances` are those between the constellation's M markers, M x M; `usable` says which points may be
/// markers.
Mappings find_mappings(const MarkerCloud& cloud, const double* distances, size_t markers, const bool* usable,
                       const SearchLimits& limits);

}  // namespace roundel::fusion
