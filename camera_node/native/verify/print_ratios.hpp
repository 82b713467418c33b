// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>
#include <vector>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_limits.hpp"
#include "verify/learning.hpp"

namespace roundel {

inline double ratio_by_curvature(const RoundelFit& fit, double print_ratio) {
    return ratio_by_curvature(fit.outer, print_ratio, fit.blur);
}

/// A roundel of a frame without occlusion, and the number of its track.
struct Observation {
    const RoundelFit* fit;
    int track;
};

/// Finds the ratios of the prints that a camera sees, from those that recur.
///
/// A tone curve enlarges the measured ratio by curvature / diameter, so the ratio of one roundel does not
/// determine that of its print. Roundels of several sizes do: each kind has a linear regression
///   measured = print + curvature * ratio_by_curvature.
/// It decides once several roundels of a frame are of its kind. A usual print is assumed unless the
/// regression contradicts it; else the kind is a print of its own, as exact as the regression.
class PrintRatios {
  public:
    PrintRatios();
    /// Includes the roundels of a frame. The caller must use `prints` from now on if this returns true.
    bool learn(const std::vector<Observation>& roundels);
    /// The prints in use: the usual ones, of which some may be replaced, and others that recur.
    const std::vector<Print>& prints() const { return prints_; }
    /// The prints that recur.
    std::vector<double> recurring() const;
    /// Discards the measurements, which hold no longer, but not what they decided.
    void forget_measurements();

  private:
    /// A kind of roundels.
    struct Kind {
        double first_ratio;          // of its first roundel
        Regression<2> regression{};  // on the print's ratio and the curvature
        int count = 0;               // of measurements
        bool recurs = false;
        std::optional<Print> assigned{};  // the print in use, after it recurs
        void include(double ratio, double by_curvature, double sigma);
        Regression<2>::Estimate estimate() const;         // after a measurement
        double curvature_with(double print_ratio) const;  // if that is the print
        /// The variance of the prints' own ratios around that of the kind.
        double spread(const Regression<2>::Estimate& estimate) const;
    };
    Kind& kind_of(double ratio, double by_curvature);
    bool is_new(int track, double by_curvature);
    void assign(Kind& kind);
    bool collect();

    std::vector<Print> prints_;
    std::vector<Kind> kinds_;
    struct Used {
        int track;
        double by_curvature;
    };
    std::vector<Used> used_;  // measurements of the roundels in view
};

}  // namespace roundel
