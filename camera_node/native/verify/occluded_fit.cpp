// SPDX-License-Identifier: BSD-3-Clause
#include "verify/occluded_fit.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "fit/roundel_limits.hpp"
#include "numeric/ray.hpp"
#include "verify/learning.hpp"
#include "verify/level_check.hpp"
#include "verify/print_ratios.hpp"

namespace roundel {

namespace {

// RMS residuals on the ring's edges, over the contrast:
constexpr double kNoiseMisfit = 0.01;  // of a roundel without occlusion
constexpr double kRestMisfit = 0.02;   // of the visible part of an occluded one
constexpr double kOcclusion = 0.06;    // of sectors that show an occlusion although the fit passes the tests
// Of masked sectors, in turn: a biased fit spreads its misfit.
constexpr double kSlacks[] = {0.48, 0.12, 0.03};

constexpr int kMaxMasked = 26;            // sectors of 32, of one edge
constexpr int kMaxMaskedOfBoth = 44;      // sectors of 64, of both edges
constexpr double kMaxRatioError = 0.01;   // from the nearest print, beside its uncertainty: shows a bias
constexpr double kMaxRatioSigma = 0.005;  // of that uncertainty

// Levels in units of the contrast, from ink (0) to paper (1):
constexpr double kForeign = 0.05;       // difference of a level that is neither of them
constexpr double kForeignSigmas = 3.5;  // the same in standard deviations
constexpr double kThinInk = 0.12;       // of a thin stroke
constexpr int kMaxBright = 2;           // unmasked sectors of the ring without ink

constexpr double kRim = 1.06;  // outer radii: ink there continues the ring
constexpr int kBlurred = 4;    // sectors of a run that the blurred edge of an occluding object can mask
constexpr double kFirstRadius = 1.08;  // least of the outer radii at which paper is searched
constexpr double kStep = 0.03;         // from one of them to the next
constexpr int kSteps = 13;             // up to 1.44
constexpr int kFirst = 3;              // the end of a round card is found beyond
constexpr int kBlurredSteps = 5;       // a blurred end lies within so many steps of kFirst
constexpr int kMinSectors = 12;        // in so many sectors

/// The surroundings of a fitted roundel by sector and radius, in levels from ink (0) to paper (1).
class SectorView {
  public:
    SectorView(const ImageView& image, const RoundelFit& fit) : image_(image), fit_(fit) {}
    /// The sectors whose middle at `radius`, in outer radii, is in the image and passes the test.
    template <typename Test>
    Sectors find(double radius, const Test& test) const {
        Sectors found = 0;
        for (int s = 0; s < kSectors; ++s) {
            const auto [x, y] = point_in_sector(fit_.p, s, radius);
            const float seen = sample(image_, x, y);
            const double level = fit_.fields.even_level(double(x), double(y), double(seen));
            found |= Sectors(seen >= 0 && test(fit_.share(level))) << s;
        }
        return found;
    }

