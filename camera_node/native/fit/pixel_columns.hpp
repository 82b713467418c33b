// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "numeric/lanes.hpp"

namespace roundel {

/// Up to `Max` pixels as columns, in a frame of their own near a roundel. What fills the last eight has level
/// -1 and does not count.
template <int Max>
struct PixelColumns {
    static constexpr int kMax = Max;
    int origin_x = 0, origin_y = 0;  // of the frame, pixels of the image
    int count = 0;                   // whole lanes
    int used = 0;                    // pixels inside the image
    int expected = 0;                // and outside
    alignas(4 * kLanes) float x[kMax + kLanes], y[kMax + kLanes], level[kMax + kLanes];
    /// Ends the columns with whole lanes.
    void fill_up() {
        count = (used + kLanes - 1) / kLanes * kLanes;
        for (int k = used; k < count; ++k) x[k] = y[k] = 0, level[k] = -1;
    }
};

}  // namespace roundel
