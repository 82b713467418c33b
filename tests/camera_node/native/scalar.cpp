// SPDX-License-Identifier: BSD-3-Clause
/// Detects roundels in frames from standard input, each its width and height and then its pixels, and prints
/// what the binding's table has, to the last bit.
#include <cstdio>
#include <vector>

#include "detector.hpp"
#include "table.hpp"

int main() {
    roundel::Detector detector({});
    for (int width, height; std::scanf("%d %d", &width, &height) == 2;) {
        std::vector<uint8_t> pixels(size_t(width) * size_t(height));
        std::getchar();
        if (std::fread(pixels.data(), 1, pixels.size(), stdin) != pixels.size()) return 1;
        for (const auto& roundel : detector.detect({pixels.data(), width, height, width})) {
            for (const double value : row_of(roundel)) std::printf("%a ", value);
            std::puts("");
        }
    }
}
