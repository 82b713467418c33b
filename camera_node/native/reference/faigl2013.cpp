// SPDX-License-Identifier: BSD-3-Clause
#include "reference/faigl2013.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <optional>
#include <stdexcept>

namespace roundel {

namespace {

Symmetric covariance(const Moments& m) {
    const double x = m.x / m.n, y = m.y / m.n;
    return {m.xx / m.n - x * x, m.xy / m.n - x * y, m.yy / m.n - y * y};
}

bool is_whole(const Segment& s, int width, int height) {
    return s.left > 0 && s.top > 0 && s.right < width - 1 && s.bottom < height - 1;
}

bool has_size(const Segment& s, const Settings& settings) {
    // The upright box of an ellipse is between 1/sqrt(2) and 1 of its major axis; blur takes up to a pixel.
    const int side = std::max(s.width(), s.height());
    return side >= settings.min_diameter / std::numbers::sqrt2 - 1 && side <= settings.max_diameter + 1;
}

bool is_inside(const Segment& inner, const Segment& outer) {
    return inner.left > outer.left && inner.right < outer.right && inner.top > outer.top &&
           inner.bottom < outer.bottom;
}

}  // namespace

bool fills_its_box(const Segment& outer, const Moments& disc) {
    const Symmetric c = covariance(disc);
    const double upright = c.det() / (c.xx * c.yy);  // 1 - rho^2
    const double expected = std::numbers::pi / 4 * std::sqrt(upright) * outer.width() * outer.height();
    return upright > 0 && std::abs(disc.n / expected - 1) < 0.3;
}

bool are_concentric(const Moments& disc, const Moments& inner) {
    const double apart = std::hypot(disc.x / disc.n - inner.x / inner.n, disc.y / disc.n - inner.y / inner.n);
    return apart < 0.1 * covariance_ellipse(disc).minor + 0.5;
}

bool has_area_ratio(const Moments& disc, const Moments& inner, const Settings& settings) {
    const double ratio = std::sqrt(inner.n / disc.n);
    const double tolerance = settings.ratio_tolerance + 1 / covariance_ellipse(disc).minor;
    return settings.ratio_error(ratio) < tolerance;
}

Ellipse covariance_ellipse(const Moments& disc) {
    const Eigen e = eigen(covariance(disc));
    return {disc.x / disc.n, disc.y / disc.n, 4 * std::sqrt(e.first), 4 * std::sqrt(std::max(e.second, 0.0)),
            e.angle};
}

double distance_by_principal_axis(double diameter, double major) {
    if (!(major > 0)) throw std::invalid_argument("the major axis must be above 0");
    return diameter / major;
}

std::vector<Pair> find_pairs(const Segments& segments, int width, int height, const Settings& settings) {
    std::vector<Pair> pairs;
    for (int k = 0; k < int(segments.list.size()); ++k) {
        const Segment& outer = segments.list[size_t(k)];
        if (!outer.dark || !is_whole(outer, width, height) || !has_size(outer, settings)) continue;
        const Moments& m = outer.moments;
        const int centre = segments.at(int(std::lround(m.x / m.n)), int(std::lround(m.y / m.n)));
        const Segment& inner = segments.list[size_t(centre)];
        if (inner.dark || !is_inside(inner, outer)) continue;
        Moments disc = m;
        disc += inner.moments;
        if (!fills_its_box(outer, disc) || !are_concentric(disc, inner.moments)) continue;
        if (has_area_ratio(disc, inner.moments, settings)) pairs.push_back({k, centre, disc});
    }
    return pairs;
}

namespace {

/// A pair under its own threshold theta = (m_d + m_b) / 2, grown anew in the window around it.
std::optional<Start> rethreshold(const ImageView& image, const Segment& outer, double theta,
                                 const Settings& settings) {
    const int margin = 2 + std::max(outer.width(), outer.height()) / 8;
    const int left = std::max(0, outer.left - margin), top = std::max(0, outer.top - margin);
    const int width = std::min(image.width, outer.right + 1 + margin) - left;
    const int height = std::min(image.height, outer.bottom + 1 + margin) - top;
    const ImageView window = image.window(left, top, width, height);
    const Segments segments = grow_segments(window, constant_threshold(uint8_t(std::lround(theta))));
    for (const Pair& pair : find_pairs(segments, width, height, settings)) {
        Ellipse e = covariance_ellipse(pair.disc);
        e.x += left, e.y += top;
        if (e.x < outer.left || e.x > outer.right || e.y < outer.top || e.y > outer.bottom) continue;
        const double ratio = std::sqrt(segments.list[size_t(pair.bright)].moments.n / pair.disc.n);
        return Start{e, ratio, mean_level(window, segments, pair.dark),
                     mean_level(window, segments, pair.bright)};
    }
    return std::nullopt;
}

}  // namespace

std::vector<Start> find_by_segments(const ImageView& image, const ThresholdMap& threshold,
                                    const Settings& settings) {
    std::vector<Start> starts;
    const Segments segments = grow_segments(image, threshold);
    for (const Pair& pair : find_pairs(segments, image.width, image.height, settings)) {
        const double m_d = mean_level(image, segments, pair.dark);
        const double m_b = mean_level(image, segments, pair.bright);
        const Segment& outer = segments.list[size_t(pair.dark)];
        if (const auto start = rethreshold(image, outer, (m_d + m_b) / 2, settings)) starts.push_back(*start);
    }
    return starts;
}

}  // namespace roundel
