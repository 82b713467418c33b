// SPDX-License-Identifier: BSD-3-Clause
#include "gates.hpp"

#include <algorithm>
#include <cmath>

#include "soften.hpp"
#include "surface.hpp"

namespace roundel {

namespace {

constexpr double kBeyond = 30;           // grey levels by which a blurred ring's may seem beyond the scale
constexpr double kMisfit = 0.045;        // of the contrast, RMS on the ring's edges
constexpr double kRaggedMisfit = 0.062;  // of softened edges that were drawn as hard steps
constexpr double kRaggedSupport = 0.8;   // of the edges that agree: ragged ones are alike all around
constexpr double kTellable = 16;         // pixels: smaller ones that are ragged or covered may be letters
constexpr double kMostCovered = 0.35;    // share of the inside
constexpr double kLeastSupport = 0.55;   // of the edges' pixels that must agree where others are covered

/// Whether the ring's edges are as the model says, but for noise and for what print and lens do to them: a
/// twentieth of the contrast (letters have half as much again, or more), and more where large ones are drawn
/// or cut by hand.
bool is_as_modelled(const Fit& fit, double noise, double least) {
    const double misfit = least * std::clamp(fit.outer.major / 30, 1.0, 2.5);
    return fit.edge_residual < std::hypot(1.2 * noise, misfit * (fit.bright - fit.dark));
}

/// Whether something covers a part of the ring and the rest is as the model says, to the noise. Of a roundel
/// that is `known` from the last frame that is enough. A new one might be a letter: its tail covers hole and
/// paper but little of the ring, its thin strokes are off in the ring alone.
bool is_covered(const ImageView& image, const Fit& fit, double noise, bool known) {
    const bool rest = fit.support > kLeastSupport && fit.outer.major >= kTellable &&
                      fit.agreeing_residual < 0.005 * (fit.bright - fit.dark) + 1.25 * noise;
    if (!rest) return false;
    const Surface surface = inspect(image, fit);
    const bool letter = surface.off == surface.ring_off || 3 * surface.ring_off < surface.off;
    return (known || !letter) && surface.off <= kMostCovered * surface.seen;
}

/// The gates that end false positives.
bool is_roundel(const ImageView& image, const Fit& fit, const Settings& settings, double noise, bool known) {
    if (!has_limits(fit, settings)) return false;
    if (!is_as_modelled(fit, noise, kMisfit)) return is_covered(image, fit, noise, known);
    // The fit looks only near the edges, so it takes several thin rings for a thick one.
    const Surface surface = inspect(image, fit);
    return surface.off <= kMostCovered * surface.seen;
}

}  // namespace

bool has_limits(const Fit& fit, const Settings& settings) {
    return settings.ratio_error(fit.ratio) <= settings.ratio_tolerance &&
           fit.bright - fit.dark >= settings.min_contrast && fit.dark > -kBeyond &&
           fit.bright < 255 + kBeyond && fit.outer.major >= settings.min_diameter &&
           fit.outer.major <= settings.max_diameter;
}

std::optional<Fit> fit_roundel(const ImageView& image, Start start, const Settings& settings, double noise,
                               bool known) {
    start.print = settings.nearest_ratio(start.ratio);
    const auto fit = refine(image, start);
    if (fit && is_roundel(image, *fit, settings, noise, known)) return fit;
    if (!fit || fit->support < kRaggedSupport) return std::nullopt;
    const auto soft = refine_softened(image, start);
    const double ragged = start.outer.major < kTellable ? kMisfit : kRaggedMisfit;
    const bool found = soft && has_limits(*soft, settings) && is_as_modelled(*soft, noise * 6 / 16, ragged);
    return found ? soft : std::nullopt;
}

}  // namespace roundel
