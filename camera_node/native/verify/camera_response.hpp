// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_limits.hpp"
#include "numeric/image.hpp"
#include "verify/tone_curve.hpp"

namespace roundel {

/// A camera's response, learned from the roundels that it sees: its tone curve, as the exponent that makes
/// levels proportional to light, and the residuals that its processing leaves at edges
/// (detector_model.md, section 3).
class CameraResponse {
  public:
    CameraResponse();
    /// The image with levels in proportion to light: itself if the curve counts as linear, otherwise a copy
    /// that is valid until the next call.
    ImageView linearize(const ImageView& image);
    /// A level of the camera's picture in the linearized one, and the reverse.
    double linear(double level) const { return to_power(level, std::exp(log_exponent_)); }
    double encoded(double level) const { return to_power(level, std::exp(-log_exponent_)); }
    /// Learns from fits without occlusion to a linearized image. The caller must discard models of earlier
    /// frames if this returns true: the tone curve changed.
    bool learn(const std::vector<const RoundelFit*>& fits, const RoundelLimits& limits);
    /// 1 for a linear camera, 2.2 for a usual tone curve; nothing before the roundels have determined it.
    std::optional<double> exponent() const;
    /// That of `linearize`; 1 before it is known.
    double exponent_in_use() const { return std::exp(log_exponent_); }
    /// RMS residual at the edges of roundels without occlusion, linear grey levels; 0 if unknown.
    double edge_noise() const { return edge_noise_; }
    /// Correlation of these residuals along the edges, as `EdgeMisfit::correlation`; 1 if unknown.
    double correlation() const { return correlation_; }
    /// Widens a fit's covariance by the correlation of the residuals along the edges: that of the camera's
    /// roundels, or the roundel's own if shadows or compression make it larger.
    void claim(RoundelFit& fit) const;
    /// Standard deviation of the curvature, between ink and paper, that `remainder` does not contain.
    double curvature_sigma() const { return std::sqrt(curvature_); }
    /// What linearization is known to leave.
    const ToneRemainder& remainder() const { return remainder_; }

  private:
    /// The logarithm of an exponent and its standard deviation.
    struct ToneEstimate {
        double log_exponent, sigma;
    };
    struct ToneMeasurement {
        ToneEstimate power;
        ToneSample sample;
    };
    static double to_power(double level, double exponent) {
        return 255 * std::pow(std::max(level, 0.0) / 255, exponent);
    }
    void learn_remainder(bool linearization_changed);
    std::optional<ToneMeasurement> measure(const RoundelFit& fit, const RoundelLimits& limits) const;
    void learn_edge_noise(const std::vector<const RoundelFit*>& fits);
    void learn_curvature(const std::vector<const RoundelFit*>& fits, const RoundelLimits& limits);
    bool learn_tone(std::vector<ToneEstimate> measured);
    void set_exponent(double log_exponent);

    ToneCurve tone_;
    ToneRemainder remainder_;
    unsigned n_learned_ = 0;   // frames
    double log_exponent_ = 0;  // in use
    double mean_ = 0;          // of the measured ones
    double sigma_ = 0;         // of the mean; 0 before the first measurement
    double edge_noise_ = 0, correlation_ = 1;
    double curvature_ = 0;  // variance
    bool knows_tone_ = false, knows_curvature_ = false;
    std::array<uint8_t, 256> linear_;
    std::vector<uint8_t> buffer_;
};

}  // namespace roundel
