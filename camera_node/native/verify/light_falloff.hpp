// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <utility>
#include <vector>

#include "numeric/image.hpp"
#include "verify/learning.hpp"

namespace roundel {

/// How the light changes across the roundels of a camera (detector_model.md, section 3): vignetting and
/// lamps make a relative gradient that is nearly linear in the place, s = (a + M u) / level
/// with u from the middle of the picture in half diagonals, M symmetric, and each roundel has a rest of its
/// own. The roundels in view teach all of it; in even light it is 0 and as good as certain.
class LightFalloff {
  public:
    /// Learns from the fits of a frame without occlusion, in light without shadows and highlights.
    void learn(const std::vector<const RoundelFit*>& fits, const ImageView& image);
    /// Multiplies all gradients: levels to the power of a factor have that many times the relative gradient.
    void scale(double factor);
    /// The gradient to expect for a roundel at a pixel.
    LightGradient at(double x, double y) const;

  private:
    enum Coefficient { kAx, kAy, kMxx, kMxy, kMyy, kCoefficients };
    using Row = Vector<kCoefficients>;
    /// The derivatives of both components of the gradient by the coefficients.
    std::pair<Row, Row> rows(double x, double y) const;
    double level(double x, double y) const;
    std::pair<double, double> expected(double x, double y) const;
    void set_size(const ImageView& image);
    void include(const RoundelFit& fit);
    void solve();

    static constexpr double kFirst =
        2e-4;  // standard deviation of a gradient, per pixel: a tenth across half a picture

    double x_ = 0;           // middle of the picture
    double y_ = 0;           // middle of the picture
    double per_radius_ = 0;  // one over half the picture's diagonal
    Regression<kCoefficients> regression_;
    Regression<kCoefficients>::Estimate now_{};
    FrameMean all_{kFirst * kFirst};   // variance of the gradient, for each component
    FrameMean rest_{kFirst * kFirst};  // variance of the gradient's rest, for each component
};

}  // namespace roundel
