// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "fit/occlusion.hpp"
#include "numeric/ray.hpp"
#include "fit/photometric_fit.hpp"

namespace roundel {

/// A fitted roundel's surroundings by sector and radius, in levels over ink (0) and paper (1).
class SectorView {
  public:
    SectorView(const ImageView& image, const Fit& fit) : image_(image), fit_(fit) {}
    /// The sectors whose middle at `radius`, in outer radii, is in the image and passes the test.
    template <typename Test>
    Sectors find(double radius, const Test& test) const {
        Sectors found = 0;
        for (int s = 0; s < kSectors; ++s) {
            const auto [x, y] = point_in_sector(fit_.p, s, radius);
            const float level = sample(image_, x, y);
            found |= Sectors(level >= 0 && test(over_ink(level))) << s;
        }
        return found;
    }
    /// The same at a point in outer radii; far above paper outside the image.
    double at(double x, double y) const {
        const Parameters& p = fit_.p;
        const float level = sample(image_, float(p[kX] + p[kAxx] * x + p[kAxy] * y),
                                   float(p[kY] + p[kAxy] * x + p[kAyy] * y));
        return level < 0 ? 1e9 : over_ink(level);
    }

  private:
    double over_ink(float level) const { return (double(level) - fit_.dark) / (fit_.bright - fit_.dark); }
    const ImageView& image_;
    const Fit& fit_;
};

}  // namespace roundel
