// SPDX-License-Identifier: BSD-3-Clause
#include "reference/faigl2013.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <optional>
#include <stdexcept>

#include "numeric/ellipse.hpp"
#include "reference/segments.hpp"

namespace roundel {

namespace {

/// A dark segment with a bright one inside that passes the tests of Section III-B.
struct SegmentPair {
    int dark;      // number of the segment
    int bright;    // number of the segment
    Moments disc;  // of both together: the outer disc
};

Symmetric covariance(const Moments& m) {
    const double x = m.x / m.n, y = m.y / m.n;
    return {m.xx / m.n - x * x, m.xy / m.n - x * y, m.yy / m.n - y * y};
}

/// Section III-C: a disc's covariance matrix has the eigenvalues axis^2 / 16 along its axes.
Ellipse covariance_ellipse(const Moments& disc) {
    const Eigen e = eigen(covariance(disc));
    return {disc.x / disc.n, disc.y / disc.n, 4 * std::sqrt(e.first), 4 * std::sqrt(std::max(e.second, 0.0)),
            e.angle};
}

bool is_inside_image(const Segment& s, int width, int height) {
    return s.left > 0 && s.top > 0 && s.right < width - 1 && s.bottom < height - 1;
}

bool has_size(const Segment& s, const RoundelLimits& limits) {
    // The sides of an ellipse's upright box: the longer one is between 1/sqrt(2) and 1 of the major axis.
    // Blur removes up to a pixel.
    const int side = std::max(s.width(), s.height());
    return side >= limits.min_diameter / std::numbers::sqrt2 - 1 && side <= limits.max_diameter + 1;
}

bool is_inside(const Segment& inner, const Segment& outer) {
    return inner.left > outer.left && inner.right < outer.right && inner.top > outer.top &&
           inner.bottom < outer.bottom;
}

/// Section III-B, area against bounding box. The image of a slanted disc, turned by any angle, covers
/// pi/4 sqrt(1 - rho^2) of its upright box; rho is the correlation of its pixels' x and y. With upright axes
/// this is the paper's pi/4. True within 30 %.
bool fills_its_box(const Segment& outer, const Moments& disc) {
    const Symmetric c = covariance(disc);
    const double upright = c.det() / (c.xx * c.yy);  // 1 - rho^2
    const double expected = std::numbers::pi / 4 * std::sqrt(upright) * outer.width() * outer.height();
    return upright > 0 && std::abs(disc.n / expected - 1) < 0.3;
}

/// Section III-B, concentricity: the distance of the centres of the disc and of the bright segment is below a
/// tenth of the minor axis (perspective separates them by less) plus half a pixel for small segments.
bool are_concentric(const Moments& disc, const Moments& inner) {
    const double apart = std::hypot(disc.x / disc.n - inner.x / inner.n, disc.y / disc.n - inner.y / inner.n);
    return apart < 0.1 * covariance_ellipse(disc).minor + 0.5;
}

/// Section III-B, area ratio: sqrt(inner area / disc area) is the ratio of the diameters at any slant. True
/// if it agrees with a print's ratio; blur moves each edge of a small segment by up to half a pixel.
bool has_area_ratio(const Moments& disc, const Moments& inner, const RoundelLimits& limits) {
    const double ratio = std::sqrt(inner.n / disc.n);
    const double tolerance = limits.ratio_tolerance + 1 / covariance_ellipse(disc).minor;
    return limits.print_error(ratio) < tolerance ||
           limits.may_be_print(ratio, covariance_ellipse(disc).major);
}

/// All pairs of segments that pass Section III-B. Segments that touch the image's border are excluded.
std::vector<SegmentPair> find_pairs(const Segments& segments, int width, int height,
                                    const RoundelLimits& limits) {
    std::vector<SegmentPair> pairs;
    for (int k = 0; k < int(segments.list.size()); ++k) {
        const Segment& outer = segments.list[size_t(k)];
        if (!outer.dark || !is_inside_image(outer, width, height) || !has_size(outer, limits)) continue;
        const Moments& m = outer.moments;
        const int centre = segments.at(int(std::lround(m.x / m.n)), int(std::lround(m.y / m.n)));
        const Segment& inner = segments.list[size_t(centre)];
        if (inner.dark || !is_inside(inner, outer)) continue;
        Moments disc = m;
        disc += inner.moments;
        if (!fills_its_box(outer, disc) || !are_concentric(disc, inner.moments)) continue;
        if (has_area_ratio(disc, inner.moments, limits)) pairs.push_back({k, centre, disc});
    }
    return pairs;
}

/// Repeats the search for a pair in the window around it, under its own threshold theta = (m_d + m_b) / 2.
std::optional<InitialGuess> rethreshold(const ImageView& image, const Segment& outer, double theta,
                                        const RoundelLimits& limits) {
    const int margin = 2 + std::max(outer.width(), outer.height()) / 8;
    const int left = std::max(0, outer.left - margin), top = std::max(0, outer.top - margin);
    const int width = std::min(image.width, outer.right + 1 + margin) - left;
    const int height = std::min(image.height, outer.bottom + 1 + margin) - top;
    const ImageView window = image.window(left, top, width, height);
    const Segments segments = grow_segments(window, constant_threshold(uint8_t(std::lround(theta))));
    for (const SegmentPair& pair : find_pairs(segments, width, height, limits)) {
        Ellipse e = covariance_ellipse(pair.disc);
        e.x += left;
        e.y += top;
        if (e.x < outer.left || e.x > outer.right || e.y < outer.top || e.y > outer.bottom) continue;
        const double ratio = std::sqrt(segments.list[size_t(pair.bright)].moments.n / pair.disc.n);
        return InitialGuess{e, ratio, mean_level(window, segments, pair.dark),
                            mean_level(window, segments, pair.bright)};
    }
    return std::nullopt;
}

}  // namespace

double distance_by_principal_axis(double diameter, double major) {
    if (!(major > 0)) throw std::invalid_argument("the major axis must be above 0");
    return diameter / major;
}

std::vector<InitialGuess> PaperSearch::find(const ImageView& image, double min_contrast,
                                            const RoundelLimits& limits) const {
    std::vector<InitialGuess> guesses;
    const auto theta = uint8_t(std::lround(std::clamp(theta_, 1.0, 255.0)));
    const Segments segments = grow_segments(image, local_threshold(image, min_contrast, theta));
    for (const SegmentPair& pair : find_pairs(segments, image.width, image.height, limits)) {
        const double m_d = mean_level(image, segments, pair.dark);
        const double m_b = mean_level(image, segments, pair.bright);
        const Segment& outer = segments.list[size_t(pair.dark)];
        if (const auto guess = rethreshold(image, outer, (m_d + m_b) / 2, limits)) guesses.push_back(*guess);
    }
    return guesses;
}

void PaperSearch::set_levels(double dark, double bright) {
    theta_ = (dark + bright) / 2;
    steps_ = 1;
}

void PaperSearch::step() {
    steps_ = steps_ % 31 + 1;
    double share = 0, bit = 0.5;  // the binary digits of the step's number, mirrored at the point
    for (unsigned digits = steps_; digits; digits >>= 1, bit /= 2) share += (digits & 1) * bit;
    theta_ = 256 * share;
}

}  // namespace roundel
