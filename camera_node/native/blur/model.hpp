// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <cmath>

#include "fit/roundel_model.hpp"

namespace roundel {

/// The parameters of a roundel that moves during the exposure: its motion during the exposure in pixels, of
/// which the sign cannot be observed, then the parameters of its picture at mid-exposure.
enum MovingParameter { kMotionX, kMotionY };
constexpr int kStill = 2;  // index of the first parameter of the still picture
constexpr int kMovingCount = kStill + kCount;
using MovingParameters = Vector<kMovingCount>;

/// The parameters of the picture at mid-exposure.
inline Parameters still(const MovingParameters& p) {
    Parameters at{};
    std::copy(p.begin() + kStill, p.end(), at.begin());
    return at;
}

/// Grey levels of a chunk of pixels, averaged over the exposure, and their gradient.
struct MovingGradient {
    Lanes by[kMovingCount][kChunk], level[kChunk];
};

/// The mean of the still model over a straight motion at constant speed, by the midpoint rule. The time steps
/// reach slightly further than the motion, so that their second moment is exactly that of the motion.
class MovingModel {
  public:
    /// `spacing`: pixels of motion per time step; steps show in the model if it is above 1.5 blurs.
    MovingModel(const MovingParameters& p, double spacing)
        : model_(still(p)), motion_x_(float(p[kMotionX])), motion_y_(float(p[kMotionY])) {
        const double length = std::hypot(p[kMotionX], p[kMotionY]);
        steps_ = std::max(2, int(std::ceil(length / spacing)));
        per_steps_ = 1 / float(steps_);
        reach_ = 1 / std::sqrt(1 - per_steps_ * per_steps_);
    }

    /// `x` and `y` are `count` lanes of pixels in the frame of the parameters.
    ROUNDEL_INLINE void evaluate(const float* x, const float* y, int count, MovingGradient& to) const {
        alignas(4 * kLanes) float u[kChunk * kLanes], v[kChunk * kLanes];
        Gradient now;
        clear(count, to);
        for (int n = 0; n < steps_; ++n) {
            const float t = reach_ * ((float(n) + 0.5f) * per_steps_ - 0.5f);
            for (int k = 0; k < count * kLanes; ++k) {
                u[k] = x[k] - t * motion_x_;
                v[k] = y[k] - t * motion_y_;
            }
            model_.evaluate(u, v, kMidLevels.data(), count, now);
            add(now, t, count, to);
        }
    }

  private:
    /// The still model computes residuals. Here they are relative to a level within the range, because the
    /// observed level is that of the mean over the exposure.
    static constexpr float kMidLevel = 128;
    static constexpr std::array<float, kChunk * kLanes> kMidLevels = [] {
        std::array<float, kChunk * kLanes> levels{};
        for (float& level : levels) level = kMidLevel;
        return levels;
    }();

    ROUNDEL_INLINE static void clear(int count, MovingGradient& to) {
        for (int k = 0; k < count; ++k) to.level[k] = all(kMidLevel);
        for (auto& column : to.by)
            for (int k = 0; k < count; ++k) column[k] = all(0);
    }

    /// At time t, in exposures from mid-exposure, the centre is displaced by t times the motion.
    ROUNDEL_INLINE void add(const Gradient& now, float t, int count, MovingGradient& to) const {
        const float w = per_steps_, wt = w * t;
        for (int k = 0; k < count; ++k) to.level[k] -= w * now.residual[k];
        for (int i = 0; i < kCount; ++i)
            for (int k = 0; k < count; ++k) to.by[kStill + i][k] += w * now.by[i][k];
        for (int k = 0; k < count; ++k) {
            to.by[kMotionX][k] += wt * now.by[kX][k];
            to.by[kMotionY][k] += wt * now.by[kY][k];
        }
    }

    Model model_;
    float motion_x_, motion_y_, per_steps_, reach_;
    int steps_;
};

}  // namespace roundel
