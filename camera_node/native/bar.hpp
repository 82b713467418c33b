// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "image.hpp"
#include "occlusion.hpp"
#include "refine.hpp"

namespace roundel {

/// A dark strip across a roundel, in its own plane's frame and in outer radii: all points whose part along
/// `angle` is between `from` and `to`.
struct Bar {
    double angle, from, to;
    /// The sectors whose middle at `radius` it hides, its blurred edges included.
    Sectors hides(double radius) const;
};

/// The strip that holds all the ink that is seen where a roundel has none: in the hole and on the card.
///
/// Letters have such ink too: a Q a tail, an 8 a twin, a d a stem, a Phi a bar. The strip is a cover only if
/// it is dark from end to end, goes on beyond the card on either side, and has a level that is not the
/// ring's.
std::optional<Bar> find_bar(const ImageView& image, const Fit& fit, double noise);

}  // namespace roundel
