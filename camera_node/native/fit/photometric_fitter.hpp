// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "fit/edge_pixels.hpp"
#include "fit/field_equations.hpp"
#include "fit/gauss_newton.hpp"
#include "fit/normal_equations.hpp"
#include "fit/photometric_fit.hpp"
#include "fit/plateaus.hpp"

namespace roundel {

constexpr SanityLimits kFitLimits{
    .shift = 0.1, .min_size = 0.7, .max_size = 1.4, .blur = 0.1, .underflow = 64, .overflow = 600};

// Bounds of the scale of residuals over that of the current ones
constexpr double kStrictScale = 0.5;
constexpr double kSlackScale = 1.3;  // the tolerance of a median of few residuals

constexpr double kSeparateBlurs = 4;    // of wide bands that contain a single edge, and of plateaus
constexpr float kClippedPlateau = 235;  // level that compression leaves of clipped paper

/// Chi-square with two degrees of freedom from which residuals show a field: by chance once in 22,000.
constexpr double kUnlikelyField = 20;

/// One photometric fit: the state that its stages share. `fit_photometric` calls the stages in order.
class PhotometricFitter : GaussNewton<kCount> {
  public:
    PhotometricFitter(const ImageView& image, const InitialGuess& guess);

    // photometric_fit.cpp
    /// Iterates on a subset of the pixels, from an initial guess to near the solution.
    bool approach();
    /// Iterates on all pixels until convergence.
    bool finish();
    /// Whether the residuals beyond the card show levels that vary.
    bool sees_clutter() const;
    /// Weights the pixels that see the ground as these residuals require, and solves again.
    bool weigh_ground();
    /// Measured, without the expected effect of the tone curve.
    double ratio() const { return p_[kRatio] - effect_of_curvature(expected_curvature_)[kRatio]; }
    RoundelFit fit() const;

    // field_fit.cpp
    /// Tests the residuals for uneven light and for bent paper; whether the guess allows the latter and the
    /// residuals show it.
    bool shows_bend();
    /// Fits the fields with the parameters; false if that does not converge.
    bool fit_fields();
    /// Includes the two unknowns of a linear shading in the pose, after convergence.
    void allow_shading();
    bool knows_light() const { return has_fields_ && allowed_ == AllowedFields::kAll; }

    // plateau_prior.cpp
    /// Conditions the estimate on the levels far from the edges.
    void use_plateaus();

    // print_prior.cpp
    /// Looks up the curvature between the levels of ink and paper; `sigma` is that of what remains.
    void expect_curvature(double sigma);
    /// Conditions the estimate on a print.
    void use_print(const Print& print);

  private:
    bool select(EdgeBand band, int limit);
    bool resume();
    bool iterate(const EdgePixels& pixels, int steps_to_go);
    bool solve(double scale);
    bool is_converged(double left) const;
    bool is_near(double left) const;
    double edge_scale() const;
    double advance(double scale);
    double level_change(const Parameters& delta) const;
    double edge_information() const;
    void update_noise();
    EdgeBand whole_band() const;

    bool condition_on_plateau(Parameter level, const Plateau& plateau, Parameters& g);
    bool condition_on_print(const Print& print);
    Parameters covariance_with_ratio() const;
    Parameters effect_of_curvature(double curvature) const;
    PoseCovariance pose_covariance() const;
    void add_fields(PoseCovariance& inverse) const;
    Bend bend() const;

    bool step_with_fields(const Vector<kFields>& prior, double& moved);
    Vector<kFields> field_prior() const;

    const ImageView& image_;
    OcclusionMask occlusion_;
    EdgePixels pixels_, sample_;
    NormalEquations equations_;
    GaussNewtonSystem<kCount> system_;
    ResidualSums sums_;
    Parameters linearized_at_{};
    PoseCovariance shading_effect_{};    // on the covariance, in units of the noise
    Vector<kPoseCount> print_effect_{};  // its outer product is what the print takes off the covariance
    double posterior_ratio_ = 0;         // given the print; 0 if no print is known
    double scale_ = 255, noise_ = 0, slope_ = 1;
    double spread_ = 0;  // of the ground, in the last solution
    double ground_ = 0;  // of the ground, as the residuals show
    bool resumed_, clipped_ = false;
    LightGradient light_;
    double curvature_sigma_ = 0;
    const ToneRemainder* tone_;
    double expected_curvature_ = 0;  // of the tone curve, before the print is used
    double curvature_ = 0;           // of the tone curve, after the print is used
    Vector<kPoseCount>
        curvature_effect_{};  // its outer product is what the tone curve adds to the covariance
    Shading shading_;
    AllowedFields allowed_;
    FieldScores scores_{};
    bool has_fields_ = false;
    Fields fields_;                                     // in the image's frame
    std::array<Parameters, kFields> by_field_{};        // the effect of each field's error on the estimate
    std::array<Vector<kFields>, kFields> field_cov_{};  // in units of the noise
};

}  // namespace roundel
