// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <optional>
#include <span>

#include "numeric/ellipse.hpp"
#include "numeric/image.hpp"
#include "fit/occlusion.hpp"

namespace roundel {

/// What the fit starts from: an ellipse good to a pixel, the ratio of the diameters, and the levels.
struct Start {
    Ellipse outer;
    double ratio, dark, bright;
    std::span<const double> prints{};   // ratios that the prints in use were made with, where they are known
    Hidden hidden{};                    // what is covered, and left out of the fit
    std::optional<Parameters> model{};  // good to a third of a pixel, in the image's frame, where it is known
    double noise = 0;                   // that the fit of this model left
};

/// Covariance of an outer ellipse's centre x, y, of its shape Axx, Axy, Ayy (it is centre + A u, |u| = 1) and
/// of the offset x, y to where the disc's own centre projects; pixels.
using PoseCovariance = std::array<std::array<double, 7>, 7>;

/// A roundel fitted to the grey levels around its edges.
struct Fit {
    Ellipse outer;
    double offset_x, offset_y;  // from the ellipse's centre to where the disc's own centre projects, pixels
    PoseCovariance C;
    double ratio;          // inner over outer diameter, as measured without the print
    double ratio_sigma;    // its standard deviation
    double dark, bright;   // grey levels
    double blur;           // standard deviation of the edges' spread, the pixel's own width included, pixels
    double edge_residual;  // over the ring's edges, each pixel counting as much as it tells of them
    double support;        // share of the ring's edges that is in the image and agrees
    Parameters p;          // as the model has them, in the image's frame; the ratio is a known print's
    bool plain = false;    // fitted to the picture as it is, all around
    double motion_x = 0, motion_y = 0;  // during the exposure, where it was fitted, pixels
    double noise = 0;                   // that the fit leaves, grey levels
    /// Of the ellipse's centre and of the offset, square pixels.
    Symmetric centre_covariance() const { return {C[0][0], C[0][1], C[1][1]}; }
    Symmetric offset_covariance() const { return {C[5][5], C[5][6], C[6][6]}; }
};

/// Fits a photometric model of a roundel to the pixels near its edges, by Gauss-Newton: a bright level, a
/// dark one between the outer circle and the inner, and a third beyond the card's edge. Thirteen unknowns:
/// three levels, blur, the inner circle's and the card's ratio, and seven of a plane's view. Pixels that
/// disagree count less (Tukey's biweight).
///
/// A few steps on a part of the pixels, or the model of the frame before, come near enough for the last one,
/// on all of them, to be efficient (Le Cam's one-step estimator). Large roundels are sampled: no more than
/// 6144 pixels are used.
///
/// Known prints tell the ratio to 0.002: that of the one nearest to what the fit says without them, unless it
/// is three standard deviations away and so another print. Small roundels owe it most of what they know of
/// their size.
///
/// The covariance is that of the M-estimate, its noise from the residuals, at least one grey level. Nothing
/// comes back where the fit leaves the start's neighbourhood or its equations are singular.
std::optional<Fit> refine(const ImageView& image, const Start& start);

}  // namespace roundel
