// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_limits.hpp"
#include "numeric/image.hpp"

namespace roundel {

// Faigl, Krajnik, Chudoba, Saska: Low-cost embedded system for relative localization in robotic swarms, ICRA
// 2013.

/// Section III-C, distance by the principal axis: one diameter of a slanted disc is perpendicular to the line
/// of sight and is imaged as the major axis. `major` is its length in the normalized image plane (x/z, y/z).
/// Throws std::invalid_argument unless `major` is positive.
double distance_by_principal_axis(double diameter, double major);

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
