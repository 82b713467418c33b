// SPDX-License-Identifier: BSD-3-Clause
#include "cover.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>

#include "bar.hpp"
#include "sector_view.hpp"

namespace roundel {

namespace {

constexpr double kPlain = 0.01;   // of the contrast, RMS on the ring's edges, where nothing covers them
constexpr double kMisfit = 0.02;  // likewise, where what is covered is left out
constexpr double kSlacks[] = {0.12, 0.06, 0.03, 0.03};  // of the contrast: a biased fit spreads its misfit
constexpr double kShows = 0.06;  // likewise: where a cover would show on a fit that passes all other gates
constexpr int kMostHidden = 22, kMostOfBoth = 36;   // sectors of 32, of an edge and of both
constexpr double kLeastKnown = 12, kLeastNew = 16;  // pixels: smaller ones tell too little
constexpr double kInk = 0.05, kSure = 3.5;  // of the contrast and of the noise: a level is another one
constexpr double kInked = 0.12;             // likewise, of a thin stroke
constexpr double kRim = 1.06;               // outer radii: ink there goes on from the ring
constexpr double kBright = 0.3;             // likewise, of a place in the ring that is no ink, and
constexpr int kMostOpen = 2;                // as many sectors where nothing seems to cover it
constexpr int kBlurred = 4;                 // sectors of a run that a cover's blurred edge alone may hide

/// Whether the noise and so much of the contrast explain what is left on the ring's edges.
bool is_below(const Fit& fit, double noise, double misfit) {
    return fit.edge_residual < std::hypot(1.2 * noise, misfit * (fit.bright - fit.dark));
}

/// The sectors in which the ring shows a level that is neither ink nor paper.
Sectors find_foreign(const SectorView& view, const Fit& fit, double noise) {
    const double limit = std::max(kInk, kSure * noise / (fit.bright - fit.dark));
    const double ring = (1 - fit.ratio) * fit.outer.minor / 2;
    Sectors foreign = 0;
    for (const double share : {0.3, 0.5, 0.7})
        if (std::min(share, 1 - share) * ring > 2 * fit.blur)
            foreign |= view.find(fit.ratio + share * (1 - fit.ratio), [&](double level) {
                return std::abs(level) > limit && std::abs(level - 1) > limit;
            });
    return foreign;
}

/// Whether nothing but ink and paper meets the eye in a place where the ring is covered: so do letters look,
/// which have ink in the hole or just outside where their ring is whole. A dark bar from end to end is none.
bool is_letter(const ImageView& image, const Fit& fit, const Hidden& hidden, double noise) {
    const SectorView view(image, fit);
    const Sectors covered = hidden.outer | hidden.inner;
    Sectors foreign = find_foreign(view, fit, noise);
    const auto bar = find_bar(image, fit, noise);
    if (bar) foreign |= bar->hides(1) | bar->hides(fit.ratio);
    Sectors bright = 0;
    for (const double share : {0.25, 0.5, 0.75})
        bright |=
            view.find(fit.ratio + share * (1 - fit.ratio), [](double level) { return level > kBright; });
    if (count_sectors(bright & ~covered) > kMostOpen) return true;
    Sectors inked = 0;
    for (const double radius : {0.8 * fit.ratio, kRim, 1.12, 1.2})
        inked |= view.find(radius, [](double level) { return std::abs(level) < kInked; });
    if (!bar && inked & ~(foreign | std::rotl(foreign, 1) | std::rotr(foreign, 1))) return true;
    for (Sectors left = covered; left;) {
        const Sectors run = any_run(left);
        if (2 * count_sectors(run & foreign) < count_sectors(run) - kBlurred) return true;
        left &= ~run;
    }
    return false;
}

bool is_hidden_too_much(const Hidden& hidden) {
    const int outer = count_sectors(hidden.outer), inner = count_sectors(hidden.inner);
    return std::max(outer, inner) > kMostHidden || outer + inner > kMostOfBoth;
}

}  // namespace

bool shows_cover(const ImageView& image, const Fit& fit, double noise) {
    return !is_below(fit, noise, kPlain) &&
           find_hidden(image, fit.p, noise, kShows * (fit.bright - fit.dark)).any();
}

std::optional<Fit> fit_rest(const ImageView& image, Start start, const Fit& whole, double noise, bool known) {
    if (whole.outer.major < (known ? kLeastKnown : kLeastNew)) return std::nullopt;
    Fit fit = whole;
    for (const double slack : kSlacks) {
        const Hidden hidden = find_hidden(image, fit.p, noise, slack * (fit.bright - fit.dark));
        if (is_hidden_too_much(hidden)) return std::nullopt;
        if (hidden == start.hidden) continue;
        start = {fit.outer, fit.ratio, fit.dark, fit.bright, start.prints, hidden};
        const auto rest = refine(image, start);
        if (!rest) return std::nullopt;
        fit = *rest;
    }
    if (!is_below(fit, noise, kMisfit) || (!known && is_letter(image, fit, start.hidden, noise)))
        return std::nullopt;
    return fit;
}

}  // namespace roundel
