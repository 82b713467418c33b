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

/// Abramowitz and Stegun 7.1.25, which is within 2.5e-5 of erf: the tail is within 1.3e-5.
ROUNDEL_INLINE Normal normal_tail(const Lanes& t) {
    const Lanes density = exp_negative(-0.5f * t * t);
    const Lanes u = 1.0f / (1.0f + 0.33267f * magnitude(t));  // 0.47047 / sqrt(2)
    const Lanes tail = density * u * (0.1740121f + u * (-0.0479399f + u * 0.3739278f));
    return {t > 0.0f ? tail : 1.0f - tail, density};
}

/// Sum in an order that all machines keep.
ROUNDEL_INLINE float sum(const Lanes& v) {
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

}  // namespace roundel
