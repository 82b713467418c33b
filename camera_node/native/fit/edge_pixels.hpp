// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>

#include "numeric/image.hpp"
#include "fit/pixel_columns.hpp"
#include "fit/roundel_model.hpp"

namespace roundel {

/// Pixels near the edges of one roundel, part by part: those of one edge each, or of all of them.
struct EdgePixels : PixelColumns<6144> {
    struct Part {
        Edge edge;
        int begin, count;  // whole lanes
    };
    std::array<Part, kEdges> parts;
    int part_count = 0;

    void clear() { used = expected = count = part_count = padding_ = 0; }
    /// Of pixels that are not told apart, the first `n`.
    void keep(int n) {
        expected -= used - n, used = n, count = part_count = padding_ = 0;
        end_part(kAnyEdge);
    }
    /// Every `n`-th lane of each part.
    void sample(int n, EdgePixels& to) const;
    int end() const { return used + padding_; }
    /// Makes a part of what was added since the last one.
    void end_part(Edge edge) {
        while (end() % kLanes) x[end()] = y[end()] = 0, level[end()] = -1, ++padding_;
        parts[size_t(part_count++)] = {edge, count, end() - count}, count = end();
    }

  private:
    int padding_ = 0;
};

/// Which pixels, by their distance from the nearest edge: those within `narrow` in every row, and in every
/// third one those within `wide`, which tell of the levels.
struct Band {
    double narrow, wide;
    bool card;         // whether the card's edge is one of them
    double apart = 0;  // `wide` where pixels that see one edge only are told apart; 0 if none may be
};

/// Fills `pixels` by the band along the edges that `p` says, in every n-th row: n is the least that leaves
/// about `limit` pixels or less, or ten rows.
///
/// Where edges are so far from each other that no pixel within `narrow` sees two of them, each has a part of
/// its own, and the wide one ends before the next one.
void select_pixels(const ImageView& image, const Parameters& p, const Band& band, int limit,
                   EdgePixels& pixels);

/// The mean level of those that lie beyond the card's edge; the bright one where none do.
double level_beyond_card(const EdgePixels& pixels, const Parameters& p);

}  // namespace roundel
