// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "fit/photometric_fit.hpp"

namespace roundel {

/// How much the prints bend that a camera sees (detector_model.md, section 3b). A small roundel, and one
/// that is seen frontally, shows no bend of its own, but is displaced by it; the other roundels of the camera
/// show how much that may be. Flat prints teach that there is no bend, and their claims stay as they are.
class PaperBend {
  public:
    /// Learns from the fits of a frame without occlusion, in even light, whose residuals have this
    /// `correlation` along the edges (`EdgeMisfit::correlation`): processing displaces edges, too.
    void learn(const std::vector<const RoundelFit*>& fits, double correlation);
    /// Adds to a fit's covariance what a bend displaces that the fit does not contain.
    void claim(RoundelFit& fit) const;

  private:
    /// A weighted mean of squared bends beyond their noise.
    struct Sums {
        double weight = 0, excess = 0, scatter = 0;
        /// The mean, less than which is unlikely; 0 if noise explains it.
        double lower() const;
    };
    double unseen(const RoundelFit& fit, double tilt) const;

    Sums remembered_;
    double squared_ = 0;  // mean square of a bend over the tangent of the tilt
};

}  // namespace roundel
