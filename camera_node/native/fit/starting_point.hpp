// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>

#include "fit/photometric_fit.hpp"

namespace roundel {

constexpr double kMinBlur = 0.29;       // pixels: a pixel's own width alone
constexpr double kShortestFocal = 400;  // pixels: no lens shows more perspective

/// Parameters to begin with, in a frame of origin x, y. A is the symmetric square root that maps the unit
/// circle to the ellipse.
inline Parameters starting_point(const Start& s, int origin_x, int origin_y, double blur) {
    const double c = std::cos(s.outer.angle), n = std::sin(s.outer.angle);
    const double a = s.outer.major / 2, b = s.outer.minor / 2;
    Parameters p{};
    p[kX] = s.outer.x - origin_x, p[kY] = s.outer.y - origin_y;
    p[kAxx] = a * c * c + b * n * n, p[kAxy] = (a - b) * c * n, p[kAyy] = a * n * n + b * c * c;
    p[kRatio] = s.ratio, p[kCard] = kCardRatio, p[kBlur] = blur;
    p[kDark] = s.dark, p[kBright] = p[kGround] = s.bright;
    return p;
}

/// What is known before a pixel is seen, as information (1 / variance): wide, only to hold what the pixels
/// don't tell. Of the ratio and the blur, their standard deviations.
inline Parameters prior_information(double major, double ratio, double blur) {
    const auto about = [](double deviation) { return 1 / (deviation * deviation); };
    Parameters w{};
    w[kRatio] = about(ratio), w[kCard] = about(0.05), w[kGround] = about(100), w[kBlur] = about(blur);
    const double perspective = kShortestFocal / (major / 2);  // g = r / f sin(tilt)
    w[kGx] = w[kGy] = perspective * perspective;
    return w;
}

}  // namespace roundel
