// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <mutex>
#include <vector>

#include "image.hpp"
#include "paper.hpp"
#include "refine.hpp"
#include "threshold.hpp"

namespace roundel {

/// Roundels of grey images, frame after frame: the paper's segments under a local threshold, then each one
/// fitted to its grey levels. Calls from several threads wait for each other.
class Detector {
  public:
    explicit Detector(Settings settings) : settings_(std::move(settings)) {}
    std::vector<Fit> detect(const ImageView& image);
    /// The paper's theta, in force for the next frame.
    double theta() const { return theta_.value(); }
    /// Share of the last frame's pixels at the upper end of the scale.
    double saturated() const { return saturated_; }

  private:
    void update_theta(const std::vector<Fit>& found);

    Settings settings_;
    Theta theta_;
    double saturated_ = 0;
    std::mutex mutex_;
};

}  // namespace roundel
