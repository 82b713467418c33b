// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "verify/learning.hpp"

namespace roundel {

/// The mean of the prior of an unknown camera's exponent.
constexpr double kPriorExponent = 1.6;

/// A share of the scale that a camera shows, and what the tone curve's unknowns multiply there.
struct EncodedLevel {
    explicit EncodedLevel(double share);
    double by_exponent, by_shoulder;
};

/// The light between the levels of ink and paper of one roundel: half of the light is at the level `middle`.
struct ToneSample {
    EncodedLevel dark, middle, bright;
    double sigma;  // of the curvature that is computed from it
};

/// A camera's tone curve, as the light L at a share v of the scale:
///   log L = exponent log v + shoulder (v^6 - 1) / 6.
/// The local exponent, exponent + shoulder v^6, is that of a power for most levels and greater where a
/// shoulder compresses bright light.
///
/// A robust Gauss-Newton fit to the samples of the last frames. One roundel determines the mean exponent
/// between its levels only; roundels in different light determine both. A prior decides what they leave.
class ToneCurve {
  public:
    /// Includes the samples of a frame.
    void learn(const std::vector<ToneSample>& samples);
    double light(double share) const;

  private:
    double light(const EncodedLevel& level) const;

    Regression<2> regression_;
    double exponent_ = 1, shoulder_ = 0;
};

/// Mean square of the curvatures that a power leaves in samples, beyond their noise.
double left_by_power(double exponent, const std::vector<ToneSample>& samples);

}  // namespace roundel
