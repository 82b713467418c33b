// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "numeric/ellipse.hpp"
#include "numeric/image.hpp"

namespace roundel {

/// A part of an image: columns [left, right) of rows [top, bottom).
struct Box {
    int left, top, right, bottom;
    bool meets(const Box& other) const;
    void join(const Box& other);
    double area() const { return double(right - left) * double(bottom - top); }
};

/// Marks the parts of a fixed camera's frames that changed since they were searched. It compares the mean of
/// each tile of 8 x 8 pixels, which a roundel changes much more than noise does. The reference is the frame
/// in which the tile was last searched, not the last frame, so that slow changes accumulate.
class ChangeMask {
  public:
    /// Takes a frame. All of the first frame, and of a frame of another size, counts as changed.
    void update(const ImageView& image);
    /// Excludes the tiles under a roundel and its card from the changes of this frame.
    void mask(const Ellipse& outer);
    /// Boxes that contain all unmasked tiles whose mean changed by more than `limit` grey levels, with a
    /// margin for the rest of a roundel; the whole frame if the boxes would cover more than `share` of it.
    std::vector<Box> changed(double limit, double share) const;
    /// Makes this frame the reference for a box that was searched, except for its masked tiles.
    void mark_searched(const Box& box);
    /// Marks the tiles under a lost roundel as changed.
    void invalidate(const Ellipse& outer);
    /// Marks all tiles as changed.
    void invalidate();

  private:
    template <typename Work>
    void visit(const Ellipse& outer, const Work& work);
    std::vector<uint8_t> changed_cells(int limit) const;

    int width_ = 0;                   // pixels
    int height_ = 0;                  // pixels
    int columns_ = 0;                 // tiles
    int rows_ = 0;                    // tiles
    std::vector<uint16_t> now_;       // sums of the tiles' column means
    std::vector<uint16_t> searched_;  // sums of the tiles' column means
    std::vector<uint8_t> masked_;
};

}  // namespace roundel