  private:
    const ImageView& image_;
    const RoundelFit& fit_;
};

/// The sectors in which the ring shows a level that is neither ink nor paper.
Sectors find_foreign(const SectorView& view, const RoundelFit& fit, double noise) {
    const double limit = std::max(kForeign, kForeignSigmas * noise / fit.contrast());
    const double ring = (1 - fit.ratio) * fit.outer.minor / 2;
    Sectors foreign = 0;
    for (const double share : {0.3, 0.5, 0.7})
        if (std::min(share, 1 - share) * ring > 2 * fit.blur)
            foreign |= view.find(fit.ratio + share * (1 - fit.ratio), [&](double level) {
                return std::abs(level) > limit && std::abs(level - 1) > limit;
            });
    return foreign;
}

/// Whether the paper around the ring ends at the same radius in many sectors, as on a round card: where
/// levels differ from it by `limit`. No letter is printed on a round card of its own size.
bool ends_round(const SectorView& view, double limit) {
    Sectors paper = ~Sectors(0);
    std::array<int, kSteps> ends{};
    for (int k = 0; k < kSteps; ++k) {
        const Sectors beyond = paper & view.find(kFirstRadius + k * kStep, [limit](double level) {
            return std::abs(level - 1) > limit;
        });
        ends[size_t(k)] = count_sectors(beyond);
        paper &= ~beyond;
    }
    for (auto from = ends.begin() + kFirst; from + kBlurredSteps <= ends.end(); ++from)
        if (std::accumulate(from, from + kBlurredSteps, 0) >= kMinSectors) return true;
    return false;
}

/// A round card ends at a wrong level, or half way to the level that the fit finds beyond it: a tone curve
/// makes grey ground nearly as bright as paper.
bool has_round_card(const SectorView& view, const RoundelFit& fit, double noise) {
    const double half = std::abs(fit.share(fit.p[kGround]) - 1) / 2;
    const double limit = std::max(half, kForeignSigmas * noise / fit.contrast());
    return ends_round(view, kWrongLevel) || (limit < kWrongLevel && ends_round(view, limit));
}

/// Whether a masked part of the ring shows only ink and paper, as letters do. Letters have ink in the hole or
/// just outside of the ring where the ring is complete.
bool is_letter(const SectorView& view, const RoundelFit& fit, const OcclusionMask& mask, double noise) {
    const Sectors masked = mask.outer | mask.inner, foreign = find_foreign(view, fit, noise);
    Sectors bright = 0;
    for (const double share : {0.25, 0.5, 0.75})
        bright |=
            view.find(fit.ratio + share * (1 - fit.ratio), [](double level) { return level > kWrongLevel; });
    if (count_sectors(bright & ~masked) > kMaxBright) return true;
    Sectors inked = 0;
    for (const double radius : {0.8 * fit.ratio, kRim, 1.12, 1.2})
        inked |= view.find(radius, [](double level) { return std::abs(level) < kThinInk; });
    if (inked & ~(foreign | std::rotl(foreign, 1) | std::rotr(foreign, 1))) return true;
    for (Sectors left = masked; left;) {
        const Sectors run = any_run(left);
        if (2 * count_sectors(run & foreign) < count_sectors(run) - kBlurred) return true;
        left &= ~run;
    }
    return false;
}

bool masks_too_much(const OcclusionMask& mask) {
    const int outer = count_sectors(mask.outer), inner = count_sectors(mask.inner);
    return std::max(outer, inner) > kMaxMasked || outer + inner > kMaxMaskedOfBoth;
}

/// Whether most of the inner edge is masked and nothing of the outer one, across which a cover reaches it: a
/// letter whose hole has another shape.
bool hides_inner_edge_only(const OcclusionMask& mask) {
    return !mask.outer && count_sectors(mask.inner) > kSectors / 2;
}

/// Whether the ratio is that of a print, through any tone curve of a camera if `by_curvature` is not 0. Of a
/// new roundel nothing else is known in advance. An occlusion that the residuals do not show biases the ratio
/// as well as the position.
bool has_print_ratio(const RoundelFit& fit, std::span<const Print> prints, double by_curvature) {
    const double error = std::hypot(kMaxRatioError, 2 * std::min(fit.ratio_sigma, kMaxRatioSigma));
    return prints.empty() || std::any_of(prints.begin(), prints.end(), [&](const Print& print) {
               const double off = fit.ratio - print.ratio;
               return off > kMinCurvature * by_curvature - error &&
                      off < kMaxCurvature * by_curvature + error;
           });
}

}  // namespace

bool is_explained_by_noise(const RoundelFit& fit, double noise) {
    return fit.is_explained(noise, kNoiseMisfit);
}

bool shows_occlusion(const EdgeMisfit& misfit, const RoundelFit& fit, double noise) {
    return misfit.occlusion(noise, kOcclusion * fit.contrast()).any();
}

bool is_certain_roundel(const ImageView& image, const RoundelFit& fit, const InitialGuess& guess,
                        double noise, double by_curvature) {
    if (!has_print_ratio(fit, guess.camera.prints, by_curvature)) return false;
    const SectorView view(image, fit);
    return has_round_card(view, fit, noise) || !is_letter(view, fit, guess.occlusion, noise);
}

std::optional<RoundelFit> fit_occluded(const ImageView& image, const OccludedGuess& input) {
    if (input.full_fit.outer.major < (input.known ? kMinMeasured : kMinNew)) return std::nullopt;
    InitialGuess guess = input.guess;
    RoundelFit fit = input.full_fit;
    std::optional<EdgeMisfit> misfit = input.misfit;
    for (const double slack : kSlacks) {
        if (!misfit) misfit.emplace(image, fit.p, fit.fields);
        const OcclusionMask mask = misfit->occlusion(input.noise, slack * fit.contrast());
        if (masks_too_much(mask)) return std::nullopt;
        if (mask == guess.occlusion) continue;
        guess = {.outer = fit.outer,
                 .ratio = fit.ratio,
                 .dark = fit.dark,
                 .bright = fit.bright,
                 .occlusion = mask,
                 .camera = guess.camera};
        const auto rest = fit_photometric(image, guess);
        if (!rest) return std::nullopt;
        fit = *rest;
        misfit.reset();
    }
    if (!fit.is_explained(input.noise, kRestMisfit)) return std::nullopt;
    fit.correlation = EdgeMisfit(image, fit.p, fit.fields).correlation(fit.noise, guess.occlusion);
    if (input.known) return fit;
    if (hides_inner_edge_only(guess.occlusion)) return std::nullopt;
    fit.provisional = !input.knows_camera;
    const double tone = fit.provisional ? ratio_by_curvature(fit, fit.ratio) : 0;
    return is_certain_roundel(image, fit, guess, input.noise, tone) ? std::optional(fit) : std::nullopt;
}

}  // namespace roundel
