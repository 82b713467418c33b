// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_limits.hpp"
#include "numeric/image.hpp"
#include "verify/camera_model.hpp"

namespace roundel {

/// Whether the ratio is that of a known print, within the tolerance.
bool has_known_ratio(const RoundelFit& fit, const RoundelLimits& limits);

/// The test that a ring-like shape fails. The numbers are those of `camera_node.detection.refusals`.
enum class Refusal {
    kNoFit,        // the model of a roundel does not converge on it
    kRatio,        // not a print's
    kContrast,     // too low
    kSize,         // out of limits
    kCard,         // no white around the ring
    kResiduals,    // too large at the edges
    kNotElliptic,  // an edge is no ellipse
    kInside,       // ring or hole have places with a wrong level
    kCover,        // a part is covered, and the rest does not suffice
    kBullseye,     // further rings around it
    kPaleInk       // a ring so thin that a thinner, black one may look the same
};

/// The test that a fit which passes all others fails as a new roundel, if any: noise of this `density`
/// (`noise_density`), or of less where a ring's own residuals show less, makes rings of little energy
/// somewhere in a picture, in which it explains all residuals, and a thin ring of pale ink looks like a
/// thinner, black one.
std::optional<Refusal> refusal_of_new(const ImageView& image, const RoundelFit& fit, double density);

/// The limit that a fit exceeds, if any.
std::optional<Refusal> exceeded_limit(const RoundelFit& fit, const RoundelLimits& limits);

/// Whether contrast, ratio and size are within their limits.
bool is_within_limits(const RoundelFit& fit, const RoundelLimits& limits);

/// What the acceptance tests of a frame depend on, beside the fit.
struct AcceptanceContext {
    const RoundelLimits& limits;
    const CameraModel& camera;
    double noise;              // of the image, grey levels
    bool knows_camera = true;  // as well as this frame shows it; else fits may be provisional
};

/// Fits a roundel and applies the acceptance tests that reject false positives. If the fit to the unmodified
/// image fails, tries the fit without occluded sectors, then the fit to a smoothed image, which suits ragged
/// edges (drawn, sharpened, badly printed). Returns nothing if none passes.
///
/// The tests are wider for a roundel that is `known` from the last frame. With a guess that has a model only
/// the first fit is tried: if it fails, the caller needs another guess.
std::optional<RoundelFit> fit_roundel(const ImageView& image, InitialGuess guess,
                                      const AcceptanceContext& context, bool known);

/// The first test that a fit of all of a ring does not pass, if any.
std::optional<Refusal> find_refusal(const ImageView& image, const RoundelFit& fit,
                                    const AcceptanceContext& context);

}  // namespace roundel
