// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <cmath>

#include "fit/roundel_model.hpp"

namespace roundel {

/// The unknowns of a roundel that moves while it is exposed: those of its picture in mid-exposure, and before
/// them its motion during the exposure, pixels. The motion's sign is not to be told.
enum MovingParameter { kMotionX, kMotionY };
constexpr int kStill = 2;  // where the still picture's begin
constexpr int kMovingCount = kStill + kCount;
using MovingParameters = Vector<kMovingCount>;

/// The picture in mid-exposure.
inline Parameters still(const MovingParameters& p) {
    Parameters at{};
    std::copy(p.begin() + kStill, p.end(), at.begin());
    return at;
}

/// Grey levels of a chunk of pixels, averaged over the exposure, and their gradient.
struct MovingGradient {
    Lanes by[kMovingCount][kChunk], level[kChunk];
};

/// The mean of the still model over a straight and even motion, by the midpoint rule. Moments of so many
/// equal steps give the second moment of the motion exactly when they reach a little further than it.
class MovingModel {
  public:
    /// `spacing`: of the instants, pixels of motion; above 1.5 blurs, steps are seen.
    MovingModel(const MovingParameters& p, double spacing)
        : model_(still(p)), motion_x_(float(p[kMotionX])), motion_y_(float(p[kMotionY])) {
        const double length = std::hypot(p[kMotionX], p[kMotionY]);
        instants_ = std::max(2, int(std::ceil(length / spacing)));
        per_instants_ = 1 / float(instants_);
        reach_ = 1 / std::sqrt(1 - per_instants_ * per_instants_);
    }

    /// `x` and `y` are `count` lanes of pixels in the frame of the parameters.
    ROUNDEL_INLINE void evaluate(const float* x, const float* y, int count, MovingGradient& to) const {
        alignas(4 * kLanes) float u[kChunk * kLanes], v[kChunk * kLanes];
        Gradient now;
        clear(count, to);
        for (int n = 0; n < instants_; ++n) {
            const float t = reach_ * ((float(n) + 0.5f) * per_instants_ - 0.5f);
            for (int k = 0; k < count * kLanes; ++k) u[k] = x[k] - t * motion_x_, v[k] = y[k] - t * motion_y_;
            model_.evaluate(u, v, kNothing.data(), count, now);
            add(now, t, count, to);
        }
    }

  private:
    /// The still model compares with what is seen, which is the mean over the exposure: it gets a level that
    /// is within the scale, to be compared with here.
    static constexpr float kLevel = 128;
    static constexpr std::array<float, kChunk * kLanes> kNothing = [] {
        std::array<float, kChunk * kLanes> levels{};
        for (float& level : levels) level = kLevel;
        return levels;
    }();

    ROUNDEL_INLINE static void clear(int count, MovingGradient& to) {
        for (int k = 0; k < count; ++k) to.level[k] = all(kLevel);
        for (auto& column : to.by)
            for (int k = 0; k < count; ++k) column[k] = all(0);
    }

    /// At time t, in exposures from the middle, the motion has moved the centre by t times itself.
    ROUNDEL_INLINE void add(const Gradient& now, float t, int count, MovingGradient& to) const {
        const float w = per_instants_, wt = w * t;
        for (int k = 0; k < count; ++k) to.level[k] -= w * now.residual[k];
        for (int i = 0; i < kCount; ++i)
            for (int k = 0; k < count; ++k) to.by[kStill + i][k] += w * now.by[i][k];
        for (int k = 0; k < count; ++k) {
            to.by[kMotionX][k] += wt * now.by[kX][k];
            to.by[kMotionY][k] += wt * now.by[kY][k];
        }
    }

    Model model_;
    float motion_x_, motion_y_, per_instants_, reach_;
    int instants_;
};

}  // namespace roundel
