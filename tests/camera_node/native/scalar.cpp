// SPDX-License-Identifier: BSD-3-Clause
/// Detects roundels in frames from standard input (width and height, then the pixels) and prints all columns
/// of the results as exact hexadecimal numbers, one line per roundel.
#include <cstdio>
#include <vector>

#include "detector.hpp"
#include "frame_columns.hpp"

int main() {
    roundel::Detector detector({});
    for (int width, height; std::scanf("%d %d", &width, &height) == 2;) {
        std::vector<uint8_t> pixels(size_t(width) * size_t(height));
        std::getchar();
        if (std::fread(pixels.data(), 1, pixels.size(), stdin) != pixels.size()) return 1;
        const auto found = detector.detect({pixels.data(), width, height, width}).roundels;
        const roundel::FrameColumns columns(found);
        for (size_t k = 0; k < found.size(); ++k) {
            for (const auto& column : {columns.uv, columns.axes_px, columns.angle_rad, columns.ratio,
                                       columns.contrast, columns.offset_px, columns.pose_cov}) {
                const size_t n = column.size() / found.size();
                for (size_t i = 0; i < n; ++i) std::printf("%a ", column[k * n + i]);
            }
            std::printf("%a\n", double(columns.track[k]));
        }
    }
}
