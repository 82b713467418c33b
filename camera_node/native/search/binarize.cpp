// SPDX-License-Identifier: BSD-3-Clause
#include "search/binarize.hpp"

#include <algorithm>
#include <array>

#include "numeric/lanes.hpp"
#include "numeric/simd.hpp"
#if defined(ROUNDEL_BASELINE)
#include <immintrin.h>
#elif defined(__ARM_NEON) && !defined(ROUNDEL_SCALAR)
#include <arm_neon.h>
#endif

namespace roundel {

namespace {

constexpr int kBlock = 2 * kWord;

// Operations on sixteen pixels: the means of two rows, and of 32 pixels of a row in pairs, both rounded up;
// and the bits of the pixels below their thresholds (bit k is pixel k).
#if defined(ROUNDEL_BASELINE)
using Pixels = __m128i;
inline Pixels load(const uint8_t* from) { return _mm_loadu_si128(reinterpret_cast<const __m128i*>(from)); }
inline Pixels mean(Pixels a, Pixels b) { return _mm_avg_epu8(a, b); }
inline Pixels mean_of_pairs(const uint8_t* from) {
    const auto means = [](Pixels x) {
        return _mm_avg_epu16(_mm_and_si128(x, _mm_set1_epi16(255)), _mm_srli_epi16(x, 8));
    };
    return _mm_packus_epi16(means(load(from)), means(load(from + 16)));
}
inline uint32_t below(Pixels x, Pixels theta) {
    const __m128i bright = _mm_cmpeq_epi8(_mm_subs_epu8(theta, x), _mm_setzero_si128());
    return uint32_t(_mm_movemask_epi8(bright)) ^ 0xffff;
}
#elif defined(__ARM_NEON) && !defined(ROUNDEL_SCALAR)
using Pixels = uint8x16_t;
inline Pixels load(const uint8_t* from) { return vld1q_u8(from); }
inline Pixels mean(Pixels a, Pixels b) { return vrhaddq_u8(a, b); }
inline Pixels mean_of_pairs(const uint8_t* from) {
    const uint8x16x2_t pairs = vld2q_u8(from);
    return vrhaddq_u8(pairs.val[0], pairs.val[1]);
}
inline uint32_t below(Pixels x, Pixels theta) {
    constexpr uint8_t kBits[16] = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
    const uint8x16_t dark = vandq_u8(vcltq_u8(x, theta), vld1q_u8(kBits));
    return uint32_t(vaddv_u8(vget_low_u8(dark))) | uint32_t(vaddv_u8(vget_high_u8(dark))) << 8;
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
inline uint32_t below(const Pixels& x, const Pixels& theta) {
    uint32_t dark = 0;
    for (size_t k = 0; k < x.size(); ++k) dark |= uint32_t(x[k] < theta[k]) << k;
    return dark;
}
#endif

/// Copies every second one of n values.
ROUNDEL_CLONES void halve(const uint8_t* from, int n, uint8_t* to) {
    for (int x = 0; x < n / 2; ++x) to[x] = from[2 * x];
}

/// The thresholds of a row's pixels and of its pairs of pixels. The side of a tile is even.
struct RowThreshold {
    std::vector<uint8_t> of_pixels, of_pairs;
    explicit RowThreshold(int length) : of_pixels(size_t(length)), of_pairs(of_pixels.size() / 2) {}
    void read(const ThresholdMap& threshold, int y, int width) {
        threshold.expand(y, width, of_pixels.data());
        halve(of_pixels.data(), int(of_pixels.size()), of_pairs.data());
    }
};

/// The bits of 128 pixels of two rows: of their means, and of each row's pairs of pixels.
struct BlockBits {
    uint64_t mean[2], upper, lower;
};

/// The destination: the words of a line of means, and every 64th word from that of the upper row's pairs on.
struct RowBits {
    uint64_t *mean, *pairs;
    ROUNDEL_INLINE void put(int n, const BlockBits& bits) {
        mean[2 * n] = bits.mean[0];
        mean[2 * n + 1] = bits.mean[1];
        pairs[kWord * n] = bits.upper;
        pairs[kWord * n + 1] = bits.lower;
    }
};

inline BlockBits binarize_block(const uint8_t* a, const uint8_t* b, const uint8_t* theta,
                                const uint8_t* theta_of_pairs) {
    BlockBits bits{};
    for (int x = 0; x < 2 * kWord; x += 16)
        bits.mean[x / kWord] |= uint64_t(below(mean(load(a + x), load(b + x)), load(theta + x))) << x % kWord;
    for (int x = 0; x < kWord; x += 16) {
        const Pixels limit = load(theta_of_pairs + x);
        bits.upper |= uint64_t(below(mean_of_pairs(a + 2 * x), limit)) << x;
        bits.lower |= uint64_t(below(mean_of_pairs(b + 2 * x), limit)) << x;
    }
    return bits;
}

#if defined(ROUNDEL_AVX2)
ROUNDEL_AVX2 inline __m256i load_32(const uint8_t* from) {
    return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from));
}

/// Bit k is set if x[k] < theta[k].
ROUNDEL_AVX2 inline uint64_t below_32(__m256i x, __m256i theta) {
    return ~uint32_t(_mm256_movemask_epi8(_mm256_cmpeq_epi8(_mm256_max_epu8(x, theta), x)));
}

ROUNDEL_AVX2 inline __m256i mean_of_32_pairs(const uint8_t* from) {
    const auto means = [](__m256i x) ROUNDEL_AVX2 {
        return _mm256_avg_epu16(_mm256_maddubs_epi16(x, _mm256_set1_epi8(1)), _mm256_setzero_si256());
    };
    const __m256i mixed = _mm256_packus_epi16(means(load_32(from)), means(load_32(from + 32)));
    return _mm256_permute4x64_epi64(mixed, 0xd8);
}

ROUNDEL_AVX2 inline BlockBits binarize_block_by_32(const uint8_t* a, const uint8_t* b, const uint8_t* theta,
                                                   const uint8_t* theta_of_pairs) {
    BlockBits bits{};
    for (int x = 0; x < 2 * kWord; x += 32)
        bits.mean[x / kWord] |= below_32(_mm256_avg_epu8(load_32(a + x), load_32(b + x)), load_32(theta + x))
                                << x % kWord;
    for (int x = 0; x < kWord; x += 32) {
        const __m256i limit = load_32(theta_of_pairs + x);
        bits.upper |= below_32(mean_of_32_pairs(a + 2 * x), limit) << x;
        bits.lower |= below_32(mean_of_32_pairs(b + 2 * x), limit) << x;
    }
    return bits;
}

#if defined(__clang__)  // clang 14 calls the variant of a dispatched function unused
#pragma clang diagnostic ignored "-Wunused-function"
#endif
ROUNDEL_AVX2 void binarize_rows(const uint8_t* a, const uint8_t* b, const RowThreshold& theta, int first,
                                int blocks, RowBits to) {
    for (int n = 0; n < blocks; ++n, a += kBlock, b += kBlock) {
        const size_t at = size_t(first + n) * kBlock;
        to.put(n, binarize_block_by_32(a, b, &theta.of_pixels[at], &theta.of_pairs[at / 2]));
    }
}
#endif

#if defined(ROUNDEL_BASELINE)
ROUNDEL_BASELINE
#endif
/// Binarizes blocks of two rows with the thresholds from block `first` on.
void binarize_rows(const uint8_t* a, const uint8_t* b, const RowThreshold& theta, int first, int blocks,
                   RowBits to) {
    for (int n = 0; n < blocks; ++n, a += kBlock, b += kBlock) {
        const size_t at = size_t(first + n) * kBlock;
        to.put(n, binarize_block(a, b, &theta.of_pixels[at], &theta.of_pairs[at / 2]));
    }
}

/// The rest of a row after whole blocks. Pixels beyond the image's edge are bright.
struct Tail {
    std::array<uint8_t, kBlock> levels;
    Tail(const uint8_t* row, int begin, int end) {
        levels.fill(255);
        std::copy(row + begin, row + end, levels.begin());
        if (end % 2) levels[size_t(end - begin)] = row[end - 1];  // an odd row's last pixel is its own pair
    }
};

}  // namespace

