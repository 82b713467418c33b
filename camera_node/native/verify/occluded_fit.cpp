// SPDX-License-Identifier: BSD-3-Clause
#include "verify/occluded_fit.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "verify/sector_view.hpp"
#include "settings.hpp"

namespace roundel {

namespace {

constexpr double kPlain = 0.01;   // of the contrast, RMS on the ring's edges, where nothing covers them
constexpr double kMisfit = 0.02;  // likewise, where what is covered is left out
constexpr double kSlacks[] = {0.48, 0.12, 0.03};  // of the contrast: a biased fit spreads its misfit
constexpr double kShows = 0.06;  // likewise: where a cover would show on a fit that passes all other gates
constexpr int kMostHidden = 26, kMostOfBoth = 44;  // sectors of 32, of an edge and of both
constexpr double kPrintOff = 0.01;  // ratio measured off a print's, by which a bias of the rest shows
constexpr double kLeastKnown = 12, kLeastNew = 16;  // pixels: smaller ones tell too little
constexpr double kInk = 0.05, kSure = 3.5;    // of the contrast and of the noise: a level is another one
constexpr double kInked = 0.12;               // likewise, of a thin stroke
constexpr double kRim = 1.06;                 // outer radii: ink there goes on from the ring
constexpr double kBright = 0.3;               // likewise, of a place in the ring that is no ink, and
constexpr int kMostOpen = 2;                  // as many sectors where nothing seems to cover it
constexpr int kBlurred = 4;                   // sectors of a run that a cover's blurred edge alone may hide
constexpr double kNoPaper = 0.3;              // of the contrast: what differs by more from paper is none
constexpr double kNear = 1.08, kStep = 0.03;  // outer radii at which paper is looked for, from the ring on
constexpr int kSteps = 13, kFirst = 3;        // to 1.44; a card ends beyond the first of them,
constexpr int kBlurredSteps = 5;              // within so many,
constexpr int kLeastSectors = 12;             // in so many sectors

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

/// Whether the paper around the ring ends at one distance all around, but for where something covers it: no
/// letter stands on a round card of its own.
bool has_round_card(const SectorView& view) {
    Sectors paper = ~Sectors(0);
    std::array<int, kSteps> ends{};
    for (int k = 0; k < kSteps; ++k) {
        const Sectors beyond =
            paper & view.find(kNear + k * kStep, [](double level) { return std::abs(level - 1) > kNoPaper; });
        ends[size_t(k)] = count_sectors(beyond), paper &= ~beyond;
    }
    for (auto from = ends.begin() + kFirst; from + kBlurredSteps <= ends.end(); ++from)
        if (std::accumulate(from, from + kBlurredSteps, 0) >= kLeastSectors) return true;
    return false;
}

/// Whether nothing but ink and paper meets the eye in a place where the ring is covered: so do letters look,
/// which have ink in the hole or just outside where their ring is whole.
bool is_letter(const SectorView& view, const Fit& fit, const Hidden& hidden, double noise) {
    const Sectors covered = hidden.outer | hidden.inner, foreign = find_foreign(view, fit, noise);
    Sectors bright = 0;
    for (const double share : {0.25, 0.5, 0.75})
        bright |=
            view.find(fit.ratio + share * (1 - fit.ratio), [](double level) { return level > kBright; });
    if (count_sectors(bright & ~covered) > kMostOpen) return true;
    Sectors inked = 0;
    for (const double radius : {0.8 * fit.ratio, kRim, 1.12, 1.2})
        inked |= view.find(radius, [](double level) { return std::abs(level) < kInked; });
    if (inked & ~(foreign | std::rotl(foreign, 1) | std::rotr(foreign, 1))) return true;
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

/// Whether the ratio, which is all that is known of a new roundel before it is seen, is that of a print. What
/// covers an edge unseen, and so biases the place, biases the ratio first.
bool is_of_print(const Fit& fit, std::span<const double> prints) {
    return prints.empty() || std::abs(nearest_ratio(prints, fit.ratio) - fit.ratio) < kPrintOff;
}

}  // namespace

bool is_noise(const Fit& fit, double noise) { return is_below(fit, noise, kPlain); }

bool shows_cover(const EdgeMisfit& misfit, const Fit& fit, double noise) {
    return misfit.hidden(noise, kShows * (fit.bright - fit.dark)).any();
}

std::optional<Fit> fit_rest(const ImageView& image, Start start, const Fit& whole,
                            std::optional<EdgeMisfit> misfit, double noise, bool known) {
    if (whole.outer.major < (known ? kLeastKnown : kLeastNew)) return std::nullopt;
    Fit fit = whole;
    for (const double slack : kSlacks) {
        if (!misfit) misfit.emplace(image, fit.p);
        const Hidden hidden = misfit->hidden(noise, slack * (fit.bright - fit.dark));
        if (is_hidden_too_much(hidden)) return std::nullopt;
        if (hidden == start.hidden) continue;
        start = {fit.outer, fit.ratio, fit.dark, fit.bright, start.prints, hidden};
        const auto rest = refine(image, start);
        if (!rest) return std::nullopt;
        fit = *rest, misfit.reset();
    }
    if (!is_below(fit, noise, kMisfit)) return std::nullopt;
    if (known) return fit;
    const SectorView view(image, fit);
    if (!is_of_print(fit, start.prints)) return std::nullopt;
    return has_round_card(view) || !is_letter(view, fit, start.hidden, noise) ? std::optional(fit)
                                                                              : std::nullopt;
}

}  // namespace roundel
