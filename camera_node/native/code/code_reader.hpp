// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "code/code_book.hpp"
#include "fit/photometric_fit.hpp"

namespace roundel {

/// The code of a roundel, if its name is certain.
struct CodeReading {
    int name = 0;            // number of the code; 0 where it is not certain
    double probability = 0;  // of that name
    /// Where the zero of the code is on the outer ellipse, at centre + S^(1/2) (cos, sin) for its shape S,
    /// and the standard deviation; radians.
    double rotation = 0, sigma = 0;
};

/// What the frames of a track show of its code (detector_model.md, section 10).
///
/// Errors of the model, such as uneven light, are alike in all frames. With the share `rho` of them in the
/// variance, n frames count as n / (1 + (n - 1) rho).
class CodeTrack {
  public:
    /// Adds a frame, and returns what is known after it.
    CodeReading add(const ImageView& image, const RoundelFit& fit);

  private:
    void include(const std::vector<float>& codes);

    double count_ = 0;  // frames
    /// Means of the codes' log-likelihoods over that of no code; none where that is greater.
    std::vector<float> means_;
    size_t best_ = 0;  // the most probable code
};

}  // namespace roundel