void binarize(const ImageView& image, const ThresholdMap& threshold, BitImage& rows, BitImage& columns) {
    const int w = image.width, h = image.height, whole = w / kBlock, blocks = (w + kBlock - 1) / kBlock;
    rows.reset((h + 1) / 2, w);
    columns.reset((w + 1) / 2, h);
    RowThreshold theta(blocks * kBlock);
    std::vector<uint64_t> pairs(size_t(blocks) * kWord), mean(size_t(blocks) * 2);
    for (int y = 0; y < h; y += 2) {
        if (threshold.changes(y)) theta.read(threshold, y, w);
        const uint8_t *row = image.row(y), *next = image.row(std::min(y + 1, h - 1));
        const int k = y % kWord;
        binarize_rows(row, next, theta, 0, whole, {mean.data(), &pairs[size_t(k)]});
        if (whole < blocks) {
            const Tail a(row, whole * kBlock, w), b(next, whole * kBlock, w);
            binarize_rows(a.levels.data(), b.levels.data(), theta, whole, 1,
                          {&mean[size_t(whole) * 2], &pairs[size_t(whole * kWord + k)]});
        }
        std::copy_n(mean.data(), rows.words, rows.line(y / 2));
        if (w % kWord) rows.line(y / 2)[rows.words - 1] &= ~uint64_t(0) >> (kWord - w % kWord);
        if (k + 2 < kWord && y + 2 < h) continue;
        for (int n = 0; n < blocks; ++n) {
            uint64_t* block = &pairs[size_t(n) * kWord];
            std::fill(block + (h - y + k < kWord ? h - y + k : kWord), block + kWord, 0);
            columns.put_columns(n * kWord, y - k, block);
        }
    }
}

}  // namespace roundel
