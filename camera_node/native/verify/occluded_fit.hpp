// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "fit/occlusion.hpp"
#include "fit/photometric_fit.hpp"
#include "numeric/image.hpp"

namespace roundel {

constexpr double kMinNew = 16;  // pixels: smaller rings that are covered or ragged may be letters

/// Whether noise and a hundredth of the contrast explain the residuals on the ring's edges.
bool is_explained_by_noise(const RoundelFit& fit, double noise);

/// Whether the residuals are concentrated in some sectors, as an occlusion makes them. Those of print, paper
/// and lens are spread around the ring.
bool shows_occlusion(const EdgeMisfit& misfit, const RoundelFit& fit, double noise);

/// Whether a fit that does not show all of a roundel, or shows it in uneven light, is no letter: its ratio is
/// that of a print within 0.01 (or through a tone curve that is not known yet, if `by_curvature` is how much
/// one of curvature 1 enlarges it), and either it has a round card, or the levels of the parts that the guess
/// leaves out are not those of ink and paper.
bool is_certain_roundel(const ImageView& image, const RoundelFit& fit, const InitialGuess& guess,
                        double noise, double by_curvature = 0);

/// The input of a fit to the visible part of a roundel.
struct OccludedGuess {
    const InitialGuess& guess;
    const RoundelFit& full_fit;        // to all sectors
    std::optional<EdgeMisfit> misfit;  // of `full_fit`, if it was computed
    double noise;                      // of the image, grey levels
    bool known;                        // from the last frame
    bool knows_camera;                 // its tone curve and its processing
};

/// Fits the visible part of a partly occluded roundel. Sectors of either edge with large residuals are masked
/// and the fit is repeated with ever stricter limits, until the residuals of the rest agree with the model. A
/// biased fit does not pass. The covariance is that of the visible part.
///
/// A new roundel must not look like a letter, and its ratio must be that of a print within 0.01. Both is
/// allowed for a known one.
std::optional<RoundelFit> fit_occluded(const ImageView& image, const OccludedGuess& input);

}  // namespace roundel
