// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_limits.hpp"
#include "numeric/ellipse.hpp"
#include "reference/segments.hpp"

namespace roundel {

// Faigl, Krajnik, Chudoba, Saska: Low-cost embedded system for relative localization in robotic swarms, ICRA
// 2013.

/// A dark segment with a bright one inside that passes the tests of Section III-B.
struct SegmentPair {
    int dark, bright;  // numbers of the segments
    Moments disc;      // of both together: the outer disc
};

/// Section III-B, area against bounding box. The image of a slanted disc, turned by any angle, covers
/// pi/4 sqrt(1 - rho^2) of its upright box; rho is the correlation of its pixels' x and y. With upright axes
/// this is the paper's pi/4. True within 30 %.
bool fills_its_box(const Segment& outer, const Moments& disc);

/// Section III-B, concentricity: the distance of the centres of the disc and of the bright segment is below a
/// tenth of the minor axis (perspective separates them by less) plus half a pixel for small segments.
bool are_concentric(const Moments& disc, const Moments& inner);

/// Section III-B, area ratio: sqrt(inner area / disc area) is the ratio of the diameters at any slant. True
/// if it agrees with a print's ratio; blur moves each edge of a small segment by up to half a pixel.
bool has_area_ratio(const Moments& disc, const Moments& inner, const RoundelLimits& limits);

/// Section III-C: a disc's covariance matrix has the eigenvalues axis^2 / 16 along its axes.
Ellipse covariance_ellipse(const Moments& disc);

/// Section III-C, distance by the principal axis: one diameter of a slanted disc is perpendicular to the line
/// of sight and is imaged as the major axis. `major` is its length in the normalized image plane (x/z, y/z).
/// Throws std::invalid_argument unless `major` is positive.
double distance_by_principal_axis(double diameter, double major);

/// All pairs of segments that pass Section III-B. Segments that touch the image's border are excluded.
std::vector<SegmentPair> find_pairs(const Segments& segments, int width, int height,
                                    const RoundelLimits& limits);

/// The paper's search, with local thresholds and for any number of roundels.
class PaperSearch {
  public:
    /// The threshold of the next frame, grey levels (Section III-B).
    double theta() const { return theta_; }
    /// Finds segments under a local threshold, tests pairs of them, and repeats both for each pair in a
    /// window around it, under its own threshold theta = (m_d + m_b) / 2. `min_contrast`: see
    /// local_threshold.
    std::vector<InitialGuess> find(const ImageView& image, double min_contrast,
                                   const RoundelLimits& limits) const;
    /// Sets theta = (m_d + m_b) / 2 from the mean levels of the roundels found.
    void set_levels(double dark, double bright);
    /// No roundel was found: theta steps through 1/2, 1/4, 3/4, 1/8, ... of the grey scale.
    void step();

  private:
    double theta_ = 128;
    unsigned steps_ = 1;
};

}  // namespace roundel
