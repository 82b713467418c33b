// SPDX-License-Identifier: BSD-3-Clause
#include "constellation.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace roundel::fusion {

namespace {

double length(const Vector& v) { return std::sqrt(dot(v, v)); }

}  // namespace

ViewAngles ViewAngles::of(const CloudPoint& point, const Vector& direction) {
    if (point.to_cameras.empty()) return {};
    double smallest = 1;  // cosine
    double largest = -1;  // cosine
    for (const Vector& to : point.to_cameras) {
        const double cosine = dot(direction, to) / std::fmax(length(direction) * length(to), 1e-12);
        smallest = std::fmin(smallest, cosine);
        largest = std::fmax(largest, cosine);
    }
    return {std::acos(std::fmin(largest, 1)), std::acos(std::fmax(smallest, -1))};
}

MarkerCloud::MarkerCloud(std::vector<CloudPoint> points, DistanceTolerance tolerance, double reach_m)
    : points_(std::move(points)), tolerance_(tolerance), near_(points_.size()) {
    for (size_t a = 0; a < size(); ++a) {
        for (size_t b = 0; b < a; ++b) {
            const Neighbour there = neighbour(a, b);
            if (!(there.distance - there.tolerance < reach_m)) continue;
            near_[a].push_back(there);
            near_[b].push_back({a, there.distance, there.tolerance, there.there, there.here});
        }
    }
}

MarkerCloud::Neighbour MarkerCloud::neighbour(size_t a, size_t b) const {
    const Vector between = points_[b].position - points_[a].position;
    const double distance = length(between);
    const Vector unit = (1 / std::fmax(distance, 1e-9)) * between;
    const double variance = dot(unit, (points_[a].covariance + points_[b].covariance) * unit);
    return {b, distance, tolerance_.slack_m + tolerance_.sigmas * std::sqrt(variance),
            ViewAngles::of(points_[a], between), ViewAngles::of(points_[b], -1 * between)};
}

const MarkerCloud::Neighbour* MarkerCloud::find(size_t a, size_t b) const {
    const auto& near = near_[a];
    const auto at = std::lower_bound(near.begin(), near.end(), b, [](const Neighbour& other, size_t point) {
        return other.point < point;
    });
    return at != near.end() && at->point == b ? &*at : nullptr;
}

namespace {

/// A marker of the constellation at a point of the cloud.
struct Pair {
    size_t marker, point;
};

/// Maximal cliques of pairs that agree, for one first pair after the other (Bron and Kerbosch 1973). Each
/// step branches over the pairs that contradict a pivot, the pair that agrees with most others: a maximal
/// clique contains the pivot or one of these (Tomita et al. 2006). So a body of many markers that are all
/// seen takes one branch.
class Search {
  public:
    Search(const MarkerCloud& cloud, const Constellation& constellation, const bool* usable,
           const SearchLimits& limits)
        : cloud_(cloud),
          constellation_(constellation),
          n_(constellation.size),
          usable_(usable),
          limits_(limits),
          mapped_(n_, kUnseen),
          found_(n_ + 1) {}

    Mappings run() {
        for (size_t marker = 0; marker + kMinMarkers <= n_; ++marker)
            for (size_t point = 0; point < cloud_.size(); ++point)
                if (usable_[point]) start({marker, point});
        Mappings all;
        if (steps_ > limits_.steps) return {{}, false};
        for (size_t count = n_; count >= kMinMarkers && all.complete; --count) {
            all.complete = found_[count].size() <= limits_.mappings * n_;
            if (all.complete) all.points.insert(all.points.end(), found_[count].begin(), found_[count].end());
        }
        return all;
    }

  private:
    using Rows = std::vector<size_t>;

    /// Finds the mappings in which `first` has the lowest marker.
    void start(const Pair& first) {
        later_.clear();
        for (size_t marker = first.marker + 1; marker < n_; ++marker) add_candidates(first, marker, later_);
        if (later_.size() + 1 < kMinMarkers || later_.front().marker == later_.back().marker) return;
        compare();
        Rows all(later_.size());
        for (size_t k = 0; k < all.size(); ++k) all[k] = k;
        mapped_[first.marker] = int64_t(first.point);
        lowest_ = first;
        extend(all, 1);
        mapped_[first.marker] = kUnseen;
    }

