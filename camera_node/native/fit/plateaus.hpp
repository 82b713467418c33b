// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "fit/roundel_model.hpp"
#include "numeric/image.hpp"

namespace roundel {

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
