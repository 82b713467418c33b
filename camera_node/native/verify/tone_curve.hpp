// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <vector>

namespace roundel {

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
/// A robust Gauss-Newton fit to the samples of the last roundels. One roundel determines the mean exponent
/// between its levels only; roundels in different light determine both. A prior decides what they leave.
class ToneCurve {
  public:
    void include(const ToneSample& sample);
    /// Fits the curve to the samples, from its last state.
    void fit();
    /// RMS of the curvatures that a power leaves in the samples, beyond their noise.
    double left_by(double exponent) const;
    double light(double share) const;
    double exponent() const { return exponent_; }

  private:
    double light(const EncodedLevel& level) const;

    std::vector<ToneSample> samples_;
    size_t next_ = 0;  // of the samples, to be replaced
    double exponent_ = 1, shoulder_ = 0;
};

}  // namespace roundel
