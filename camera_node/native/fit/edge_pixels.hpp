// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>

#include "fit/roundel_model.hpp"
#include "numeric/image.hpp"
#include "numeric/lanes.hpp"

namespace roundel {

/// Up to `Max` pixels as columns, in a frame with its origin near the roundel. Padding to whole lanes has
/// level -1 and does not count.
template <int Max>
struct PixelColumns {
    static constexpr int kMax = Max;
    int origin_x = 0;  // of the frame, pixels of the image
    int origin_y = 0;  // of the frame, pixels of the image
    int count = 0;     // padded to whole lanes
    int used = 0;      // pixels inside the image
    int expected = 0;  // pixels inside and outside of the image
    alignas(4 * kLanes) float x[kMax + kLanes], y[kMax + kLanes], level[kMax + kLanes];
    /// Pads the columns to whole lanes.
    void pad() {
        count = (used + kLanes - 1) / kLanes * kLanes;
        for (int k = used; k < count; ++k) {
            x[k] = y[k] = 0;
            level[k] = -1;
        }
    }
};

/// Pixels near the edges of one roundel, divided into parts: of one edge each, or one part of all edges.
struct EdgePixels : PixelColumns<6144> {
    struct EdgePart {
        Edge edge;
        int begin;  // whole lanes
        int count;  // whole lanes
    };
    std::array<EdgePart, kEdges> parts;
    int part_count = 0;

    void clear() { used = expected = count = part_count = padding_ = 0; }
    /// Keeps the first `n` pixels, as one part of all edges.
    void truncate(int n) {
        expected -= used - n;
        used = n;
        count = part_count = padding_ = 0;
        end_part(kAnyEdge);
    }
    /// Copies every `n`-th lane of each part.
    void sample(int n, EdgePixels& to) const;
    int end() const { return used + padding_; }
    /// Makes a part of the pixels that were added since the last one.
    void end_part(Edge edge) {
        while (end() % kLanes) {
            x[end()] = y[end()] = 0;
            level[end()] = -1;
            ++padding_;
        }
        parts[size_t(part_count++)] = {edge, count, end() - count};
        count = end();
    }

  private:
    int padding_ = 0;
};

/// Which pixels to use, by their distance from the nearest edge: those within `narrow` in every row, and
/// those within `wide`, which determine the grey levels, in every third row.
struct EdgeBand {
    double narrow, wide;
    bool card;            // whether to use the card's edge
    double separate = 0;  // `wide` where each part has pixels of a single edge; 0 to use one part
};

/// Selects the pixels in a band along the edges of the model `p`, in every n-th row: n is the smallest number
/// that gives about `limit` pixels or fewer, or ten rows.
///
/// If the edges are so far apart that no pixel within `narrow` shows two of them, each edge gets its own
/// part, and its wide band ends where the next edge shows.
void select_pixels(const ImageView& image, const Parameters& p, const EdgeBand& band, int limit,
                   EdgePixels& pixels);

/// Makes the levels near the scale's end lower bounds, if the paper is `known` to be clipped or its level is
/// near the end and a quarter of theirs are at the end: half of those that compression scatters are, and
/// edges add as many again. Returns whether it did.
bool mark_clipped(double paper, bool known, EdgePixels& pixels);

/// The mean level of the pixels beyond the card's edge; the bright level if there are none.
double level_beyond_card(const EdgePixels& pixels, const Parameters& p);

/// The grey levels of a part of a roundel that no edge reaches.
struct Plateau {
    int count = 0;
    double mean = 0, variance = 0;
};

struct Plateaus {
    Plateau ring, hole;
};

/// Reads the ring and the hole at `distance` pixels or more from their edges, in every row of a disc of
/// up to 70 pixels and in fewer rows of larger ones. (`origin_x`, `origin_y`) is the pixel to which the
/// parameters are relative.
Plateaus read_plateaus(const ImageView& image, const Parameters& p, int origin_x, int origin_y,
                       double distance);

}  // namespace roundel
