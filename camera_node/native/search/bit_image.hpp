// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>

namespace roundel {

constexpr int kWord = 64;

/// An image of one bit per pixel, 1 if it is dark, in words of 64 pixels. Lines are padded with bright
/// pixels.
class BitImage {
  public:
    int lines = 0;
    int length = 0;  // of a line, pixels
    int words = 0;   // of a line
    /// Allocates the image; its bits are undefined.
    void reset(int line_count, int line_length);
    const uint64_t* line(int k) const { return bits_.get() + size_t(k) * size_t(words); }
    uint64_t* line(int k) { return bits_.get() + size_t(k) * size_t(words); }
    bool is_dark(int k, int at) const { return line(k)[at >> 6] >> (at & 63) & 1; }
    /// The end of the run of line `k` that contains pixel `at`: the first pixel after it, at most `length`.
    int run_end(int k, int at) const;
    /// The first pixel of the run of line `k` that contains pixel `at`.
    int run_begin(int k, int at) const;
    /// Stores the transpose of up to 64 lines of 64 pixels: bit j of block[k] becomes pixel `at` + k of line
    /// `first` + j.
    void put_columns(int first, int at, uint64_t* block);

  private:
    std::unique_ptr<uint64_t[]> bits_;
    size_t room_ = 0;  // words
};

/// Extracts every fourth pixel of an image of row means (see binarize), starting at the third pixel in every
/// second line: they are sqrt(8) pixels of the camera image apart along either diagonal. Each line is padded
/// with a word of bright pixels on either side.
void subsample(const BitImage& rows, BitImage& sparse);

/// Stores the diagonals of a subsampled image as lines: those along which x grows with y, or falls. Pixel k
/// of line d is at x = 4 d + 2 k - 4 (lines / 2) in the camera image, or at 4 d - 2 k.
void shear(const BitImage& sparse, bool growing, BitImage& diagonals);

}  // namespace roundel
