// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstdint>
#include <optional>
#include <vector>

#include "fit/photometric_fit.hpp"

namespace roundel {

/// Fits the 3 x 3 binomial mean of the image around the guess. The model describes edges that are ragged at
/// the scale of a pixel (drawn, sharpened by a camera, badly printed) only after they are smoothed.
///
/// Smoothing reduces the noise and correlates adjacent pixels; the covariance is inflated by (16/6)^2.
std::optional<RoundelFit> fit_smoothed(const ImageView& image, const InitialGuess& guess);

constexpr double kCardReach = 0.8;  // outer diameters: to the edge of a card, and the band of a fit

/// The surroundings of a guess in other levels.
class Surroundings {
  public:
    ImageView view() const { return {levels_.data(), width_, height_, width_}; }
    /// A fit to `view`, as one to the image.
    RoundelFit in_image(RoundelFit fit) const;

  protected:
    InitialGuess in_view(InitialGuess guess) const;
    Surroundings(const ImageView& image, const Ellipse& outer, double reach);
    int left_, top_, width_, height_;
    std::vector<uint8_t> levels_;
};

/// The same at half the size. Paper is never flat and edges that were cut by hand are uneven in proportion to
/// the size, so a large roundel is judged as one of half the size is.
class Halved : public Surroundings {
  public:
    Halved(const ImageView& image, const InitialGuess& guess);
    /// A fit to `view`, as one to the image.
    RoundelFit in_image(RoundelFit fit) const;
    InitialGuess half_guess;  // in `view`
};

}  // namespace roundel
