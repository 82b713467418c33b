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
#include "verify/learning.hpp"
#include "verify/light_falloff.hpp"
#include "verify/paper_bend.hpp"
#include "verify/print_ratios.hpp"
#include "verify/tone_curve.hpp"

namespace roundel {

/// Logarithm of an exponent: smaller ones count as linear, and are measured exactly to a hundredth.
constexpr double kMinTone = 0.1;

/// What is known of a camera, its light and its prints, with its uncertainty (detector_model.md, sections 3
/// to 4): the tone curve, the residuals that processing leaves at edges and their correlation, the light that
/// falls off, the ratios of the prints and how much they bend. A frame's fits teach all of it, and the next
/// fits start from it.
class CameraModel {
  public:
    /// `given` are the prints, or the usual ones if `any` others may be in view.
    CameraModel(std::vector<Print> given, bool any);
    /// The image with levels in proportion to light: itself if the curve counts as linear, otherwise a copy
    /// that is valid until the next call.
    ImageView linearize(const ImageView& image);
    static double to_power(double level, double exponent) {
        return 255 * std::pow(std::max(level, 0.0) / 255, exponent);
    }
    /// A level of the camera's picture in the linearized one, and the reverse.
    double linear(double level) const { return to_power(level, std::exp(log_exponent_)); }
    double encoded(double level) const { return to_power(level, std::exp(-log_exponent_)); }

    /// What is known before the fit of a roundel at a pixel.
    CameraPrior prior_at(double x, double y) const;
    /// Learns from the fits of a frame, in its linearized `image`, that contain no light of their own.
    /// Returns whether fits with what was known before do not compare with the next ones: another tone curve
    /// is in use. The caller must discard models of earlier frames if `exponent_in_use` changes.
    bool observe(const std::vector<Observation>& roundels, const ImageView& image);
    /// Adds to a fit's covariance what it does not contain: the correlation of residuals along the edges
    /// (that of the camera's roundels, or the roundel's own if shadows or compression make it larger), and
    /// bends.
    void claim(RoundelFit& fit) const;
    /// Continues another model with the prints of this one, unless both find them by themselves.
    void take_over(const CameraModel& from);

    /// Whether roundels have shown the tone curve and the processing.
    bool is_known() const { return edge_noise_.is_known(); }
    /// RMS residual at the edges of roundels without occlusion, linear grey levels; 0 if unknown.
    double edge_noise() const { return is_known() ? edge_noise_.value() : 0; }
    /// 1 for a linear camera, 2.2 for a usual tone curve; nothing before the roundels have determined it.
    std::optional<double> exponent() const;
    /// That of `linearize`; 1 before it is known.
    double exponent_in_use() const { return std::exp(log_exponent_); }
    /// The prints in use.
    const std::vector<Print>& prints() const { return prints_; }
    /// The ratios of the prints that recur, if they were not given.
    std::vector<double> recurring() const;

  private:
    /// The logarithm of an exponent and its standard deviation.
    struct ToneEstimate {
        double log_exponent, sigma;
    };
    struct ToneMeasurement {
        ToneEstimate power;
        ToneSample sample;
    };
    void learn_remainder(const std::vector<ToneSample>& samples);
    struct CurvatureSeen {
        const Print& print;
        double by_curvature, left, sigma;
    };
    std::optional<CurvatureSeen> curvature_of(const RoundelFit& fit) const;
    std::optional<ToneMeasurement> measure(const RoundelFit& fit) const;
    void learn_edge_noise(const std::vector<const RoundelFit*>& fits);
    void learn_curvature(const std::vector<const RoundelFit*>& fits);
    bool learn_tone(std::vector<ToneEstimate> measured);
    bool contradicts(const std::vector<Observation>& roundels);
    void forget_response();
    void forget();
    bool learn_response(const std::vector<const RoundelFit*>& fits);
    void set_exponent(double log_exponent);

    std::vector<Print> prints_;
    std::optional<PrintRatios> ratios_;  // if they were not given
    LightFalloff light_;
    PaperBend bend_;
    ToneCurve tone_;
    ToneRemainder remainder_;
    double log_exponent_ = 0;  // in use
    FrameMean mean_, sigma_;   // of the measured ones
    FrameMean left_;           // mean square of the curvatures that a power leaves
    FrameMean edge_noise_, correlation_{1};
    FrameMean curvature_;  // variance
    double surprise_ =
        0;  // variance of a curvature that fits do not contain: what the last frame showed beyond the prior
    /// The ratios of the roundels of the last frame.
    struct SeenRatio {
        int track;
        double ratio, variance;
    };
    std::vector<SeenRatio> last_;
    bool is_new_ = false;  // the last frame contradicted the model
    bool knows_tone_ = false;
    std::array<uint8_t, 256> linear_;
    std::vector<uint8_t> buffer_;
};

}  // namespace roundel
