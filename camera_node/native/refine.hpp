// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "ellipse.hpp"
#include "image.hpp"

namespace roundel {

/// What the fit starts from: an ellipse good to a pixel, the ratio of the diameters, and the levels.
struct Start {
    Ellipse outer;
    double ratio, dark, bright;
};

/// A roundel fitted to the grey levels around its edges.
struct Fit {
    Ellipse outer;
    Symmetric covariance;         // of the centre, square pixels
    double offset_x, offset_y;    // from the ellipse's centre to where the disc's own centre projects, pixels
    Symmetric offset_covariance;  // square pixels
    double ratio;                 // inner over outer diameter
    double card;                  // the white card's over the outer diameter, where the card's edge is near
    double dark, bright;          // grey levels
    double blur;      // standard deviation of the edges' spread, the pixel's own width included, pixels
    double residual;  // RMS over all pixels used, grey levels
};

/// Fits a photometric model of a roundel by Gauss-Newton on the pixels within two of its edges: a bright
/// level, a dark one between the outer ellipse and the inner, and a third beyond the card's edge, each edge
/// an error function of the distance to its ellipse. Thirteen unknowns: centre and shape of the outer
/// ellipse, the inner one's ratio and offset (perspective), three levels, blur, and the card's ratio. Pixels
/// that disagree count less (Tukey's biweight).
///
/// The covariance is that of the weighted fit, its noise estimated from the residuals, at least one grey
/// level. Nothing comes back where the fit leaves the start's neighbourhood or its equations are singular.
std::optional<Fit> refine(const ImageView& image, const Start& start);

}  // namespace roundel
