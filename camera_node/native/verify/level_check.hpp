// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "numeric/image.hpp"
#include "fit/photometric_fit.hpp"

namespace roundel {

/// Of samples in the ring, which is dark, and in the hole, which is bright: how many are seen, and how many
/// are off by a third of the contrast.
struct Surface {
    int seen = 0, off = 0;
};
Surface inspect(const ImageView& image, const Fit& fit);

/// Whether two more dark rings lie around a roundel within four of its diameters, which makes it a bullseye.
/// One may be a plate that it stands on, or the line that its card was cut along.
bool is_bullseye(const ImageView& image, const Fit& fit);

}  // namespace roundel
