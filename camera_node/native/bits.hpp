// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstdint>
#include <vector>

#include "image.hpp"
#include "threshold.hpp"

namespace roundel {

/// A picture of one bit a pixel, 1 where it is dark: 64 pixels a word, lines padded with bright ones.
class BitImage {
  public:
    int lines = 0, length = 0;  // of a line, pixels
    int words = 0;              // of a line
    void reset(int line_count, int line_length);
    const uint64_t* line(int k) const { return bits_.data() + size_t(k) * size_t(words); }
    uint64_t* line(int k) { return bits_.data() + size_t(k) * size_t(words); }
    bool is_dark(int k, int at) const { return line(k)[at >> 6] >> (at & 63) & 1; }
    /// The end of the run of line `k` that holds pixel `at`: the first pixel after it, at most `length`.
    int run_end(int k, int at) const;
    /// The first pixel of the run of line `k` that holds pixel `at`.
    int run_begin(int k, int at) const;

  private:
    std::vector<uint64_t> bits_;
};

/// Two pictures of what is below its threshold, for looking along rows and along columns: a line of `rows` is
/// the mean of two rows of the image, a line of `columns` that of two columns. So both are half as much to
/// look at, with less noise, and keep the image's resolution along their lines.
void binarise(const ImageView& image, const ThresholdMap& threshold, BitImage& rows, BitImage& columns);

/// The same picture with its columns as lines.
void transpose(const BitImage& rows, BitImage& columns);

/// The diagonals of `rows` (which binarise gives) as lines, those along which x grows with y, or falls: every
/// fourth pixel of every row, so that they lie sqrt(8) pixels apart, as their own pixels do. Pixel k of line
/// d is at x = 4 d + 2 k - 2 (rows.lines - 1), or at 4 d - 2 k.
void shear(const BitImage& rows, bool growing, BitImage& diagonals);

}  // namespace roundel
