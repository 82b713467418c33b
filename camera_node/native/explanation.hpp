// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "numeric/ellipse.hpp"
#include "numeric/image.hpp"
#include "verify/acceptance.hpp"

namespace roundel {

/// A ring-like shape that is no roundel, as far as it was measured.
struct RefusedRing {
    Ellipse outer;
    double ratio, contrast;
    double misfit;  // RMS residual at the edges over the contrast; 0 without a fit
    Refusal reason;
};

/// Searches an image for rings of almost any ratio, size and contrast, and names the first test that each of
/// them fails. Rings that pass all tests are left out.
std::vector<RefusedRing> explain_refusals(const ImageView& image, const AcceptanceContext& context);

}  // namespace roundel
