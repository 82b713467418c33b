// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "numeric/ellipse.hpp"
#include "fit/photometric_fit.hpp"
#include "reference/segments.hpp"
#include "settings.hpp"

namespace roundel {

/// A dark segment with a bright one in it: what Section III-B of the paper accepts.
struct Pair {
    int dark, bright;  // numbers of segments
    Moments disc;      // both together: the outer disc
};

// Faigl, Krajnik, Chudoba, Saska: Low-cost embedded system for relative localization in robotic swarms, ICRA
// 2013.

/// Section III-B, area against bounding box. A disc seen at a slant and turned by any angle covers
/// pi/4 sqrt(1 - rho^2) of its upright box, rho being the correlation of its pixels' x and y: the paper's
/// pi/4 where the axes are upright. True within 30 %.
bool fills_its_box(const Segment& outer, const Moments& disc);

/// Section III-B, concentricity: the centres of the disc and of the bright segment in it, up to a tenth of
/// the minor axis (perspective parts them by less) and the half pixel that small segments are uncertain by.
bool are_concentric(const Moments& disc, const Moments& inner);

/// Section III-B, area ratio: sqrt(inner area / disc's area) is the ratio of the diameters at any slant. True
/// when it fits one of the ratios; blur moves each edge of a small segment by up to half a pixel.
bool has_area_ratio(const Moments& disc, const Moments& inner, const Settings& settings);

/// Section III-C: a disc's covariance matrix has the eigenvalues axis^2 / 16 along its own axes.
Ellipse covariance_ellipse(const Moments& disc);

/// Section III-C, distance by the principal axis: of all diameters of a slanted disc, one stands across the
/// line of sight and is seen as the major axis. `major` is its length in the normalised image plane (x/z,
/// y/z).
double distance_by_principal_axis(double diameter, double major);

/// All pairs of segments that pass Section III-B. What touches the image's border is left out.
std::vector<Pair> find_pairs(const Segments& segments, int width, int height, const Settings& settings);

/// The paper's search, made local and for any number of roundels: segments under a threshold map, their
/// pairs, and each pair anew under its own threshold theta = (m_d + m_b) / 2 in the window around it.
std::vector<Start> find_by_segments(const ImageView& image, const ThresholdMap& threshold,
                                    const Settings& settings);

}  // namespace roundel
