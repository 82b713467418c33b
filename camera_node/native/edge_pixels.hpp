// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "image.hpp"
#include "pixel_columns.hpp"
#include "roundel_model.hpp"

namespace roundel {

/// Pixels near the edges of one roundel.
using EdgePixels = PixelColumns<6144>;

/// Which pixels, by their distance from the nearest edge: those within `narrow` in every row, and in every
/// third one those within `wide`, which tell of the levels.
struct Band {
    double narrow, wide;
    bool card;  // whether the card's edge is one of them
};

/// Fills `pixels` by the band along the edges that `p` says, in every n-th row: n is the least that leaves
/// about `limit` pixels or less, or ten rows.
void select_pixels(const ImageView& image, const Parameters& p, const Band& band, int limit,
                   EdgePixels& pixels);

/// The mean level of those that lie beyond the card's edge; the bright one where none do.
double level_beyond_card(const EdgePixels& pixels, const Parameters& p);

}  // namespace roundel
