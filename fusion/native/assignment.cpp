// SPDX-License-Identifier: BSD-3-Clause
#include "assignment.hpp"

#include <algorithm>
#include <limits>

namespace roundel::fusion {
namespace {

// Cost of a marker without a detection: above any sum of costs within gates.
constexpr double kUnassigned = 1e4;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// The numbers of rows that occur, from 0 without gaps.
class Numbers {
  public:
    explicit Numbers(std::vector<int64_t> rows) : rows_(std::move(rows)) {
        std::sort(rows_.begin(), rows_.end());
        rows_.erase(std::unique(rows_.begin(), rows_.end()), rows_.end());
    }
    size_t size() const { return rows_.size(); }
    size_t of(int64_t row) const {
        return size_t(std::lower_bound(rows_.begin(), rows_.end(), row) - rows_.begin());
    }

  private:
    std::vector<int64_t> rows_;
};

/// The row of each column of `costs` (n x m, n <= m) at the lowest total cost, from 1; 0 for columns without
/// one. Each row in turn takes its column by the shortest augmenting path (Jonker and Volgenant 1987).
std::vector<size_t> rows_of_columns(const std::vector<double>& costs, size_t n, size_t m) {
    std::vector<double> of_row(n + 1), of_column(m + 1);  // dual variables
    std::vector<size_t> row(m + 1), before(m + 1);        // column 0 is the start of a path
    for (size_t i = 1; i <= n; ++i) {
        std::vector<double> length(m + 1, kInfinity);
        std::vector<char> is_reached(m + 1);
        size_t at = 0;
        for (row[0] = i; row[at] != 0;) {
            is_reached[at] = true;
            size_t nearest = 0;
            double step = kInfinity;
            for (size_t j = 1; j <= m; ++j) {
                if (is_reached[j]) continue;
                const double reduced = costs[(row[at] - 1) * m + j - 1] - of_row[row[at]] - of_column[j];
                if (reduced < length[j]) {
                    length[j] = reduced;
                    before[j] = at;
                }
                if (length[j] < step) {
                    step = length[j];
                    nearest = j;
                }
            }
            for (size_t j = 0; j <= m; ++j) {
                if (is_reached[j]) {
                    of_row[row[j]] += step;
                    of_column[j] -= step;
                } else {
                    length[j] -= step;
                }
            }
            at = nearest;
        }
        for (; at != 0; at = before[at]) row[at] = row[before[at]];
    }
    return row;
}

/// Adds the numbers of the pairs of one frame that are chosen, of those that share a marker or a detection.
void choose(const MarkerPairs& pairs, const std::vector<int64_t>& contested, std::vector<int64_t>& to) {
    std::vector<int64_t> markers, detections;
    for (const int64_t k : contested) {
        markers.push_back(pairs.marker[k]);
        detections.push_back(pairs.detection[k]);
    }
    const Numbers of_markers(std::move(markers)), of_detections(std::move(detections));
    const bool is_wide = of_markers.size() <= of_detections.size();
    const size_t n = std::min(of_markers.size(), of_detections.size());
    const size_t m = std::max(of_markers.size(), of_detections.size());
    const auto place = [&](int64_t k) {
        const size_t i = of_markers.of(pairs.marker[k]), j = of_detections.of(pairs.detection[k]);
        return is_wide ? std::pair(i, j) : std::pair(j, i);
    };
    std::vector<double> costs(n * m, kUnassigned);
    for (const int64_t k : contested) {
        const auto [i, j] = place(k);
        costs[i * m + j] = pairs.cost[k];
    }
    const std::vector<size_t> row = rows_of_columns(costs, n, m);
    for (const int64_t k : contested) {
        const auto [i, j] = place(k);
        if (row[j + 1] == i + 1) to.push_back(k);
    }
}

}  // namespace

std::vector<int64_t> assign(const MarkerPairs& pairs, const int64_t* frame, size_t n_detections) {
    std::vector<int> of_detection(n_detections);  // numbers of pairs
    for (size_t k = 0; k < pairs.n; ++k) ++of_detection[pairs.detection[k]];
    std::vector<int64_t> chosen, contested;
    const auto frame_of = [&](size_t k) { return frame[pairs.detection[k]]; };
    for (size_t first = 0, last = 0; first < pairs.n; first = last) {
        const auto is_same_view = [&](size_t k) {
            return pairs.marker[k] == pairs.marker[first] && frame_of(k) == frame_of(first);
        };
        while (last < pairs.n && is_same_view(last)) ++last;
        const bool is_alone = last == first + 1 && of_detection[pairs.detection[first]] == 1;
        for (size_t k = first; k < last; ++k) (is_alone ? chosen : contested).push_back(int64_t(k));
        const bool ends_frame = last == pairs.n || frame_of(last) != frame_of(first);
        if (ends_frame && !contested.empty()) {
            choose(pairs, contested, chosen);
            contested.clear();
        }
    }
    std::sort(chosen.begin(), chosen.end());
    return chosen;
}

}  // namespace roundel::fusion