    /// Adds the pairs of a marker that agree with `first`.
    void add_candidates(const Pair& first, size_t marker, std::vector<Pair>& to) {
        const auto& near = cloud_.near(first.point);
        steps_ += near.size();
        for (const auto& there : near)
            if (usable_[there.point] && constellation_.allows(first.marker, marker, there))
                to.push_back({marker, there.point});
    }

    /// Which of the later pairs agree with each other.
    void compare() {
        const size_t n = later_.size();
        steps_ += n * n / 2;
        if (steps_ > limits_.steps) return;
        agree_.assign(n * n, false);
        for (size_t a = 0; a < n; ++a)
            for (size_t b = 0; b < a; ++b)
                agree_[a * n + b] = agree_[b * n + a] = agree(later_[a], later_[b]);
    }

    bool agree(const Pair& a, const Pair& b) const {
        const auto* there = a.marker != b.marker ? cloud_.find(a.point, b.point) : nullptr;
        return there && constellation_.allows(a.marker, b.marker, *there);
    }

    /// Extends the `count` mapped markers by later pairs (`rows`) that agree with all of them.
    void extend(Rows rows, size_t count) {
        if (rows.empty()) {
            add(count);
            return;
        }
        if (count + rows.size() < kMinMarkers || steps_ > limits_.steps) return;
        const size_t n = later_.size(), pivot = pivot_of(rows);
        Rows branches;
        for (const size_t k : rows)
            if (k == pivot || !agree_[pivot * n + k]) branches.push_back(k);
        for (const size_t k : branches) {
            Rows rest;
            for (const size_t other : rows)
                if (agree_[k * n + other]) rest.push_back(other);
            steps_ += rows.size();
            mapped_[later_[k].marker] = int64_t(later_[k].point);
            extend(std::move(rest), count + 1);
            mapped_[later_[k].marker] = kUnseen;
            rows.erase(std::find(rows.begin(), rows.end(), k));
        }
    }

    /// The pair that agrees with most of the others.
    size_t pivot_of(const Rows& rows) const {
        size_t best = rows.front(), most = 0;
        for (const size_t k : rows) {
            size_t count = 0;
            for (const size_t other : rows) count += agree_[k * later_.size() + other];
            if (count > most) {
                best = k;
                most = count;
            }
        }
        return best;
    }

    /// Adds the mapping unless a pair with an unmapped marker agrees with it.
    void add(size_t count) {
        if (count < kMinMarkers) return;
        for (size_t marker = 0; marker < n_; ++marker)
            if (mapped_[marker] == kUnseen && is_extensible(marker)) return;
        auto& same = found_[count];
        if (same.size() <= limits_.mappings * n_) same.insert(same.end(), mapped_.begin(), mapped_.end());
    }

    bool is_extensible(size_t marker) {
        others_.clear();
        add_candidates(lowest_, marker, others_);
        return std::any_of(others_.begin(), others_.end(),
                           [&](const Pair& pair) { return agrees_with_all(pair); });
    }

    bool agrees_with_all(const Pair& pair) const {
        for (size_t other = 0; other < n_; ++other)
            if (mapped_[other] != kUnseen && !agree(pair, {other, size_t(mapped_[other])})) return false;
        return true;
    }

    const MarkerCloud& cloud_;
    const Constellation& constellation_;
    const size_t n_;
    const bool* usable_;
    const SearchLimits limits_;
    std::vector<int64_t> mapped_;
    std::vector<std::vector<int64_t>> found_;  // by the number of mapped markers
    Pair lowest_{};                            // the mapped pair with the lowest marker
    std::vector<Pair> later_;                  // pairs that agree with it, with higher markers
    std::vector<Pair> others_;                 // pairs that agree with it, with one marker
    std::vector<char> agree_;                  // of later pairs with each other
    size_t steps_ = 0;
};

}  // namespace

Mappings find_mappings(const MarkerCloud& cloud, const Constellation& constellation, const bool* usable,
                       const SearchLimits& limits) {
    return Search(cloud, constellation, usable, limits).run();
}

}  // namespace roundel::fusion
