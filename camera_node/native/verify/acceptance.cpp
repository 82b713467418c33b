// SPDX-License-Identifier: BSD-3-Clause
#include "verify/acceptance.hpp"

#include <algorithm>
#include <cmath>

#include "verify/level_check.hpp"
#include "verify/occluded_fit.hpp"
#include "verify/shadow_edge.hpp"
#include "verify/smoothed_fit.hpp"

namespace roundel {

namespace {

constexpr double kMisfit = 0.045;        // of the contrast: RMS residual on the ring's edges
constexpr double kRaggedMisfit = 0.062;  // the same for smoothed edges
constexpr double kMaxGrowth = 2.5;       // factor of the misfit allowed for the largest roundels
constexpr double kMaxOffset = 0.15;      // pixels: RMS displacement of an edge around its ellipse
constexpr double kChance = 2;            // times the displacement that noise alone makes
constexpr double kHardBlur = 0.35;       // pixels: sharper edges were drawn to whole pixels
constexpr double kMinCard = 1.1;         // outer diameters: least diameter of a card whose edge shows
constexpr double kProcessing = 0.5;      // share of a misfit that may be common to a whole edge
constexpr double kMaxProcessing = 0.1;   // of the contrast: residuals that processing may make
// A ring of fewer pixels than this shows the product of its width and its contrast, whose factors hardly
// differ from those of a thinner and darker ring: its ink must be black.
constexpr double kThinRing = 3.6;
constexpr double kBlackInk = 0.7;      // share of the paper's level below which ink is black
constexpr double kEvenResidual = 0.6;  // of the residuals, which the fields of uneven light may leave
// Pixels: bends of 5 % are fitted up to 160 at a blur of 0.76, of 0.7 and a pixel. Half of the size leaves
// 0.6 of it (0.7 and two pixels, halved).
constexpr double kLarge = 96;
constexpr double kFalseAlarms = 1e-4;  // rings that noise may make in a picture
constexpr double kEnergyPixels = 100;  // of half axes squared, in which the energy of a ring is measured
constexpr double kMaxWrong = 0.2;      // share of samples of ring and hole with a wrong level

/// Tests of fits to the unmodified image, or to the smoothed one.
struct Tolerance {
    double misfit, max_growth;
};

/// Whether the residuals on the ring's edges are small. Large roundels that were drawn or cut by hand have
/// larger ones.
bool has_small_residuals(const RoundelFit& fit, double noise, const Tolerance& tolerance) {
    const double misfit = tolerance.misfit * std::clamp(fit.outer.major / 30, 1.0, tolerance.max_growth);
    return fit.is_explained(noise, misfit);
}

/// Whether ring and hole have the right levels. The fit uses pixels near the edges only, so several thin
/// rings look like a thick one to it.
bool has_levels(const ImageView& image, const RoundelFit& fit) {
    const LevelSamples samples = check_levels(image, fit);
    return samples.wrong <= kMaxWrong * samples.total;
}

/// Whether white surrounds the ring, as on a card. Otherwise any dark disc with a light spot would pass.
bool has_card(const RoundelFit& fit) {
    const double off = std::abs(fit.p[kGround] - fit.bright);
    return fit.p[kCard] > kMinCard || off < kMinCardStep * fit.contrast();
}

/// Whether both edges follow their ellipses. The width of a letter's stroke varies around the letter; that of
/// a printed or drawn ring does not, however ragged its edges are.
bool has_elliptic_edges(const EdgeMisfit& misfit, const RoundelFit& fit, double noise) {
    const auto [outer, inner] = misfit.displacements(noise);
    const double radius = (fit.outer.major + fit.outer.minor) / 4;
    const double most = kMaxOffset * std::clamp(fit.outer.major / 30, 1.0, kMaxGrowth);
    const auto is_small = [&](const Displacement& edge, double r) {
        // Rounding to whole pixels: a sixth of the turn has about r pixels.
        const double drawn = fit.blur < kHardBlur ? std::sqrt(1 / (12 * r)) : 0;
        return edge.rms < std::hypot(kChance * edge.chance, kChance * drawn, most);
    };
    return is_small(outer, radius) && is_small(inner, fit.ratio * radius);
}

/// The first test that a fit does not pass.
std::optional<Refusal> first_failure(const ImageView& image, const RoundelFit& fit,
                                     const AcceptanceContext& context, const Tolerance& tolerance) {
    if (const auto exceeded = exceeded_limit(fit, context.limits)) return exceeded;
    if (!has_card(fit)) return Refusal::kCard;
    if (!has_small_residuals(fit, context.noise, tolerance)) return Refusal::kResiduals;
    if (!has_levels(image, fit)) return Refusal::kInside;
    return std::nullopt;
}

bool passes(const ImageView& image, const RoundelFit& fit, const AcceptanceContext& context,
            const Tolerance& tolerance) {
    return !first_failure(image, fit, context, tolerance);
}

/// Whether ragged edges may be the reason that a fit was rejected.
bool may_be_ragged(const RoundelFit& fit, const RoundelLimits& limits) {
    return has_known_ratio(fit, limits) && limits.contrast(fit.dark, fit.bright) >= limits.min_contrast / 2;
}

std::optional<RoundelFit> fit_ragged(const ImageView& image, const InitialGuess& guess,
                                     const AcceptanceContext& context) {
    const auto fit = fit_smoothed(image, guess);
    const Tolerance tolerance{guess.outer.major < kMinNew ? kMisfit : kRaggedMisfit, kMaxGrowth};
    const AcceptanceContext smoothed{context.limits, context.camera, context.noise * 6 / 16};
    return fit && passes(image, *fit, smoothed, tolerance) ? fit : std::nullopt;
}

/// Residuals at the edges of this camera's roundels. Before any is known, those of most sectors of an
/// accepted one: sharpening and compression change all of an edge, an occlusion a part of it.
double likely_edge_noise(const AcceptanceContext& context, const EdgeMisfit& misfit, const RoundelFit& fit) {
    const double processing = context.camera.is_known()
                                  ? context.camera.edge_noise()
                                  : std::min(misfit.median(), kMaxProcessing * fit.contrast());
    return std::max(context.noise, processing);
}

/// Widens the claim on the size by what the noise does not explain of the residuals: a displacement of the
/// whole edge that processing makes (sharpening, denoising, compression) does not show in the scatter of the
/// pixels.
void claim_misfit(RoundelFit& fit, double noise) {
    const double excess = std::sqrt(std::max(0.0, square(fit.edge_residual) - square(noise)));
    fit.widen_size(square(kProcessing * excess / fit.contrast() * fit.blur));
}

/// Whether a fit shows the same ring as another one that was tested: its outline is within a blur of it.
bool is_same_ring(const RoundelFit& fit, const RoundelFit& tested) {
    return std::hypot(fit.outer.x - tested.outer.x, fit.outer.y - tested.outer.y) < tested.blur &&
           std::abs(fit.outer.major - tested.outer.major) < tested.blur &&
           std::abs(fit.outer.minor - tested.outer.minor) < tested.blur;
}

/// The fit with what the tests of another one found. That one knows where the card ends.
RoundelFit as_tested(RoundelFit fit, const RoundelFit& tested) {
    fit.p[kCard] = tested.p[kCard];
    fit.p[kGround] = tested.p[kGround];
    fit.unoccluded = tested.unoccluded;
    fit.correlation = tested.correlation;
    fit.uneven = tested.uneven;
    return fit;
}

/// A fit with its tests. `misfit` is empty if noise explains the residuals.
struct TestedFit {
    RoundelFit fit;
    std::optional<EdgeMisfit> misfit;
    bool elliptic, accepted;
};

/// Applies the tests of a fit to the unmodified image, all around.
TestedFit test(const ImageView& image, const RoundelFit& fit, const AcceptanceContext& context) {
    TestedFit tested{fit, std::nullopt, true, false};
    if (fit.fields.has_light() || !is_explained_by_noise(fit, context.noise))
        tested.misfit.emplace(image, fit.p, fit.fields);
    const auto& misfit = tested.misfit;
    if (misfit) tested.fit.correlation = misfit->correlation(fit.noise, {});
    tested.elliptic = !misfit || has_elliptic_edges(*misfit, fit, context.noise);
    tested.accepted = tested.elliptic && passes(image, fit, context, {kMisfit, kMaxGrowth});
    tested.fit.unoccluded =
        tested.accepted &&
        !(misfit && shows_occlusion(*misfit, fit, likely_edge_noise(context, *misfit, fit)));
    return tested;
}

/// The fit with all fields, if it shows the whole roundel: highlights and shadows change the residuals as an
/// occlusion does, but smoothly.
std::optional<TestedFit> fit_uneven(const ImageView& image, InitialGuess guess, const RoundelFit& fit,
                                    double ground, const AcceptanceContext& context) {
    guess.outer = fit.outer;
    guess.model = fit.p;
    guess.noise = fit.noise;
    guess.fields = AllowedFields::kAll;
    guess.ground = ground;
    const auto even = fit_photometric(image, guess);
    if (!even) return std::nullopt;
    // Residuals that processing leaves around all of the ring remain.
    if (!fit.uneven && even->edge_residual > kEvenResidual * fit.edge_residual) return std::nullopt;
    const TestedFit tested = test(image, *even, context);
    return tested.fit.unoccluded ? std::optional(tested) : std::nullopt;
}

}  // namespace

bool has_known_ratio(const RoundelFit& fit, const RoundelLimits& limits) {
    return limits.print_error(fit.ratio) <= limits.ratio_tolerance;
}

std::optional<Refusal> exceeded_limit(const RoundelFit& fit, const RoundelLimits& limits) {
    const double by_tone = kMaxCurvature * ratio_by_curvature(fit, fit.ratio);
    if (!has_known_ratio(fit, limits) && !limits.may_be_print(fit.ratio, fit.outer.major, by_tone))
        return Refusal::kRatio;
    if (limits.contrast(fit.dark, fit.bright) < limits.min_contrast) return Refusal::kContrast;
    const double major = fit.outer.major;
    if (major < limits.min_diameter || major > limits.max_diameter) return Refusal::kSize;
    return std::nullopt;
}

/// Whether the ink is black if the ring is so thin that the picture does not tell a pale ring from a thinner
/// one. New roundels must pass.
static bool has_black_ink(const RoundelFit& fit) {
    return (1 - fit.ratio) * fit.outer.major / 2 >= kThinRing || fit.dark < kBlackInk * fit.bright;
}

/// The energy of a ring in the picture, squared grey levels times pixels: the squared difference of the mean
/// levels of its ink and of the paper in and around it, times the pixels that determine the difference.
static double ring_energy(const ImageView& image, const RoundelFit& fit) {
    const Ellipse& e = fit.outer;
    const double a = e.major / 2, b = e.minor / 2, c = std::cos(e.angle), s = std::sin(e.angle);
    const double ax = c / a, ay = s / a, bx = -s / b, by = c / b, reach = kMinCard * a;
    const int step = std::max(1, int(a * b / kEnergyPixels));
    double n[2]{}, sum[2]{};
    for (int v = std::max(0, int(e.y - reach)); v <= std::min(image.height - 1, int(e.y + reach)); ++v)
        for (int u = std::max(0, int(e.x - reach)) + v % step;
             u <= std::min(image.width - 1, int(e.x + reach)); u += step) {
            const double x = u - e.x, y = v - e.y;
            const double squared = square(ax * x + ay * y) + square(bx * x + by * y);
            if (squared > square(kMinCard)) continue;
            const bool ink = squared > square(fit.ratio) && squared < 1;
            n[ink] += step;
            sum[ink] += step * double(image.row(v)[u]);
        }
    if (!(n[0] > 0 && n[1] > 0)) return 0;
    return square(sum[0] / n[0] - sum[1] / n[1]) * n[0] * n[1] / (n[0] + n[1]);
}

std::optional<Refusal> refusal_of_new(const ImageView& image, const RoundelFit& fit, double density) {
    const double places = double(image.width) * image.height;
    // Noise of these residuals that is equal in each block of a compression has the greatest density.
    const double greatest = square(kTile * std::max(1.0, fit.edge_residual));
    const double least_energy = 2 * std::log(places / kFalseAlarms) * std::min(density, greatest);
    if (ring_energy(image, fit) < least_energy) return Refusal::kContrast;
    return has_black_ink(fit) ? std::nullopt : std::optional(Refusal::kPaleInk);
}

bool is_within_limits(const RoundelFit& fit, const RoundelLimits& limits) {
    return !exceeded_limit(fit, limits);
}

std::optional<Refusal> find_refusal(const ImageView& image, const RoundelFit& fit,
                                    const AcceptanceContext& context) {
    const EdgeMisfit misfit(image, fit.p, fit.fields);
    const OcclusionMask hidden = misfit.occlusion(context.noise, kWrongLevel * fit.contrast());
    const bool covered = hidden.any();
    const auto failure = first_failure(image, fit, context, {kMisfit, kMaxGrowth});
    // A cover biases ratio, card, residuals and levels, but neither contrast nor size.
    if (failure == Refusal::kContrast || failure == Refusal::kSize || (failure && !covered)) return failure;
    if (covered) return Refusal::kCover;
    if (!has_black_ink(fit)) return Refusal::kPaleInk;
    return has_elliptic_edges(misfit, fit, context.noise) ? std::nullopt
                                                          : std::optional(Refusal::kNotElliptic);
}

/// The fit without the edge of a shadow, if that shows the whole roundel. The first outline is one in uneven
/// light; the second one tells better where paper and ink are. Fields are what the edge's shape leaves.
static std::optional<RoundelFit> fit_shadowed(const ImageView& image, InitialGuess guess,
                                              const AcceptanceContext& context, bool known) {
    guess.model.reset();
    for (int k = 0; k < 2; ++k) {
        WithoutShadow even_light(image, guess);
        if (!even_light.is_explained()) return std::nullopt;
        InitialGuess& lit = even_light.even_guess;
        auto fit = fit_photometric(even_light.view(), lit);
        if (fit && k) {
            lit.model = fit->p;
            lit.outer = fit->outer;
            lit.noise = fit->noise;
            lit.fields = AllowedFields::kAll;
            fit = fit_photometric(even_light.view(), lit);
        }
        if (!fit) return std::nullopt;
        guess.outer = even_light.in_image(*fit).outer;
        guess.ratio = fit->ratio;
        if (!k) continue;
        const AcceptanceContext even{context.limits, context.camera, context.noise * even_light.noise_gain};
        TestedFit tested = test(even_light.view(), *fit, even);
        if (!tested.accepted || !(known || is_certain_roundel(even_light.view(), *fit, lit, even.noise)))
            return std::nullopt;
        tested.fit.unoccluded = false;  // in the image as it is
        tested.fit.shadowed = true;
        claim_misfit(tested.fit, even.noise);
        return even_light.in_image(tested.fit);
    }
    return std::nullopt;
}

/// Fits a roundel to the image as it is, or smoothed.
static std::optional<RoundelFit> fit_at_full_size(const ImageView& image, const InitialGuess& guess,
                                                  const AcceptanceContext& context, bool known) {
    const auto fits = fit_on_ground(image, guess);
    if (!fits) return guess.model ? std::nullopt : fit_shadowed(image, guess, context, known);
    const RoundelFit* const first = &fits->even;
    TestedFit tested = test(image, *first, context);
    const bool is_even = tested.fit.unoccluded && !first->uneven;
    // Before the camera is known, its tone curve and its processing look like uneven light.
    if (context.camera.is_known() && (first->uneven || !tested.fit.unoccluded) &&
        is_within_limits(*first, context.limits))
        if (const auto even =
                fit_uneven(image, guess, *first, fits->weighed ? fits->weighed->ground : 0, context);
            even && (known || tested.accepted || is_certain_roundel(image, even->fit, guess, context.noise)))
            tested = *even;
    if (fits->weighed && is_same_ring(*fits->weighed, *first)) {
        const RoundelFit weighed = as_tested(*fits->weighed, tested.fit);
        // The ground displaces a small fit, whose residuals then look like those of an occlusion.
        if (is_even)
            tested.fit = weighed;
        else if (context.camera.is_known() && !first->uneven && !tested.fit.unoccluded)
            if (const TestedFit again = test(image, weighed, context); again.accepted) tested = again;
    }
    auto& [fit, misfit, elliptic, accepted] = tested;
    claim_misfit(fit, context.noise);
    if (fit.unoccluded || guess.model) return fit.unoccluded ? std::optional(fit) : std::nullopt;
    if (const auto lit = fit_shadowed(image, guess, context, known)) return lit;
    const double at_edges = misfit ? likely_edge_noise(context, *misfit, fit) : context.noise;
    const auto rest =
        fit_occluded(image, {guess, fit, misfit, at_edges, known || accepted, context.knows_camera});
    if (rest && is_within_limits(*rest, context.limits)) return rest;
    if (accepted) return fit;
    if (!elliptic || !may_be_ragged(fit, context.limits)) return std::nullopt;
    InitialGuess ragged = guess;
    ragged.clipped = fit.clipped;
    return fit_ragged(image, ragged, context);
}

/// Fits a roundel with what is known of its camera; a large one that is refused at half the size.
static std::optional<RoundelFit> fit_at_any_size(const ImageView& image, const InitialGuess& guess,
                                                 const AcceptanceContext& context, bool known) {
    const auto fit = fit_at_full_size(image, guess, context, known);
    if (fit || guess.model || guess.outer.major < kLarge) return fit;
    const Halved halved(image, guess);
    const AcceptanceContext half{context.limits, context.camera, context.noise / 2, context.knows_camera};
    const auto rest = fit_at_any_size(halved.view(), halved.half_guess, half, known);
    if (!rest) return std::nullopt;
    const RoundelFit whole = halved.in_image(*rest);
    return is_within_limits(whole, context.limits) ? std::optional(whole) : std::nullopt;
}

std::optional<RoundelFit> fit_roundel(const ImageView& image, InitialGuess guess,
                                      const AcceptanceContext& context, bool known) {
    guess.camera = context.camera.prior_at(guess.outer.x, guess.outer.y);
    guess.fields = AllowedFields::kBend;
    return fit_at_any_size(image, guess, context, known);
}

}  // namespace roundel
