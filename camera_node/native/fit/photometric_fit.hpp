// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <span>

#include "fit/fields.hpp"
#include "fit/occlusion.hpp"
#include "fit/roundel_limits.hpp"
#include "fit/tone_remainder.hpp"
#include "numeric/ellipse.hpp"
#include "numeric/image.hpp"

namespace roundel {

/// The displacement in blurs of an edge in a picture whose tone curve brightens the levels s between ink and
/// paper by curvature s (1 - s), for each unit of curvature (detector_model.md, section 3a). With
/// s = Phi(x), the least squares fit of a shift to s (1 - s): the integral of s (1 - s) ds, 1 / 6, over that
/// of phi(x)^2 dx, 1 / (2 sqrt(pi)).
constexpr double kEdgeShift = 0.5908179503;
constexpr double kCurvaturePrior = 0.6;  // standard deviation of that curvature; 0.7 is a gamma of 2.2

constexpr double kInitialBlur = 0.8;  // pixels: of a guess, before the fit

/// How much a tone curve enlarges the measured ratio of a roundel, for each unit of its curvature: both edges
/// move into the ring.
inline double ratio_by_curvature(const Ellipse& outer, double ratio, double blur) {
    return (1 + ratio) * blur * kEdgeShift / (std::sqrt(outer.major * outer.minor) / 2);
}

/// The fields that a fit may contain if the residuals show them.
enum class AllowedFields { kNone, kBend, kAll };

/// The linear change of the light that is expected across a roundel: relative, per pixel, and the standard
/// deviation of each component; none if that is 0.
struct LightGradient {
    double x = 0, y = 0, sigma = 0;
};

/// What is known of a camera and its prints where a roundel is, before it is fitted.
struct CameraPrior {
    std::span<const Print> prints{};  // in use, if they are known
    LightGradient light{};
    const ToneRemainder* tone = nullptr;  // expected to be left of the tone curve
    double curvature_sigma = 0;           // of the curvature that is left beside it; 0 for none
};

/// The initial guess of a fit: an ellipse within a pixel, the ratio of the diameters, and the grey levels.
struct InitialGuess {
    Ellipse outer;
    double ratio, dark, bright;
    OcclusionMask occlusion{};          // sectors that the fit leaves out
    std::optional<Parameters> model{};  // in the image's frame, within a third of a pixel, if known
    double noise = 0;                   // noise that the fit of `model` estimated,
    double ground = 0;                  // and `RoundelFit::ground`
    CameraPrior camera{};
    AllowedFields fields = AllowedFields::kNone;
    bool clipped = false;  // the paper is known to be brighter than the camera can show
};

/// Covariance (7, 7) of the outer ellipse's centre x, y, of its shape Axx, Axy, Ayy (the ellipse is
/// centre + A u, |u| = 1) and of the offset x, y from its centre to the image of the disc's centre; pixels.
using PoseCovariance = std::array<Vector<kPoseCount>, kPoseCount>;

inline PoseCovariance scaled(PoseCovariance covariance, double factor) {
    for (auto& row : covariance)
        for (double& value : row) value *= factor;
    return covariance;
}

/// The linear change of the light across a roundel that the pixels alone show: relative, per pixel, and the
/// variance of each component; 0 if it was not measured.
struct Shading {
    double x = 0, y = 0, variance = 0;
};

/// The bend of the paper that the residuals show (detector_model.md, section 3b): the squared length of
/// its two components and the variance of each, square minor half axes; 0 and 0 if it was not measured.
struct Bend {
    double squared = 0, variance = 0;
};

/// A roundel fitted to the grey levels around its edges.
struct RoundelFit {
    Ellipse outer;
    double offset_x;  // from the ellipse's centre to the image of the disc's centre, pixels
    double offset_y;  // from the ellipse's centre to the image of the disc's centre, pixels
    PoseCovariance pose_cov;
    double ratio;          // inner over outer diameter, measured without the prior of the print
    double ratio_sigma;    // its standard deviation
    double curvature = 0;  // of the tone curve, whose effect was removed from ratio and outline
    double dark;           // grey level
    double bright;         // grey level
    double blur;           // standard deviation of the edges' spread including the pixel's width, pixels
    double edge_residual;  // RMS over the ring's edges, each pixel weighted by its squared slope
    double support;        // share of the ring's edges that is in the image and agrees with the model
    /// Parameters of the model that describes the image, in its frame: with the effect of the tone curve, and
    /// the ratio given a known print.
    Parameters p;
    bool unoccluded = false;  // the fit uses the unmodified image, all around
    double motion_x = 0;      // during the exposure, if it was fitted, pixels
    double motion_y = 0;      // during the exposure, if it was fitted, pixels
    double noise = 0;         // standard deviation of the residuals, grey levels
    /// How much less pixels count that see the ground: its variance over that of the noise, times the pixels
    /// of a patch of it; 0 if all pixels count alike.
    double ground = 0;
    Shading shading{};
    bool clipped = false;      // the paper is brighter than the camera can show
    bool provisional = false;  // accepted if the camera's tone curve and processing explain it
    bool shadowed = false;   // the edge of a shadow lay across the roundel, and was taken out of its picture
    bool uneven = false;     // the residuals show light that changes by more than the fit contains
    double correlation = 1;  // of the residuals along the edges (`EdgeMisfit::correlation`)
    Fields fields{};         // that the fit contains, in the image's frame
    Bend bend{};
    double contrast() const { return bright - dark; }
    /// A level from ink (0) to paper (1) as the picture shows it, which ends at 255.
    double share(double level) const { return (level - dark) / (std::min(bright, 255.0) - dark); }
    /// Whether the noise and a model error of `misfit` contrasts explain the residuals on the ring's edges.
    bool is_explained(double image_noise, double misfit) const {
        return edge_residual < std::hypot(1.2 * image_noise, misfit * contrast());
    }
    /// Adds a variance of the displacement of all of the outer edge, square pixels, to the claim on the size.
    void widen_size(double variance) {
        for (const size_t i : {2, 4})  // Axx and Ayy
            for (const size_t j : {2, 4}) pose_cov[i][j] += variance;
    }
    /// Covariances of the ellipse's centre and of the offset, square pixels.
    Symmetric centre_covariance() const { return {pose_cov[0][0], pose_cov[0][1], pose_cov[1][1]}; }
    Symmetric offset_covariance() const { return {pose_cov[5][5], pose_cov[5][6], pose_cov[6][6]}; }
};

/// Fits a photometric model of a roundel to the pixels near its edges by Gauss-Newton (derivation:
/// detector_model.md). The model has 13 parameters: three grey levels (bright, dark between the outer
/// and the inner circle, ground beyond the card's edge), the blur, the ratios of the inner circle and of the
/// card, and seven of a plane's view. Tukey's biweight reduces the weight of pixels that disagree.
///
/// A few steps on a subset of the pixels, or the model of the last frame, come close enough to the solution
/// for a final step on all pixels to be efficient (Le Cam's one-step estimator). At most 6144 pixels are
/// used.
///
/// The fit uses the ratio of the known print that is nearest to the measured one unless it is more than three
/// standard deviations away. This prior contributes most of the information on the size
/// of small roundels.
///
/// The covariance is that of the M-estimate. Its noise is estimated from the residuals and is at least one
/// grey level. Returns nothing if the fit leaves the neighbourhood of the guess or the system is singular.
std::optional<RoundelFit> fit_photometric(const ImageView& image, const InitialGuess& guess);

/// The fit in which all pixels count alike, whose residuals show uneven light and occlusions, and, if the
/// levels around the card vary, the fit in which pixels count less the more they see of them.
struct GroundFits {
    RoundelFit even;
    std::optional<RoundelFit> weighed;
};
std::optional<GroundFits> fit_on_ground(const ImageView& image, const InitialGuess& guess);

/// The result of a fit, in the image's frame. `p` are its parameters in a frame with its origin at pixel
/// (origin_x, origin_y), and `pose` is the covariance of their last kPoseCount.
RoundelFit make_fit(const Parameters& p, const PoseCovariance& pose, int origin_x, int origin_y);

}  // namespace roundel
