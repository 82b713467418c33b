// SPDX-License-Identifier: BSD-3-Clause
#include "verify/acceptance.hpp"

#include <algorithm>
#include <cmath>

#include "verify/occluded_fit.hpp"
#include "verify/soften.hpp"
#include "verify/level_check.hpp"

namespace roundel {

namespace {

constexpr double kTiny = 11;       // pixels: of smaller ones blur and ratio trade places,
constexpr double kUnsure = 0.04;   // so twice a ratio's standard deviation is granted, of so much at most
constexpr double kBeyond = 30;     // grey levels by which a blurred ring's may seem beyond the scale
constexpr double kMisfit = 0.045;  // of the contrast, RMS on the ring's edges
constexpr double kRaggedMisfit = 0.062;  // of softened edges that were drawn as hard steps
constexpr double kOff = 0.15;            // pixels by which an edge may be off all around, of most sizes, and
constexpr double kOffRadius = 0.04;      // of its radius, of the smallest
constexpr double kChance = 2;            // times what noise alone puts it off
constexpr double kHard = 0.35;           // pixels of blur: what is sharper was drawn to whole pixels
constexpr double kMost = 2.5;            // times as much of the largest ones, and
constexpr double kMostRagged = 1.5;      // where softening took most of it already
constexpr double kRaggedSupport = 0.8;   // of the edges that agree: ragged ones are alike all around
constexpr double kTellable = 16;         // pixels: smaller ones that are ragged may be letters
constexpr double kSameLevel = 0.2;       // of the contrast, between ground and card
constexpr double kLeastCard = 1.1;       // outer diameters of white around the ring, where its edge shows
constexpr double kMostOff = 0.2;  // share of ring and hole that is not as dark or bright as it should be

/// Whether the ring's edges are as the model says, but for noise and for what print and lens do to them:
/// `misfit` of the contrast, and up to `most` times that where large ones are drawn or cut by hand.
bool is_as_modelled(const Fit& fit, double noise, double misfit, double most) {
    const double least = misfit * std::clamp(fit.outer.major / 30, 1.0, most);
    return fit.edge_residual < std::hypot(1.2 * noise, least * (fit.bright - fit.dark));
}

/// Whether ring and hole are as dark and bright as they should be. The fit looks only near the edges, so it
/// takes several thin rings for a thick one.
bool has_surface(const ImageView& image, const Fit& fit) {
    const Surface surface = inspect(image, fit);
    return surface.off <= kMostOff * surface.seen;
}

/// Whether the ring stands on the hole's white, as on any card; without it any dark disc with a light spot in
/// its middle would pass.
bool has_card(const Fit& fit) {
    const double off = std::abs(fit.p[kGround] - fit.bright);
    return fit.p[kCard] > kLeastCard || off < kSameLevel * (fit.bright - fit.dark);
}

/// Whether both edges are where the fit has them: a letter's stroke is thicker here and thinner there, that
/// of a print or a drawing, however ragged, is not.
bool has_edges_in_place(const EdgeMisfit& misfit, const Fit& fit, double noise) {
    const auto [outer, inner] = misfit.displacements(noise);
    const double radius = (fit.outer.major + fit.outer.minor) / 4;
    const double most = kOff * std::clamp(fit.outer.major / 30, 1.0, kMost);
    const auto is_in_place = [&](const Displacement& edge, double r) {
        const double drawn =
            fit.blur < kHard ? std::sqrt(1 / (12 * r)) : 0;  // a sixth of the turn has r pixels
        return edge.rms < std::hypot(kChance * edge.chance, kChance * drawn, std::min(kOffRadius * r, most));
    };
    return is_in_place(outer, radius) && is_in_place(inner, fit.ratio * radius);
}

/// The gates that end false positives.
bool is_whole(const ImageView& image, const Fit& fit, const Settings& settings, double noise, double misfit,
              double most) {
    return has_limits(fit, settings) && has_card(fit) && is_as_modelled(fit, noise, misfit, most) &&
           has_surface(image, fit);
}

/// Whether the ratio is a print's, but for the tolerance and for what noise makes of the smallest.
bool has_ratio(const Fit& fit, const Settings& settings) {
    const double chance = fit.outer.major < kTiny ? 2 * std::min(fit.ratio_sigma, kUnsure) : 0;
    return settings.ratio_error(fit.ratio) <= std::hypot(settings.ratio_tolerance, chance);
}

/// Whether a fit that failed looks as if only its edges were ragged.
bool may_be_ragged(const Fit& fit, const Settings& settings) {
    return has_ratio(fit, settings) && fit.bright - fit.dark >= settings.min_contrast / 2 &&
           fit.support >= kRaggedSupport;
}

}  // namespace

bool has_limits(const Fit& fit, const Settings& settings) {
    return has_ratio(fit, settings) && fit.bright - fit.dark >= settings.min_contrast &&
           fit.dark > -kBeyond && fit.bright < 255 + kBeyond && fit.outer.major >= settings.min_diameter &&
           fit.outer.major <= settings.max_diameter;
}

std::optional<Fit> fit_roundel(const ImageView& image, Start start, const Settings& settings, double noise,
                               bool known) {
    start.prints = settings.inner_ratios;
    auto fit = refine(image, start);
    if (!fit) return std::nullopt;
    std::optional<EdgeMisfit> misfit;
    if (!is_noise(*fit, noise)) misfit.emplace(image, fit->p);
    const bool in_place = !misfit || has_edges_in_place(*misfit, *fit, noise);
    const bool whole = in_place && is_whole(image, *fit, settings, noise, kMisfit, kMost);
    fit->plain = whole && !(misfit && shows_cover(*misfit, *fit, noise));
    if (fit->plain || start.model) return fit->plain ? fit : std::nullopt;
    const auto rest = fit_rest(image, start, *fit, misfit, noise, known || whole);
    if (rest && has_limits(*rest, settings)) return rest;
    if (whole) return fit;
    if (!in_place || !may_be_ragged(*fit, settings)) return std::nullopt;
    const auto soft = refine_softened(image, start);
    const double ragged = start.outer.major < kTellable ? kMisfit : kRaggedMisfit;
    return soft && is_whole(image, *soft, settings, noise * 6 / 16, ragged, kMostRagged) ? soft
                                                                                         : std::nullopt;
}

}  // namespace roundel
