// SPDX-License-Identifier: BSD-3-Clause
/// Detects roundels in frames from standard input, each its width and height and then its pixels, and prints
/// what the binding's table has, to the last bit.
#include <cstdio>
#include <vector>

#include "detector.hpp"

int main() {
    roundel::Detector detector({});
    for (int width, height; std::scanf("%d %d", &width, &height) == 2;) {
        std::vector<uint8_t> pixels(size_t(width) * size_t(height));
        std::getchar();
        if (std::fread(pixels.data(), 1, pixels.size(), stdin) != pixels.size()) return 1;
        for (const auto& [f, track] : detector.detect({pixels.data(), width, height, width})) {
            const roundel::Symmetric centre = f.centre_covariance(), offset = f.offset_covariance();
            for (const double value : {f.outer.x, f.outer.y, centre.xx, centre.xy, centre.yy, f.outer.major,
                                       f.outer.minor, f.outer.angle, f.ratio, f.bright - f.dark, f.offset_x,
                                       f.offset_y, offset.xx, offset.xy, offset.yy, double(track)})
                std::printf("%a ", value);
            std::puts("");
        }
    }
}
