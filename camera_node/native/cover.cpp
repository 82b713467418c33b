// SPDX-License-Identifier: BSD-3-Clause
#include "cover.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>

#include "gates.hpp"
#include "ray.hpp"

namespace roundel {

namespace {

constexpr double kPlain = 0.01;   // of the contrast, RMS on the ring's edges, where nothing covers them
constexpr double kMisfit = 0.02;  // likewise, where what is covered is left out
constexpr double kSlacks[] = {0.12, 0.06, 0.03, 0.03};  // of the contrast: a biased fit spreads its misfit
constexpr int kMostHidden = 18;                         // sectors of 32, of either edge
constexpr double kLeastKnown = 12, kLeastNew = 16;      // pixels: smaller ones tell too little
constexpr double kInk = 0.05, kSure = 3.5;  // of the contrast and of the noise: a level is another one
constexpr int kBlurred = 4;                 // sectors of a run that a cover's blurred edge alone may hide

/// The sectors in which the ring shows a level that is neither ink nor paper.
Sectors find_foreign(const ImageView& image, const Fit& fit, double noise) {
    const double contrast = fit.bright - fit.dark, limit = std::max(kInk, kSure * noise / contrast);
    const double ring = (1 - fit.ratio) * fit.outer.minor / 2;
    Sectors foreign = 0;
    for (const double share : {0.3, 0.5, 0.7}) {
        if (std::min(share, 1 - share) * ring < 2 * fit.blur) continue;
        for (int s = 0; s < kSectors; ++s) {
            const auto [x, y] = point_in_sector(fit.p, s, fit.ratio + share * (1 - fit.ratio));
            const float level = sample(image, x, y);
            const double ink = (double(level) - fit.dark) / contrast;
            const bool other = level >= 0 && std::abs(ink) > limit && std::abs(ink - 1) > limit;
            foreign |= Sectors(other) << s;
        }
    }
    return foreign;
}

/// Whether nothing but ink and paper meets the eye in a place where the ring is covered: so do letters look.
bool is_letter(const ImageView& image, const Fit& fit, const Hidden& hidden, double noise) {
    const Sectors foreign = find_foreign(image, fit, noise);
    for (Sectors left = hidden.outer | hidden.inner; left;) {
        const Sectors run = any_run(left);
        if (2 * count_sectors(run & foreign) < count_sectors(run) - kBlurred) return true;
        left &= ~run;
    }
    return false;
}

bool is_hidden_too_much(const Hidden& hidden) {
    return count_sectors(hidden.outer) > kMostHidden || count_sectors(hidden.inner) > kMostHidden;
}

}  // namespace

bool is_plain(const Fit& fit, double noise) {
    return fit.edge_residual < std::hypot(1.2 * noise, kPlain * (fit.bright - fit.dark));
}

std::optional<Fit> fit_rest(const ImageView& image, Start start, const Fit& whole, double noise, bool known) {
    if (whole.outer.major < (known ? kLeastKnown : kLeastNew)) return std::nullopt;
    Fit fit = whole;
    for (const double slack : kSlacks) {
        const Hidden hidden = find_hidden(image, fit.p, noise, slack * (fit.bright - fit.dark));
        if (is_hidden_too_much(hidden)) return std::nullopt;
        if (hidden == start.hidden && slack == *std::rbegin(kSlacks)) break;
        start = {fit.outer, fit.ratio, fit.dark, fit.bright, start.print, hidden};
        const auto rest = refine(image, start);
        if (!rest) return std::nullopt;
        fit = *rest;
    }
    if (!is_as_modelled(fit, noise, kMisfit) || (!known && is_letter(image, fit, start.hidden, noise)))
        return std::nullopt;
    return fit;
}

}  // namespace roundel
