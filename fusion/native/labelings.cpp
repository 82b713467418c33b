// SPDX-License-Identifier: BSD-3-Clause
#include "labelings.hpp"

#include <algorithm>

namespace roundel::fusion {
namespace {

/// Branch and bound: a marker has one of its pairs or none.
class Search {
  public:
    Search(const MarkerPairs& pairs, int64_t least, double most, const LabelingLimits& limits)
        : pairs_(pairs), least_(least), most_(most), limits_(limits), rest_(pairs.n + 1) {
        for (size_t end = pairs.n; end > 0;) {
            size_t first = end - 1;
            double lowest = std::min(0.0, pairs.cost[first]);
            for (; first > 0 && pairs.marker[first - 1] == pairs.marker[end - 1]; --first)
                lowest = std::min(lowest, pairs.cost[first - 1]);
            rest_[first] = {end, 1 + rest_[end].markers, lowest + rest_[end].cost};
            end = first;
        }
    }

    std::vector<Labeling> run() {
        visit(0, 0);
        return std::move(found_);
    }

  private:
    /// From the first pair of a marker on: that of the next marker, how many markers there are, and the
    /// lowest cost of any choice among them.
    struct Rest {
        size_t next = 0;
        int64_t markers = 0;
        double cost = 0;
    };

    void visit(size_t first, double cost) {
        const Rest& rest = rest_[first];
        if (!(cost + rest.cost < most_) || int64_t(chosen_.size()) + rest.markers < least_) return;
        if (steps_ == limits_.steps || found_.size() == limits_.labelings) return;
        ++steps_;
        if (first == pairs_.n) {
            found_.push_back({chosen_, cost});
            return;
        }
        for (size_t k = first; k < rest.next; ++k) {
            if (is_used(pairs_.detection[k])) continue;
            chosen_.push_back(int64_t(k));
            visit(rest.next, cost + pairs_.cost[k]);
            chosen_.pop_back();
        }
        visit(rest.next, cost);
    }
    bool is_used(int64_t detection) const {
        return std::any_of(chosen_.begin(), chosen_.end(),
                           [&](int64_t k) { return pairs_.detection[k] == detection; });
    }

    const MarkerPairs& pairs_;
    const int64_t least_;
    const double most_;
    const LabelingLimits limits_;
    std::vector<Rest> rest_;
    std::vector<int64_t> chosen_;
    std::vector<Labeling> found_;
    size_t steps_ = 0;
};

}  // namespace

std::vector<Labeling> find_labelings(const MarkerPairs& pairs, int64_t least, double most,
                                     const LabelingLimits& limits) {
    return Search(pairs, least, most, limits).run();
}

}  // namespace roundel::fusion
