// SPDX-License-Identifier: BSD-3-Clause
#include "verify/smoothed_fit.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace roundel {

namespace {

constexpr double kMargin = 4;  // pixels: the band of the fit and the reach of the mean
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

/// The binomial mean of the surroundings.
struct Smoothed : Surroundings {
    Smoothed(const ImageView& image, const InitialGuess& guess)
        : Surroundings(image, guess.outer, guess.outer.major / 2 + kMargin), moved(in_view(guess)) {
        levels_ = binomial_mean(image.window(left_, top_, width_, height_));
    }
    InitialGuess moved;
};

/// A place in a picture of half the size, in the pixels of the one that it was made of.
double doubled(double place, int from) { return from + 2 * place + 0.5; }

}  // namespace

Surroundings::Surroundings(const ImageView& image, const Ellipse& outer, double reach) {
    left_ = std::max(0, int(outer.x - reach));
    top_ = std::max(0, int(outer.y - reach));
    width_ = std::max(0, std::min(image.width, int(outer.x + reach) + 1) - left_);
    height_ = std::max(0, std::min(image.height, int(outer.y + reach) + 1) - top_);
}

InitialGuess Surroundings::in_view(InitialGuess guess) const {
    guess.outer.x -= left_;
    guess.outer.y -= top_;
    return guess;
}

RoundelFit Surroundings::in_image(RoundelFit fit) const {
    for (double* x : {&fit.outer.x, &fit.p[kX], &fit.fields.frame.x}) *x += left_;
    for (double* y : {&fit.outer.y, &fit.p[kY], &fit.fields.frame.y}) *y += top_;
    return fit;
}

Halved::Halved(const ImageView& image, const InitialGuess& guess)
    : Surroundings(image, guess.outer, kCardReach * guess.outer.major), half_guess(guess) {
    width_ /= 2;
    height_ /= 2;
    for (int y = 0; y < height_; ++y) {
        const uint8_t *a = image.row(top_ + 2 * y) + left_, *b = image.row(top_ + 2 * y + 1) + left_;
        for (int x = 0; x < 2 * width_; x += 2)
            levels_.push_back(uint8_t((a[x] + a[x + 1] + b[x] + b[x + 1] + 2) / 4));
    }
    Ellipse& outer = half_guess.outer;
    outer = {(outer.x - left_ - 0.5) / 2, (outer.y - top_ - 0.5) / 2, outer.major / 2, outer.minor / 2,
             outer.angle};
    LightGradient& light = half_guess.camera.light;
    light = {2 * light.x, 2 * light.y, 2 * light.sigma};
}

RoundelFit Halved::in_image(RoundelFit fit) const {
    for (double* length :
         {&fit.outer.major, &fit.outer.minor, &fit.offset_x, &fit.offset_y, &fit.blur, &fit.p[kAxx],
          &fit.p[kAxy], &fit.p[kAyy], &fit.p[kBlur], &fit.fields.frame.major, &fit.fields.frame.minor})
        *length *= 2;
    for (double* x : {&fit.outer.x, &fit.p[kX], &fit.fields.frame.x}) *x = doubled(*x, left_);
    for (double* y : {&fit.outer.y, &fit.p[kY], &fit.fields.frame.y}) *y = doubled(*y, top_);
    fit.pose_cov = scaled(fit.pose_cov, 4);
    fit.shading = {fit.shading.x / 2, fit.shading.y / 2, fit.shading.variance / 4};
    return fit;
}

std::optional<RoundelFit> fit_smoothed(const ImageView& image, const InitialGuess& guess) {
    const Smoothed smooth(image, guess);
    if (smooth.view().width < 3 || smooth.view().height < 3) return std::nullopt;
    std::optional<RoundelFit> fit = fit_photometric(smooth.view(), smooth.moved);
    if (!fit) return fit;
    *fit = smooth.in_image(*fit);
    fit->pose_cov = scaled(fit->pose_cov, kInflation);
    return fit;
}

}  // namespace roundel
