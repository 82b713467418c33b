// SPDX-License-Identifier: BSD-3-Clause
#include <cmath>

#include "fit/photometric_fitter.hpp"

namespace roundel {

namespace {

constexpr double kMinPlateauMajor = 48;  // pixels: smaller ones gain less than a tone curve costs
constexpr int kMinPlateau = 16;          // pixels
constexpr double kPlateauVariance = 2;   // factor from that of the residuals at the edges
constexpr double kMaxPlateauError = 3;   // standard deviations

}  // namespace

/// Adds the level of a plateau to the system, and its residual to `g`; false if that level is not the one at
/// the edges: where cameras sharpen, in uneven light, or for writing on the paper. Its noise must be that of
/// the edges, too, which a tone curve and compression change.
bool PhotometricFitter::condition_on_plateau(Parameter level, const Plateau& plateau, Parameters& g) {
    if (plateau.count < kMinPlateau || plateau.variance > kPlateauVariance * square(noise_) ||
        plateau.variance < square(noise_) / kPlateauVariance)
        return false;
    if (plateau.mean < 2 * noise_ || plateau.mean > double(kClippedPlateau))
        return false;  // the scale's ends
    Parameters unit{};
    unit[level] = 1;
    double variance = 1.0 / plateau.count;  // in units of the noise: of the plateau, and of the fit's level
    for (const double x : factor_->halfway(unit)) variance += square(x);
    const double off = plateau.mean - p_[level], n = plateau.count;
    if (square(off) > square(kMaxPlateauError * noise_) * variance) return false;
    system_.H[level][level] += n;
    g[level] = n * off;
    return true;
}

/// Conditions the estimate on the levels far from the edges. They are most of the pixels of a large roundel,
/// and its size depends on the level half way between them.
void PhotometricFitter::use_plateaus() {
    const double major = p_[kAxx] + p_[kAyy] + std::hypot(p_[kAxx] - p_[kAyy], 2 * p_[kAxy]);
    if (occlusion_.any() || clipped_ || has_fields_ || major < kMinPlateauMajor) return;
    const Plateaus plateaus =
        read_plateaus(image_, p_, pixels_.origin_x, pixels_.origin_y, kSeparateBlurs * p_[kBlur]);
    Parameters g{};
    const bool ring = condition_on_plateau(kDark, plateaus.ring, g);
    if (!condition_on_plateau(kBright, plateaus.hole, g) && !ring) return;
    factor_.emplace(system_.H);
    apply(factor_->solve(g));
}

}  // namespace roundel
