// SPDX-License-Identifier: BSD-3-Clause
#include "assignment.hpp"

#include <algorithm>
#include <numeric>

namespace roundel::fusion {
namespace {

/// Sets of things that belong together (Tarjan 1975).
class Sets {
  public:
    explicit Sets(size_t n) : parent_(n) { std::iota(parent_.begin(), parent_.end(), size_t(0)); }
    size_t of(size_t k) {
        while (parent_[k] != k) k = parent_[k] = parent_[parent_[k]];
        return k;
    }
    void join(size_t a, size_t b) { parent_[of(a)] = of(b); }

  private:
    std::vector<size_t> parent_;
};

/// Numbers from 0 of the markers or the detections of some pairs.
class Numbering {
  public:
    Numbering(const std::vector<Candidate>& pairs, const size_t* rows, size_t count,
              int64_t Candidate::* key) {
        for (size_t k = 0; k < count; ++k) keys_.push_back(pairs[rows[k]].*key);
        std::sort(keys_.begin(), keys_.end());
        keys_.erase(std::unique(keys_.begin(), keys_.end()), keys_.end());
    }
    size_t of(int64_t key) const {
        return size_t(std::lower_bound(keys_.begin(), keys_.end(), key) - keys_.begin());
    }
    size_t size() const { return keys_.size(); }

  private:
    std::vector<int64_t> keys_;
};

/// Adds the chosen ones of pairs that contest each other's markers and detections.
void settle(const std::vector<Candidate>& pairs, const size_t* rows, size_t count,
            std::vector<int64_t>& chosen) {
    auto few = &Candidate::marker, many = &Candidate::detection;
    if (Numbering(pairs, rows, count, few).size() > Numbering(pairs, rows, count, many).size())
        std::swap(few, many);
    const Numbering of_row(pairs, rows, count, few), of_column(pairs, rows, count, many);
    const size_t n = of_row.size(), m = of_column.size();
    std::vector<double> costs(n * m, kUnmatched);
    std::vector<int64_t> row_of(n * m, -1);
    for (size_t k = 0; k < count; ++k) {
        const Candidate& pair = pairs[rows[k]];
        const size_t cell = of_row.of(pair.*few) * m + of_column.of(pair.*many);
        costs[cell] = pair.cost, row_of[cell] = int64_t(rows[k]);
    }
    const std::vector<size_t> columns = cheapest_columns(costs, n, m);
    for (size_t i = 0; i < n; ++i)
        if (const int64_t row = row_of[i * m + columns[i]]; row >= 0) chosen.push_back(row);
}

/// Joins the pairs first to last that have a marker or a detection in common.
void join(const std::vector<Candidate>& pairs, size_t first, size_t last, int64_t Candidate::* key,
          std::vector<size_t>& seen, Sets& sets) {
    for (size_t k = first; k < last; ++k) {
        size_t& before = seen[size_t(pairs[k].*key)];
        if (before < k && before >= first) sets.join(before, k);
        before = k;
    }
}

size_t beyond(const std::vector<Candidate>& pairs, int64_t Candidate::* key) {
    int64_t most = -1;
    for (const Candidate& pair : pairs) most = std::max(most, pair.*key);
    return size_t(most + 1);
}

}  // namespace

std::vector<int64_t> assign(const std::vector<Candidate>& pairs, const int64_t* frame) {
    const size_t n = pairs.size();
    Sets sets(n);
    std::vector<size_t> of_marker(beyond(pairs, &Candidate::marker), n),
        of_detection(beyond(pairs, &Candidate::detection), n);
    for (size_t first = 0, last = 0; first < n; first = last) {
        while (last < n && frame[pairs[last].detection] == frame[pairs[first].detection]) ++last;
        join(pairs, first, last, &Candidate::marker, of_marker, sets);
        join(pairs, first, last, &Candidate::detection, of_detection, sets);
    }
    std::vector<size_t> count(n), contested;
    for (size_t k = 0; k < n; ++k) ++count[sets.of(k)];
    std::vector<int64_t> chosen;
    for (size_t k = 0; k < n; ++k) {
        if (count[sets.of(k)] == 1)
            chosen.push_back(int64_t(k));
        else
            contested.push_back(k);
    }
    std::stable_sort(contested.begin(), contested.end(),
                     [&](size_t a, size_t b) { return sets.of(a) < sets.of(b); });
    for (size_t k = 0; k < contested.size(); k += count[sets.of(contested[k])])
        settle(pairs, contested.data() + k, count[sets.of(contested[k])], chosen);
    return chosen;
}

// Shortest augmenting paths, one a row, by reduced costs (Jonker and Volgenant 1987; Crouse 2016,
// "On implementing 2D rectangular assignment algorithms", algorithm 1).
std::vector<size_t> cheapest_columns(const std::vector<double>& costs, size_t n, size_t m) {
    const size_t none = m;  // a column more, where each path begins
    std::vector<double> row_price(n, 0), column_price(m + 1, 0), shortest(m + 1);
    std::vector<size_t> row_of(m + 1, n), before(m + 1);
    std::vector<char> done(m + 1);
    for (size_t row = 0; row < n; ++row) {
        std::fill(shortest.begin(), shortest.end(), std::numeric_limits<double>::infinity());
        std::fill(done.begin(), done.end(), char(0));
        size_t column = none;
        row_of[none] = row;
        while (row_of[column] < n) {
            done[column] = 1;
            const size_t i = row_of[column];
            size_t nearest = none;
            double least = std::numeric_limits<double>::infinity();
            for (size_t j = 0; j < m; ++j) {
                if (done[j]) continue;
                const double reduced = costs[i * m + j] - row_price[i] - column_price[j];
                if (reduced < shortest[j]) shortest[j] = reduced, before[j] = column;
                if (shortest[j] < least) least = shortest[j], nearest = j;
            }
            for (size_t j = 0; j <= m; ++j) {
                if (done[j])
                    row_price[row_of[j]] += least, column_price[j] -= least;
                else
                    shortest[j] -= least;
            }
            column = nearest;
        }
        for (; column != none; column = before[column]) row_of[column] = row_of[before[column]];
    }
    std::vector<size_t> columns(n);
    for (size_t j = 0; j < m; ++j)
        if (row_of[j] < n) columns[row_of[j]] = j;
    return columns;
}

}  // namespace roundel::fusion
