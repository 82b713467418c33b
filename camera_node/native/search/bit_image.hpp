// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>

namespace roundel {

constexpr int kWord = 64;

/// A picture of one bit a pixel, 1 where it is dark: 64 pixels a word, lines padded with bright ones.
class BitImage {
  public:
    int lines = 0, length = 0;  // of a line, pixels
    int words = 0;              // of a line
    /// Makes room; its bits are not set.
    void reset(int line_count, int line_length);
    const uint64_t* line(int k) const { return bits_.get() + size_t(k) * size_t(words); }
    uint64_t* line(int k) { return bits_.get() + size_t(k) * size_t(words); }
    bool is_dark(int k, int at) const { return line(k)[at >> 6] >> (at & 63) & 1; }
    /// The end of the run of line `k` that holds pixel `at`: the first pixel after it, at most `length`.
    int run_end(int k, int at) const;
    /// The first pixel of the run of line `k` that holds pixel `at`.
    int run_begin(int k, int at) const;
    /// Puts 64 columns (or what there is) of 64 other lines here: bit j of block[k] becomes pixel `at` + k of
    /// line `first` + j.
    void put_columns(int first, int at, uint64_t* block);

  private:
    std::unique_ptr<uint64_t[]> bits_;
    size_t room_ = 0;  // words
};

/// Every fourth pixel of a picture that shows the means of two rows of an image, from the third one on in
/// every second line: so they lie sqrt(8) pixels of the image apart along either diagonal. A word of bright
/// ones stands before each line and one behind.
void thin_out(const BitImage& rows, BitImage& thin);

/// The diagonals of what thin_out gives as lines: those along which x grows with y, or falls. Pixel k of line
/// d is at x = 4 d + 2 k - 4 (lines / 2) in the image, or at 4 d - 2 k.
void shear(const BitImage& thin, bool growing, BitImage& diagonals);

}  // namespace roundel
