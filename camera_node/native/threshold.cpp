// SPDX-License-Identifier: BSD-3-Clause
#include "threshold.hpp"

namespace roundel {

Levels class_means(const ImageView& image, uint8_t theta) {
    uint64_t dark_sum = 0, sum = 0;
    size_t dark_count = 0;
    for (int y = 0; y < image.height; ++y) {
        const uint8_t* row = image.row(y);
        for (int x = 0; x < image.width; ++x) {
            const bool dark = row[x] < theta;
            sum += row[x];
            dark_sum += dark ? row[x] : 0;
            dark_count += dark;
        }
    }
    const size_t bright_count = size_t(image.width) * size_t(image.height) - dark_count;
    return {dark_count ? double(dark_sum) / double(dark_count) : double(theta),
            bright_count ? double(sum - dark_sum) / double(bright_count) : double(theta), dark_count};
}

}  // namespace roundel
