// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "verify/smoothed_fit.hpp"

namespace roundel {

/// The surroundings of a guess without the edge of a shadow that lies across it (detector_model.md, section
/// 3b): the light is 1 on one side of a parabola, less on the other one, and a normal distribution between.
class WithoutShadow : public Surroundings {
  public:
    WithoutShadow(const ImageView& image, const InitialGuess& guess);
    /// Whether paper and ink far from the roundel's edges show such a light, and no more than that.
    bool is_explained() const { return !levels_.empty(); }
    InitialGuess even_guess;  // in `view`
    double noise_gain = 1;    // RMS of the factor of levels
};

}  // namespace roundel
