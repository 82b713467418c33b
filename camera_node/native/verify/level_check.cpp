// SPDX-License-Identifier: BSD-3-Clause
#include "verify/level_check.hpp"

#include <algorithm>
#include <cmath>

#include "numeric/ray.hpp"

namespace roundel {

LevelSamples check_levels(const ImageView& image, const RoundelFit& fit) {
    const Ellipse& e = fit.outer;
    const double edge = 2 * fit.blur;  // levels further away are constant
    const double ring = (1 - fit.ratio) * e.minor / 2, hole = fit.ratio * e.minor / 2;
    const EllipseLevels on(e);
    const bool uneven = fit.fields.has_light();
    LevelSamples samples;
    const auto test = [&](double scale, bool dark) {
        const auto levels = on.at(image, scale);
        for (size_t k = 0; k < kRays; ++k) {
            if (levels[k] < 0) continue;
            double level = double(levels[k]);
            if (uneven) {
                const auto [x, y] = on.point(k, scale);
                level = fit.fields.even_level(double(x), double(y), level);
            }
            ++samples.total;
            samples.wrong += std::abs(fit.share(level) - (dark ? 0 : 1)) > kWrongLevel;
        }
    };
    for (const double share : {0.25, 0.5, 0.75})
        if (std::min(share, 1 - share) * ring > edge) test(fit.ratio + share * (1 - fit.ratio), true);
    for (const double share : {0.2, 0.5, 0.8})
        if ((1 - share) * hole > edge) test(share * fit.ratio, false);
    return samples;
}

/// Spread of a further ring's distance, in radii of the first one, from direction to direction.
constexpr float kMaxSpread = 1.3f;
// Least contrast of a further ring: blur makes thin rings, and paper between them, grey.
constexpr double kRingDepths[] = {0.3, 0.5};

/// Whether rings that are darker than paper by `depth` of the contrast surround this one.
static bool has_rings_around(const ImageView& image, const RoundelFit& fit, double depth) {
    const float theta = float(fit.dark + (1 - depth) * (std::min(fit.bright, 255.0) - fit.dark));
    const int below = int(std::ceil(theta));
    const Ellipse& e = fit.outer;
    const double c = std::cos(e.angle), s = std::sin(e.angle);
    float least = 1e9f, most = 0;
    for (int k = 0; k < kRays; k += 2) {
        Ray ray(image, float(e.x), float(e.y), kDirections[size_t(k)]);
        const auto limit = float(4 * e.major);
        int pixel = 0;
        for (int ring = 0; ring < 3; ++ring)
            if (ray.walk<true>(below, limit) < 0 || (pixel = ray.walk<false>(below, limit)) < 0) return false;
        const float edge = ray.between(pixel, theta);
        const double u = double(kDirections[size_t(k)].x), v = double(kDirections[size_t(k)].y);
        const double along = u * c + v * s, across = v * c - u * s;
        const float share = edge * float(std::hypot(2 * along / e.major, 2 * across / e.minor));
        least = std::min(least, share);
        most = std::max(most, share);
        if (most >= kMaxSpread * least) return false;
    }
    return true;
}

bool is_bullseye(const ImageView& image, const RoundelFit& fit, bool known) {
    return has_rings_around(image, fit, kRingDepths[0]) ||
           (!known && has_rings_around(image, fit, kRingDepths[1]));
}

}  // namespace roundel
