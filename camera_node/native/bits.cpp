// SPDX-License-Identifier: BSD-3-Clause
#include "bits.hpp"

#include <algorithm>
#include <bit>
#include <cstring>

#include "simd.hpp"
#if defined(__SSE2__) && !defined(ROUNDEL_SCALAR)
#include <emmintrin.h>
#elif defined(__ARM_NEON) && !defined(ROUNDEL_SCALAR)
#include <arm_neon.h>
#endif

namespace roundel {

namespace {

constexpr int kWord = 64;

/// Bit k is set where pixel k of 16 is below its threshold.
#if defined(__SSE2__) && !defined(ROUNDEL_SCALAR)
inline uint64_t below(const uint8_t* pixels, const uint8_t* theta) {
    const __m128i x = _mm_loadu_si128(reinterpret_cast<const __m128i*>(pixels));
    const __m128i t = _mm_loadu_si128(reinterpret_cast<const __m128i*>(theta));
    const __m128i bright = _mm_cmpeq_epi8(_mm_subs_epu8(t, x), _mm_setzero_si128());
    return uint64_t(_mm_movemask_epi8(bright)) ^ 0xffff;
}
#elif defined(__ARM_NEON) && !defined(ROUNDEL_SCALAR)
inline uint64_t below(const uint8_t* pixels, const uint8_t* theta) {
    constexpr uint8_t kBits[16] = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
    const uint8x16_t dark = vandq_u8(vcltq_u8(vld1q_u8(pixels), vld1q_u8(theta)), vld1q_u8(kBits));
    return uint64_t(vaddv_u8(vget_low_u8(dark))) | uint64_t(vaddv_u8(vget_high_u8(dark))) << 8;
}
#else
inline uint64_t below(const uint8_t* pixels, const uint8_t* theta) {
    uint64_t dark = 0;
    for (int k = 0; k < 16; ++k) dark |= uint64_t(pixels[k] < theta[k]) << k;
    return dark;
}
#endif

inline uint64_t below_word(const uint8_t* pixels, const uint8_t* theta) {
    return below(pixels, theta) | below(pixels + 16, theta + 16) << 16 |
           below(pixels + 32, theta + 32) << 32 | below(pixels + 48, theta + 48) << 48;
}

/// The pixels of one line; all three have room for whole words.
ROUNDEL_CLONES void binarise_line(const uint8_t* levels, const uint8_t* theta, int words, uint64_t* to) {
    for (int k = 0; k < words; ++k) to[k] = below_word(levels + k * kWord, theta + k * kWord);
}

ROUNDEL_CLONES void mean_of_rows(const uint8_t* a, const uint8_t* b, int n, uint8_t* to) {
    for (int x = 0; x < n; ++x) to[x] = uint8_t((a[x] + b[x] + 1) >> 1);
}

ROUNDEL_CLONES void mean_of_pairs(const uint8_t* row, int n, uint8_t* to) {
    for (int x = 0; x < n; ++x) to[x] = uint8_t((row[2 * x] + row[2 * x + 1] + 1) >> 1);
}

/// Transposes 64 x 64 bits in place by exchanging ever smaller quarters (Warren, Hacker's Delight, 7-3).
ROUNDEL_CLONES void transpose_block(uint64_t* a) {
    uint64_t mask = 0x00000000ffffffffu;
    for (int side = 32; side; side >>= 1, mask ^= mask << side)
        for (int top = 0; top < kWord; top += 2 * side)
            for (int k = top; k < top + side; ++k) {
                const uint64_t swap = (a[k] >> side ^ a[k + side]) & mask;
                a[k] ^= swap << side;
                a[k + side] ^= swap;
            }
}

}  // namespace

void BitImage::reset(int line_count, int line_length) {
    lines = line_count, length = line_length, words = (line_length + kWord - 1) / kWord;
    bits_.resize(size_t(lines) * size_t(words));
}

int BitImage::run_end(int k, int at) const {
    const uint64_t* w = line(k);
    const uint64_t same = is_dark(k, at) ? ~uint64_t(0) : 0;
    int n = at >> 6;
    uint64_t other = (w[n] ^ same) & ~uint64_t(0) << (at & 63);
    while (!other && ++n < words) other = w[n] ^ same;
    return other ? std::min(length, n * kWord + std::countr_zero(other)) : length;
}

int BitImage::run_begin(int k, int at) const {
    const uint64_t* w = line(k);
    const uint64_t same = is_dark(k, at) ? ~uint64_t(0) : 0;
    int n = at >> 6;
    uint64_t other = (w[n] ^ same) & ~uint64_t(0) >> (63 - (at & 63));
    while (!other && --n >= 0) other = w[n] ^ same;
    return other ? n * kWord + kWord - std::countl_zero(other) : 0;
}

void binarise(const ImageView& image, const ThresholdMap& threshold, BitImage& rows, BitImage& columns) {
    static thread_local BitImage halved;  // each row of the image, half as long
    const int w = image.width, h = image.height;
    rows.reset((h + 1) / 2, w), halved.reset(h, (w + 1) / 2);
    // Levels beyond the image's edge are bright.
    std::vector<uint8_t> whole(size_t(rows.words) * kWord, 255), half(size_t(halved.words) * kWord, 255);
    std::vector<uint8_t> theta(whole.size()), theta_half(half.size());
    for (int y = 0; y < h; ++y) {
        if (threshold.changes(y)) {
            threshold.expand(y, w, theta.data());
            mean_of_pairs(theta.data(), int(theta.size() / 2), theta_half.data());
        }
        mean_of_pairs(image.row(y), w / 2, half.data());
        if (w % 2) half[size_t(w) / 2] = image.row(y)[w - 1];
        binarise_line(half.data(), theta_half.data(), halved.words, halved.line(y));
        if (y % 2) continue;
        mean_of_rows(image.row(y), image.row(std::min(y + 1, h - 1)), w, whole.data());
        binarise_line(whole.data(), theta.data(), rows.words, rows.line(y / 2));
    }
    transpose(halved, columns);
}

void transpose(const BitImage& rows, BitImage& columns) {
    columns.reset(rows.length, rows.lines);
    for (int y = 0; y < rows.lines; y += kWord)
        for (int x = 0; x < rows.length; x += kWord) {
            uint64_t block[kWord] = {};
            for (int k = 0; k < std::min(kWord, rows.lines - y); ++k) block[k] = rows.line(y + k)[x / kWord];
            transpose_block(block);
            for (int k = 0; k < std::min(kWord, rows.length - x); ++k)
                columns.line(x + k)[y / kWord] = block[k];
        }
}

}  // namespace roundel
