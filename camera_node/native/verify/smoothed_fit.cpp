// SPDX-License-Identifier: BSD-3-Clause
#include "verify/smoothed_fit.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace roundel {

namespace {

constexpr double kMargin = 4;  // pixels: the band of the fit, the card and the reach of the mean
constexpr double kInflation = (16.0 / 6) * (16.0 / 6);  // noise variance over that of the binomial mean

/// The 3 x 3 binomial mean; the pixels on the image's border are repeated.
std::vector<uint8_t> binomial_mean(const ImageView& image) {
    std::vector<uint8_t> mean(size_t(image.width) * size_t(image.height));
    for (int y = 0; y < image.height; ++y) {
        const uint8_t* above = image.row(std::max(y - 1, 0));
        const uint8_t* here = image.row(y);
        const uint8_t* below = image.row(std::min(y + 1, image.height - 1));
        const auto column = [&](int x) { return above[x] + 2 * here[x] + below[x]; };
        for (int x = 0; x < image.width; ++x) {
            const int left = std::max(x - 1, 0), right = std::min(x + 1, image.width - 1);
            const int sum = column(left) + 2 * column(x) + column(right);
            mean[size_t(y) * size_t(image.width) + size_t(x)] = uint8_t((sum + 8) / 16);
        }
    }
    return mean;
}

}  // namespace

std::optional<RoundelFit> fit_smoothed(const ImageView& image, const InitialGuess& guess) {
    const double reach = guess.outer.major / 2 + kMargin;
    const int left = std::max(0, int(guess.outer.x - reach)), top = std::max(0, int(guess.outer.y - reach));
    const int width = std::min(image.width, int(guess.outer.x + reach) + 1) - left;
    const int height = std::min(image.height, int(guess.outer.y + reach) + 1) - top;
    if (width < 3 || height < 3) return std::nullopt;
    const std::vector<uint8_t> smooth = binomial_mean(image.window(left, top, width, height));
    InitialGuess moved = guess;
    moved.outer.x -= left;
    moved.outer.y -= top;
    std::optional<RoundelFit> fit = fit_photometric({smooth.data(), width, height, width}, moved);
    if (!fit) return fit;
    fit->outer.x += left;
    fit->outer.y += top;
    fit->pose_cov = scaled(fit->pose_cov, kInflation);
    return fit;
}

}  // namespace roundel
