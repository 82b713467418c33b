// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <cstdint>

/// Vectors of eight floats by the vector extensions of GCC and Clang. All operations are exactly rounded by
/// IEEE 754, or integer operations, so every machine computes the same bits (see simd.hpp).
///
/// Functions that take or return Lanes are always inlined, so that there is no call whose ABI could differ.
#pragma GCC diagnostic ignored "-Wpsabi"
#define ROUNDEL_INLINE inline __attribute__((always_inline))

namespace roundel {

constexpr int kLanes = 8;
typedef float Lanes __attribute__((vector_size(4 * kLanes)));
typedef int32_t Bits __attribute__((vector_size(4 * kLanes)));
typedef uint32_t Words __attribute__((vector_size(4 * kLanes)));  // sums may wrap around

ROUNDEL_INLINE Lanes all(float value) { return Lanes{} + value; }
ROUNDEL_INLINE Lanes load(const float* from) {
    Lanes v;
    __builtin_memcpy(&v, from, sizeof v);
    return v;
}
ROUNDEL_INLINE void store(float* to, const Lanes& v) { __builtin_memcpy(to, &v, sizeof v); }

/// Eight bytes as integers, in two steps: compilers convert bytes to words of four times their size one by
/// one.
ROUNDEL_INLINE Bits widen(uint64_t bytes) {
    typedef uint8_t Bytes __attribute__((vector_size(2 * kLanes)));
    typedef int16_t Wide __attribute__((vector_size(4 * kLanes)));
    typedef uint64_t Pair __attribute__((vector_size(2 * kLanes)));
    const Wide wide = __builtin_convertvector(Bytes(Pair{bytes, 0}), Wide);
    return __builtin_convertvector(__builtin_shufflevector(wide, wide, 0, 1, 2, 3, 4, 5, 6, 7), Bits);
}
ROUNDEL_INLINE Lanes greater(const Lanes& a, const Lanes& b) { return a > b ? a : b; }
ROUNDEL_INLINE Lanes clamped(const Lanes& value, const Lanes& low, const Lanes& high) {
    const Lanes above = greater(value, low);
    return above < high ? above : high;
}
ROUNDEL_INLINE Lanes magnitude(const Lanes& x) { return Lanes(Bits(x) & 0x7fffffff); }

/// 1 / sqrt(x) for x > 0 with a relative error of 5e-6: an initial guess by halving the exponent, and two
/// steps of Newton's method.
ROUNDEL_INLINE Lanes inverse_sqrt(const Lanes& x) {
    Lanes y = Lanes(0x5f375a86 - (Words(x) >> 1));
    const Lanes half = 0.5f * x;
    y = y * (1.5f - half * y * y);
    return y * (1.5f - half * y * y);
}

/// exp(x) for x <= 0 with a relative error of 4e-5, 0 from -87 on: the power series of 2^x about an integer.
ROUNDEL_INLINE Lanes exponential(const Lanes& x) {
    const Lanes t = (x > -87.0f ? x : all(-87.0f)) * 1.44269504f;
    const Bits n = __builtin_convertvector(t - 0.5f, Bits);
    const Lanes f = t - __builtin_convertvector(n, Lanes);
    const Lanes power =
        1.0f + f * (0.693147181f + f * (0.240226507f + f * (0.0555041087f + f * 0.00961812911f)));
    return x > -87.0f ? power * Lanes((n + 127) << 23) : all(0);
}

/// log(exp(a) + exp(b)) within 1e-4; log(1 + z) by Abramowitz and Stegun, 4.1.43.
ROUNDEL_INLINE Lanes log_sum(const Lanes& a, const Lanes& b) {
    const Lanes z = exponential(-magnitude(a - b));
    return greater(a, b) +
           z * (0.99949556f + z * (-0.49190896f + z * (0.28947478f + z * (-0.13606275f + z * 0.03215845f))));
}

/// The normal distribution: 1 - Phi(t) and exp(-t^2 / 2).
struct Normal {
    Lanes tail, density;
};

/// Approximating polynomials in t^2 on [-3.5, 3.5]. The error of the tail is 3e-5 there and 2e-4 beyond, that
/// of the density 3e-3; the density is 0 beyond. Independent terms are faster than Horner's scheme.
ROUNDEL_INLINE Normal normal_tail(const Lanes& t) {
    const Lanes z = clamped(t, all(-3.5f), all(3.5f));
    const Lanes u = z * z, uu = u * u;
    const Lanes odd = (0.398817865f - 0.0660721718f * u) + uu * (0.00956194028f - 0.00100343984f * u) +
                      uu * uu * ((7.07925185e-05f - 2.94779384e-06f * u) + uu * 5.38789068e-08f);
    const Lanes even = (0.997568669f - 0.483258972f * u) + uu * (0.106027517f - 0.0125441721f * u) +
                       uu * uu * (0.000765829199f - 1.87586468e-05f * u);
    return {0.5f - z * odd, z == t ? even : all(0)};
}

/// The sum of the lanes, in the same order on every machine.
ROUNDEL_INLINE float sum(const Lanes& v) {
    typedef float Half __attribute__((vector_size(2 * kLanes)));
    const Half h = __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
    return (h[0] + h[2]) + (h[1] + h[3]);
}

ROUNDEL_INLINE float greatest(const Lanes& v) {
    const Lanes four = greater(v, __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3));
    return std::max(std::max(four[0], four[1]), std::max(four[2], four[3]));
}

}  // namespace roundel
