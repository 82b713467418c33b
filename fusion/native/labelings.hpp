// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

namespace roundel::fusion {

/// Pairs of markers and detections, and what each costs.
struct MarkerPairs {
    const int64_t *marker, *detection;
    const double* cost;
    size_t n;
};

/// Pairs without a common marker or detection, and the sum of their costs.
struct Labeling {
    std::vector<int64_t> pairs;
    double cost;
};

/// The largest work for one frame: steps of the search, and labelings.
struct LabelingLimits {
    size_t steps, labelings;
};

/// Finds the labelings of pairs by ascending marker: those of `least` pairs or more that cost less than
/// `most`, depth first by marker.
std::vector<Labeling> find_labelings(const MarkerPairs& pairs, int64_t least, double most,
                                     const LabelingLimits& limits);

}  // namespace roundel::fusion
