// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "labelings.hpp"

namespace roundel::fusion {

/// Chooses as many pairs as possible in each frame at the lowest total cost, without a common marker or
/// detection: the numbers of these pairs, ascending. `pairs` are in the order of their frames, then of their
/// markers; `frame` is that of each of N detections.
std::vector<int64_t> assign(const MarkerPairs& pairs, const int64_t* frame, size_t n_detections);

}  // namespace roundel::fusion
