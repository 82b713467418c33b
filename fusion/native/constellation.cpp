// SPDX-License-Identifier: BSD-3-Clause
#include "constellation.hpp"

#include <cmath>
#include <utility>

namespace roundel::fusion {

MarkerCloud::MarkerCloud(std::vector<Vector> positions, std::vector<Matrix> covariances,
                         DistanceTolerance tolerance, double reach_m)
    : positions_(std::move(positions)),
      covariances_(std::move(covariances)),
      tolerance_(tolerance),
      near_(positions_.size()) {
    for (size_t a = 0; a < size(); ++a) {
        for (size_t b = 0; b < a; ++b) {
            const Neighbour there = neighbour(a, b);
            if (!(there.distance - there.tolerance < reach_m)) continue;
            near_[a].push_back(there);
            near_[b].push_back({a, there.distance, there.tolerance});
        }
    }
}

MarkerCloud::Neighbour MarkerCloud::neighbour(size_t a, size_t b) const {
    const Vector between = positions_[a] - positions_[b];
    const double distance = std::sqrt(dot(between, between));
    const Vector unit = (1 / std::fmax(distance, 1e-9)) * between;
    const double variance = dot(unit, (covariances_[a] + covariances_[b]) * unit);
    return {b, distance, tolerance_.slack_m + tolerance_.sigmas * std::sqrt(variance)};
}

bool MarkerCloud::allows(size_t a, size_t b, double distance_m) const {
    const Neighbour there = neighbour(a, b);
    return a != b && std::abs(there.distance - distance_m) < there.tolerance;
}

namespace {

class Search {
  public:
    Search(const MarkerCloud& cloud, const double* distances, size_t markers, const bool* usable,
           const SearchLimits& limits)
        : cloud_(cloud),
          distances_(distances),
          n_(markers),
          usable_(usable),
          limits_(limits),
          mapped_(markers, kUnseen),
          found_(markers + 1) {}

    Mappings run() {
        extend(0, 0);
        Mappings all;
        if (steps_ > limits_.steps) return {{}, false};
        for (size_t count = n_; count >= kMinMarkers && all.complete; --count) {
            all.complete = found_[count].size() <= limits_.mappings * n_;
            if (all.complete) all.points.insert(all.points.end(), found_[count].begin(), found_[count].end());
        }
        return all;
    }

  private:
    /// Maps the markers from `marker` on, of which the first `count` before it are mapped.
    void extend(size_t marker, size_t count) {
        if (marker == n_) {
            add(count);
            return;
        }
        for_candidates(marker, [&](size_t point) {
            mapped_[marker] = int64_t(point);
            extend(marker + 1, count + 1);
            mapped_[marker] = kUnseen;
            return true;
        });
        if (count + n_ - marker > kMinMarkers) extend(marker + 1, count);
    }

    /// Calls `use` with each point that marker can be, beside those mapped, until it returns false.
    template <class Use>
    void for_candidates(size_t marker, const Use& use) {
        size_t first = 0;
        while (first < n_ && mapped_[first] == kUnseen) ++first;
        if (first == n_) {
            for (size_t point = 0; point < cloud_.size(); ++point)
                if (usable_[point] && !use(point)) return;
            return;
        }
        const double distance = distances_[first * n_ + marker];
        const auto& near = cloud_.near(size_t(mapped_[first]));
        steps_ += near.size();
        if (steps_ > limits_.steps) return;
        for (const auto& there : near)
            if (std::abs(there.distance - distance) < there.tolerance && usable_[there.point] &&
                agrees(marker, there.point, first) && !use(there.point))
                return;
    }

    /// Whether the distances from a point to those mapped after the first are within tolerance.
    bool agrees(size_t marker, size_t point, size_t first) const {
        for (size_t other = first + 1; other < n_; ++other)
            if (mapped_[other] != kUnseen &&
                !cloud_.allows(size_t(mapped_[other]), point, distances_[other * n_ + marker]))
                return false;
        return true;
    }

    /// Adds the mapping unless a point can be added to it.
    void add(size_t count) {
        for (size_t marker = 0; marker < n_ && count < n_; ++marker) {
            bool extensible = false;
            if (mapped_[marker] == kUnseen)
                for_candidates(marker, [&](size_t) { return !(extensible = true); });
            if (extensible) return;
        }
        auto& same = found_[count];
        if (same.size() <= limits_.mappings * n_) same.insert(same.end(), mapped_.begin(), mapped_.end());
    }

    const MarkerCloud& cloud_;
    const double* distances_;
    const size_t n_;
    const bool* usable_;
    const SearchLimits limits_;
    std::vector<int64_t> mapped_;
    std::vector<std::vector<int64_t>> found_;  // by the number of mapped markers
    size_t steps_ = 0;
};

}  // namespace

Mappings find_mappings(const MarkerCloud& cloud, const double* distances, size_t markers, const bool* usable,
                       const SearchLimits& limits) {
    return Search(cloud, distances, markers, usable, limits).run();
}

}  // namespace roundel::fusion
