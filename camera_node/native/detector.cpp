// SPDX-License-Identifier: BSD-3-Clause
#include "detector.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <optional>

#include "soften.hpp"

namespace roundel {

namespace {

constexpr size_t kMaxRoundels = 4096;  // as many as a message may hold
constexpr double kNoise = 3;           // grey levels that a picture may differ by from the model

/// A pair under its own threshold theta = (m_d + m_b) / 2, grown anew in the window around it.
std::optional<Start> rethreshold(const ImageView& image, const Segment& outer, double theta,
                                 const Settings& settings) {
    const int margin = 2 + std::max(outer.width(), outer.height()) / 8;
    const int left = std::max(0, outer.left - margin), top = std::max(0, outer.top - margin);
    const int width = std::min(image.width, outer.right + 1 + margin) - left;
    const int height = std::min(image.height, outer.bottom + 1 + margin) - top;
    const ImageView window = image.window(left, top, width, height);
    const Segments segments =
        grow_segments(window, constant_threshold(width, height, uint8_t(std::lround(theta))));
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

/// The gates that end false positives: contrast, ratio, size, and grey levels as the model says but for
/// `noise`.
bool is_roundel(const Fit& fit, const Settings& settings, double noise) {
    const double contrast = fit.bright - fit.dark;
    const bool ratio = std::any_of(settings.inner_ratios.begin(), settings.inner_ratios.end(), [&](double r) {
        return std::abs(fit.ratio - r) <= settings.ratio_tolerance;
    });
    return ratio && contrast >= settings.min_contrast && fit.residual < 0.05 * contrast + noise &&
           fit.outer.major >= settings.min_diameter && fit.outer.major <= settings.max_diameter;
}

/// The fit to the picture as it is or, where its edges are ragged (drawn, sharpened, badly printed), to the
/// softened one.
std::optional<Fit> fit_roundel(const ImageView& image, const Start& start, const Settings& settings) {
    const auto fit = refine(image, start);
    if (fit && is_roundel(*fit, settings, kNoise)) return fit;
    const auto soft = refine_softened(image, start);
    return soft && is_roundel(*soft, settings, kNoise * 6 / 16) ? soft : std::nullopt;
}

/// Whether two more dark rings lie around a roundel, which makes it a bullseye. One may be a plate that it
/// stands on, or the line that its card was cut along.
bool is_bullseye(const Fit& fit, const std::vector<Segment>& around) {
    const Ellipse& e = fit.outer;
    return std::count_if(around.begin(), around.end(), [&](const Segment& s) {
               const double x = (s.left + s.right) / 2.0, y = (s.top + s.bottom) / 2.0;
               const double side = std::max(s.width(), s.height());
               return std::hypot(x - e.x, y - e.y) < 0.15 * e.major && side > 1.2 * e.major &&
                      side < 4 * e.major;
           }) >= 2;
}

/// The dark segments large enough to be a ring around a roundel.
std::vector<Segment> large_dark(const std::vector<Segment>& segments, const Settings& settings) {
    std::vector<Segment> large;
    std::copy_if(segments.begin(), segments.end(), std::back_inserter(large), [&](const Segment& s) {
        return s.dark && std::max(s.width(), s.height()) > settings.min_diameter;
    });
    return large;
}

}  // namespace

std::vector<Fit> Detector::detect(const ImageView& image) {
    const std::lock_guard lock(mutex_);
    std::vector<Fit> found;
    if (image.width < 3 || image.height < 3) return found;
    saturated_ = saturated_share(image);
    const auto theta = uint8_t(std::lround(std::clamp(theta_.value(), 1.0, 255.0)));
    const Segments segments = grow_segments(image, local_threshold(image, settings_.min_contrast, theta));
    const std::vector<Segment> around = large_dark(segments.list, settings_);
    for (const Pair& pair : find_pairs(segments, image.width, image.height, settings_)) {
        if (found.size() == kMaxRoundels) break;
        const double own =
            (mean_level(image, segments, pair.dark) + mean_level(image, segments, pair.bright)) / 2;
        const auto start = rethreshold(image, segments.list[size_t(pair.dark)], own, settings_);
        const auto fit = start ? fit_roundel(image, *start, settings_) : std::nullopt;
        if (fit && !is_bullseye(*fit, around)) found.push_back(*fit);
    }
    update_theta(found);
    return found;
}

void Detector::update_theta(const std::vector<Fit>& found) {
    if (found.empty()) return theta_.step();
    double dark = 0, bright = 0;
    for (const Fit& fit : found) dark += fit.dark, bright += fit.bright;
    theta_.settle(dark / double(found.size()), bright / double(found.size()));
}

}  // namespace roundel
