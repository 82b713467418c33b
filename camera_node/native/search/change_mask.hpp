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

/// What a fixed camera's frames show that was not there when it was searched: by the mean of each tile of
/// 8 x 8 pixels, which noise moves little and a roundel much. A tile is compared with the frame in which it
/// was last searched, not with the last one, so slow changes add up.
class Watch {
  public:
    /// Takes a frame; the first one and one of another size are all new.
    void look(const ImageView& image);
    /// A roundel is there, and explains what changes under it and its card in this frame.
    void explain(const Ellipse& outer);
    /// Boxes that hold all tiles whose mean moved by more than `limit` grey levels and that nothing explains,
    /// with room for a roundel's rest around them; the whole frame where they would hold more than `share`.
    std::vector<Box> changed(double limit, double share) const;
    /// A part was searched. What a roundel hides of it was not, and counts as it was before.
    void settle(const Box& box);
    /// A roundel was there of late, and is looked for although nothing may change.
    void doubt(const Ellipse& outer);
    /// Nothing counts as searched any more.
    void forget();

  private:
    template <typename Work>
    void visit(const Ellipse& outer, const Work& work);
    std::vector<uint8_t> changed_cells(int limit) const;

    int width_ = 0, height_ = 0, columns_ = 0, rows_ = 0;  // pixels; tiles
    std::vector<uint16_t> now_, searched_;                 // sums of tiles' columns' means
    std::vector<uint8_t> explained_;
};

}  // namespace roundel
