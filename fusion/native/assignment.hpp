// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "candidates.hpp"

namespace roundel::fusion {

constexpr double kUnmatched =
    1e4;  // cost of leaving a marker unseen: more than any sum of costs within gates

/// The rows of the pairs that are chosen: in every frame as many as there can be, no marker and no detection
/// twice, and of these choices the cheapest. `frame` is that of each detection; pairs come frame by frame.
std::vector<int64_t> assign(const std::vector<Candidate>& pairs, const int64_t* frame);

/// Of an n x m matrix of costs, n <= m, the column of each row: least in sum.
std::vector<size_t> cheapest_columns(const std::vector<double>& costs, size_t n, size_t m);

}  // namespace roundel::fusion
