// SPDX-License-Identifier: BSD-3-Clause
#include "bits.hpp"

#include <algorithm>
#include <array>
#include <bit>

#include "simd.hpp"
#if defined(__SSE2__) && !defined(ROUNDEL_SCALAR)
#include <emmintrin.h>
#elif defined(__ARM_NEON) && !defined(ROUNDEL_SCALAR)
#include <arm_neon.h>
#endif

namespace roundel {

namespace {

constexpr int kWord = 64;

// Sixteen pixels at a time: the means of two rows and those of 32 pixels of a row two by two, both rounded
// up, and which are below their thresholds (bit k is pixel k).
#if defined(__SSE2__) && !defined(ROUNDEL_SCALAR)
using Pixels = __m128i;
inline Pixels load(const uint8_t* from) { return _mm_loadu_si128(reinterpret_cast<const __m128i*>(from)); }
inline Pixels mean(Pixels a, Pixels b) { return _mm_avg_epu8(a, b); }
inline Pixels mean_of_pairs(const uint8_t* from) {
    const auto means = [](Pixels x) {
        return _mm_avg_epu16(_mm_and_si128(x, _mm_set1_epi16(255)), _mm_srli_epi16(x, 8));
    };
    return _mm_packus_epi16(means(load(from)), means(load(from + 16)));
}
inline uint64_t below(Pixels x, Pixels theta) {
    const __m128i bright = _mm_cmpeq_epi8(_mm_subs_epu8(theta, x), _mm_setzero_si128());
    return uint64_t(_mm_movemask_epi8(bright)) ^ 0xffff;
}
#elif defined(__ARM_NEON) && !defined(ROUNDEL_SCALAR)
using Pixels = uint8x16_t;
inline Pixels load(const uint8_t* from) { return vld1q_u8(from); }
inline Pixels mean(Pixels a, Pixels b) { return vrhaddq_u8(a, b); }
inline Pixels mean_of_pairs(const uint8_t* from) {
    const uint8x16x2_t pairs = vld2q_u8(from);
    return vrhaddq_u8(pairs.val[0], pairs.val[1]);
}
inline uint64_t below(Pixels x, Pixels theta) {
    constexpr uint8_t kBits[16] = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
    const uint8x16_t dark = vandq_u8(vcltq_u8(x, theta), vld1q_u8(kBits));
    return uint64_t(vaddv_u8(vget_low_u8(dark))) | uint64_t(vaddv_u8(vget_high_u8(dark))) << 8;
}
#else
using Pixels = std::array<uint8_t, 16>;
inline Pixels load(const uint8_t* from) {
    Pixels x;
    std::copy_n(from, x.size(), x.begin());
    return x;
}
inline Pixels mean(const Pixels& a, const Pixels& b) {
    Pixels x;
    for (size_t k = 0; k < x.size(); ++k) x[k] = uint8_t((a[k] + b[k] + 1) >> 1);
    return x;
}
inline Pixels mean_of_pairs(const uint8_t* from) {
    Pixels x;
    for (size_t k = 0; k < x.size(); ++k) x[k] = uint8_t((from[2 * k] + from[2 * k + 1] + 1) >> 1);
    return x;
}
inline uint64_t below(const Pixels& x, const Pixels& theta) {
    uint64_t dark = 0;
    for (size_t k = 0; k < x.size(); ++k) dark |= uint64_t(x[k] < theta[k]) << k;
    return dark;
}
#endif

/// `words` of the mean of two rows.
ROUNDEL_CLONES void binarise_rows(const uint8_t* a, const uint8_t* b, const uint8_t* theta, int words,
                                  uint64_t* to) {
    for (int k = 0; k < words; ++k) {
        uint64_t word = 0;
        for (int x = 0; x < kWord; x += 16, a += 16, b += 16, theta += 16)
            word |= below(mean(load(a), load(b)), load(theta)) << x;
        to[k] = word;
    }
}

/// `words` of the means of a row's pixels two by two.
ROUNDEL_CLONES void binarise_pairs(const uint8_t* row, const uint8_t* theta, int words, uint64_t* to) {
    for (int k = 0; k < words; ++k) {
        uint64_t word = 0;
        for (int x = 0; x < kWord; x += 16, row += 32, theta += 16)
            word |= below(mean_of_pairs(row), load(theta)) << x;
        to[k] = word;
    }
}

/// What is left of a row after whole words, as long as two of them; beyond the image's edge all is bright.
struct Tail {
    std::array<uint8_t, 2 * kWord> levels;
    Tail(const uint8_t* row, int begin, int end) {
        levels.fill(255);
        std::copy(row + begin, row + end, levels.begin());
        if (end % 2) levels[size_t(end - begin)] = row[end - 1];  // an odd row's last pixel is its own pair
    }
};

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

/// The 64 bits from `at` on, which may lie beyond either end of the line.
inline uint64_t bits_from(const uint64_t* line, int words, int at) {
    const int n = at >> 6, shift = at & 63;
    const uint64_t low = n >= 0 && n < words ? line[n] : 0;
    const uint64_t high = shift && n + 1 >= 0 && n + 1 < words ? line[n + 1] << (64 - shift) : 0;
    return low >> shift | high;
}

/// Every fourth bit.
inline uint64_t thin_out(uint64_t x) {
    x &= 0x1111111111111111u;
    x = (x | x >> 3) & 0x0303030303030303u;
    x = (x | x >> 6) & 0x000f000f000f000fu;
    x = (x | x >> 12) & 0x000000ff000000ffu;
    return (x | x >> 24) & 0xffff;
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
    const int w = image.width, h = image.height, whole = w / kWord, pairs = w / (2 * kWord);
    rows.reset((h + 1) / 2, w), halved.reset(h, (w + 1) / 2);
    std::vector<uint8_t> theta(size_t(halved.words) * 2 * kWord), theta_half(theta.size() / 2);
    for (int y = 0; y < h; ++y) {
        if (threshold.changes(y)) {
            threshold.expand(y, w, theta.data());
            for (size_t x = 0; x < theta_half.size(); ++x) theta_half[x] = theta[2 * x];  // tiles are even
        }
        const uint8_t *row = image.row(y), *next = image.row(std::min(y + 1, h - 1));
        binarise_pairs(row, theta_half.data(), pairs, halved.line(y));
        if (pairs < halved.words)
            binarise_pairs(Tail(row, pairs * 2 * kWord, w).levels.data(), &theta_half[size_t(pairs) * kWord],
                           1, halved.line(y) + pairs);
        if (y % 2) continue;
        binarise_rows(row, next, theta.data(), whole, rows.line(y / 2));
        if (whole < rows.words) {
            const Tail a(row, whole * kWord, w), b(next, whole * kWord, w);
            binarise_rows(a.levels.data(), b.levels.data(), &theta[size_t(whole) * kWord], 1,
                          rows.line(y / 2) + whole);
        }
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

void shear(const BitImage& rows, bool growing, BitImage& diagonals) {
    static thread_local BitImage sheared;
    const int most = 2 * (rows.lines - 1);
    sheared.reset(rows.lines, (rows.length + most + 3) / 4);
    for (int k = 0; k < rows.lines; ++k) {
        const int shift = growing ? most - 2 * k : 2 * k;
        uint64_t* to = sheared.line(k);
        for (int n = 0; n < sheared.words; ++n) {
            to[n] = 0;
            const int first = 4 * kWord * n - shift;
            if (first >= rows.length || first + 4 * kWord <= 0) continue;
            for (int part = 0; part < 4; ++part)
                to[n] |= thin_out(bits_from(rows.line(k), rows.words, first + kWord * part)) << 16 * part;
        }
    }
    transpose(sheared, diagonals);
}

}  // namespace roundel
