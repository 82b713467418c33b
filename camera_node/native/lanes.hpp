// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstdint>

/// Eight floats at a time by the vector extensions of GCC and Clang. Only operations that IEEE 754 rounds
/// exactly, or integer ones, so every machine gives the same bits (see simd.hpp).
///
/// What takes or returns Lanes is inlined always: there is no call whose ABI could differ.
#pragma GCC diagnostic ignored "-Wpsabi"
#define ROUNDEL_INLINE inline __attribute__((always_inline))

namespace roundel {

constexpr int kLanes = 8;
typedef float Lanes __attribute__((vector_size(4 * kLanes)));
typedef int32_t Bits __attribute__((vector_size(4 * kLanes)));
typedef uint32_t Words __attribute__((vector_size(4 * kLanes)));  // of which sums may wrap around

ROUNDEL_INLINE Lanes all(float value) { return Lanes{} + value; }
ROUNDEL_INLINE Lanes load(const float* from) {
    Lanes v;
    __builtin_memcpy(&v, from, sizeof v);
    return v;
}
ROUNDEL_INLINE void store(float* to, const Lanes& v) { __builtin_memcpy(to, &v, sizeof v); }
ROUNDEL_INLINE Lanes magnitude(const Lanes& x) { return Lanes(Bits(x) & 0x7fffffff); }

/// 1 / sqrt(x) of x > 0 to 5e-6 of itself: a first guess by halving the exponent, and two of Newton's steps.
ROUNDEL_INLINE Lanes inverse_sqrt(const Lanes& x) {
    Lanes y = Lanes(0x5f375a86 - (Words(x) >> 1));
    const Lanes half = 0.5f * x;
    y = y * (1.5f - half * y * y);
    return y * (1.5f - half * y * y);
}

/// exp(x) of x <= 0 to 4e-6 of itself, and 0 below -20, which keeps products from the slow numbers next to 0:
/// 2^n by the exponent's bits, n the nearest whole number to x / ln 2, and what is left by Taylor's series to
/// the fifth power.
ROUNDEL_INLINE Lanes exp_negative(const Lanes& x) {
    const Lanes shifted = x * 1.44269504f + 12582912.0f;  // 1.5 x 2^23: the low bits hold n
    const Lanes z = x - (shifted - 12582912.0f) * 0.693147181f;
    const Lanes zz = z * z,
                series = (1.0f + z) + zz * ((0.5f + z * (1.0f / 6)) + zz * (1.0f / 24 + z * (1.0f / 120)));
    return x < -20.0f ? all(0) : Lanes(Words(series) + (Words(shifted) << 23));
}

/// Of the normal distribution: 1 - Phi(t), and exp(-t^2 / 2).
struct Normal {
    Lanes tail, density;
};

/// The tail over the density, Mills' ratio, by the polynomial of fifth degree that is nearest on [0, 5]: the
/// tail is within 6.3e-5. A division would take longer.
ROUNDEL_INLINE Normal normal_tail(const Lanes& t) {
    const Lanes density = exp_negative(-0.5f * t * t), far = magnitude(t), u = far < 5.0f ? far : all(5);
    const Lanes uu = u * u;
    const Lanes mills = (0.49993733f - 0.39656799f * u) +
                        uu * ((0.23543442f - 0.099663184f * u) + uu * (0.025280868f - 0.0027397065f * u));
    const Lanes tail = density * mills;
    return {t > 0.0f ? tail : 1.0f - tail, density};
}

/// Sum in an order that all machines keep.
ROUNDEL_INLINE float sum(const Lanes& v) {
    typedef float Half __attribute__((vector_size(2 * kLanes)));
    const Half h = __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
    return (h[0] + h[2]) + (h[1] + h[3]);
}

}  // namespace roundel
