// SPDX-License-Identifier: BSD-3-Clause
#include "search/bit_image.hpp"

#include <algorithm>
#include <bit>
#include <vector>

#include "numeric/lanes.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

typedef uint64_t Four __attribute__((vector_size(32)));
constexpr int kFours = kWord / 4;

/// Exchanges the bits `mask` << side of `upper` with the bits `mask` of `lower`.
template <int side>
ROUNDEL_INLINE void exchange(Four& upper, Four& lower, uint64_t mask) {
    const Four swap = (upper >> side ^ lower) & mask;
    upper ^= swap << side;
    lower ^= swap;
}

/// The same for lines `side` apart, in whole vectors.
template <int side>
ROUNDEL_INLINE void exchange_quarters(Four* lines, uint64_t mask) {
    for (int top = 0; top < kFours; top += side / 2)
        for (int k = top; k < top + side / 4; ++k) exchange<side>(lines[k], lines[k + side / 4], mask);
}

/// The same for lines within two vectors.
ROUNDEL_INLINE void exchange_within(Four& a, Four& b) {
    Four upper = __builtin_shufflevector(a, b, 0, 1, 4, 5), lower = __builtin_shufflevector(a, b, 2, 3, 6, 7);
    exchange<2>(upper, lower, 0x3333333333333333u);
    Four even = __builtin_shufflevector(upper, lower, 0, 4, 2, 6);
    Four odd = __builtin_shufflevector(upper, lower, 1, 5, 3, 7);
    exchange<1>(even, odd, 0x5555555555555555u);
    a = __builtin_shufflevector(even, odd, 0, 4, 1, 5);
    b = __builtin_shufflevector(even, odd, 2, 6, 3, 7);
}

/// Transposes 64 x 64 bits in place by exchanging ever smaller quarters (Warren, Hacker's Delight, 7-3).
ROUNDEL_CLONES void transpose(uint64_t* block) {
    Four lines[kFours];
    __builtin_memcpy(lines, block, sizeof lines);
    Four any{};
    for (const Four& four : lines) any |= four;
    if (!(any[0] | any[1] | any[2] | any[3])) return;  // many blocks have no dark pixels
    exchange_quarters<32>(lines, 0x00000000ffffffffu);
    exchange_quarters<16>(lines, 0x0000ffff0000ffffu);
    exchange_quarters<8>(lines, 0x00ff00ff00ff00ffu);
    exchange_quarters<4>(lines, 0x0f0f0f0f0f0f0f0fu);
    for (int k = 0; k < kFours; k += 2) exchange_within(lines[k], lines[k + 1]);
    __builtin_memcpy(block, lines, sizeof lines);
}

/// Extracts every fourth bit of each word, from bit `phase` on.
ROUNDEL_CLONES void take_fourths(const uint64_t* line, int words, int phase, uint16_t* to) {
    for (int n = 0; n < words; ++n) {
        uint64_t x = line[n] >> phase & 0x1111111111111111u;
        x = (x | x >> 3) & 0x0303030303030303u;
        x = (x | x >> 6) & 0x000f000f000f000fu;
        x = (x | x >> 12) & 0x000000ff000000ffu;
        to[n] = uint16_t(x | x >> 24);
    }
}

/// The 64 bits from `from` on of a line that is padded with one word on either side.
inline uint64_t bits_from(const uint64_t* line, int from) {
    const uint64_t* word = line + 1 + (from >> 6);
    const int shift = from & (kWord - 1);
    return shift ? word[0] >> shift | word[1] << (kWord - shift) : word[0];
}

}  // namespace

void BitImage::reset(int line_count, int line_length) {
    lines = line_count;
    length = line_length;
    words = (line_length + kWord - 1) / kWord;
    const size_t needed = size_t(lines) * size_t(words);
    if (needed > room_) bits_ = std::make_unique_for_overwrite<uint64_t[]>(room_ = needed);
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

void BitImage::put_columns(int first, int at, uint64_t* block) {
    transpose(block);
    uint64_t* to = line(first) + at / kWord;
    for (int j = 0; j < std::min(kWord, lines - first); ++j, to += words) *to = block[j];
}

void subsample(const BitImage& rows, BitImage& sparse) {
    const int words = (rows.words + 3) / 4;
    sparse.reset(rows.lines, (words + 2) * kWord);
    std::vector<uint16_t> quarters(size_t(words) * 4, 0);
    for (int y = 0; y < rows.lines; ++y) {
        take_fourths(rows.line(y), rows.words, y % 2 * 2, quarters.data());
        uint64_t* to = sparse.line(y);
        to[0] = to[words + 1] = 0;
        for (size_t n = 0; n < size_t(words); ++n)
            to[n + 1] = uint64_t(quarters[4 * n]) | uint64_t(quarters[4 * n + 1]) << 16 |
                        uint64_t(quarters[4 * n + 2]) << 32 | uint64_t(quarters[4 * n + 3]) << 48;
    }
}

void shear(const BitImage& sparse, bool growing, BitImage& diagonals) {
    const int half = sparse.lines / 2, length = sparse.length - 2 * kWord;
    diagonals.reset(length + half, sparse.lines);
    uint64_t block[kWord];
    for (int d = 0; d < diagonals.lines; d += kWord)
        for (int top = 0; top < sparse.lines; top += kWord) {
            for (int k = 0; k < kWord; ++k) {
                const int y = top + k, from = d + (growing ? y / 2 - half : -(y + 1) / 2);
                block[k] =
                    y < sparse.lines && from > -kWord && from < length ? bits_from(sparse.line(y), from) : 0;
            }
            diagonals.put_columns(d, top, block);
        }
}

}  // namespace roundel
