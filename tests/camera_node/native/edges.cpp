// SPDX-License-Identifier: BSD-3-Clause
/// For roundels of several sizes and slants, prints the number of parts of their pixels and the largest
/// difference between the normal equations of the parts and those of the same pixels as one part, normalized
/// by the square roots of the diagonal.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <vector>

#include "fit/edge_pixels.hpp"
#include "fit/normal_equations.hpp"

using namespace roundel;

constexpr int kSide = 256;
constexpr double kAllAgree = 1e4;  // grey levels: with this scale all weights are 1

/// `slant` is the cosine of the tilt; perspective is that of a focal length of five diameters.
Parameters seen(double diameter, double slant) {
    const double r = diameter / 2, turn = 0.7, c = std::cos(turn), s = std::sin(turn);
    Parameters p{};
    p[kBright] = 190;
    p[kDark] = 40;
    p[kGround] = 90;
    p[kBlur] = 0.8;
    p[kRatio] = 0.6;
    p[kCard] = kCardRatio;
    p[kX] = 128.3;
    p[kY] = 127.6;
    p[kAxx] = r * (slant * c * c + s * s);
    p[kAyy] = r * (slant * s * s + c * c);
    p[kAxy] = r * (slant - 1) * c * s;
    p[kGx] = c * std::sqrt(1 - slant * slant) / 10;
    p[kGy] = s * std::sqrt(1 - slant * slant) / 10;
    return p;
}

GaussNewtonSystem<kCount> products(const EdgePixels& pixels, const Parameters& p) {
    static NormalEquations equations;
    equations.linearize(pixels, p);
    return equations.accumulate({kAllAgree, 0});
}

int main() {
    const std::vector<uint8_t> grey(kSide * kSide, 128);
    static EdgePixels pixels;
    for (const double diameter : {20, 50, 100, 180})
        for (const double slant : {1.0, 0.7}) {
            const Parameters p = seen(diameter, slant);
            select_pixels({grey.data(), kSide, kSide, kSide}, p, {1.25, 2.5, true, 2.5}, EdgePixels::kMax,
                          pixels);
            const int parts = pixels.part_count;
            const auto apart = products(pixels, p);
            pixels.parts[0] = {kAnyEdge, 0, pixels.count};
            pixels.part_count = 1;
            const auto together = products(pixels, p);
            double worst = 0;
            for (int i = 0; i < kCount; ++i)
                for (int j = 0; j <= i; ++j)
                    worst = std::max(worst, std::abs(apart.H[i][j] - together.H[i][j]) /
                                                std::sqrt(together.H[i][i] * together.H[j][j]));
            std::printf("%g %g %d %g\n", diameter, slant, parts, worst);
        }
}
