// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "image.hpp"
#include "lanes.hpp"
#include "roundel_model.hpp"

namespace roundel {

/// Pixels near the edges of one roundel, as columns, in a frame of their own near it. What fills the last
/// eight has level -1 and does not count.
struct EdgePixels {
    static constexpr int kMax = 6144;
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

/// Which pixels, by their distance from the nearest edge: those within `narrow` in every row, and in every
/// third one those within `wide`, which tell of the levels.
struct Band {
    double narrow, wide;
    bool card;  // whether the card's edge is one of them
};

/// Fills `pixels` by the band along the edges that `p` says, in every n-th row: n is the least that leaves
/// about `limit` pixels or less, or ten rows. Gives n.
int select_pixels(const ImageView& image, const Parameters& p, const Band& band, int limit,
                  EdgePixels& pixels);

}  // namespace roundel
