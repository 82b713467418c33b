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

/// Of the normal distribution: 1 - Phi(t), and exp(-t^2 / 2).
struct Normal {
    Lanes tail, density;
};

/// By the polynomials of t^2 that are nearest on [-3.5, 3.5]: the tail is within 3e-5 there, and 2e-4 beyond,
/// the density within 3e-3, and 0 beyond. Terms that do not wait for each other are faster than a chain.
ROUNDEL_INLINE Normal normal_tail(const Lanes& t) {
    const Lanes above = t > -3.5f ? t : all(-3.5f), z = above < 3.5f ? above : all(3.5f);
    const Lanes u = z * z, uu = u * u;
    const Lanes odd = (0.398817865f - 0.0660721718f * u) + uu * (0.00956194028f - 0.00100343984f * u) +
                      uu * uu * ((7.07925185e-05f - 2.94779384e-06f * u) + uu * 5.38789068e-08f);
    const Lanes even = (0.997568669f - 0.483258972f * u) + uu * (0.106027517f - 0.0125441721f * u) +
                       uu * uu * (0.000765829199f - 1.87586468e-05f * u);
    return {0.5f - z * odd, z == t ? even : all(0)};
}

/// Sum in an order that all machines keep.
ROUNDEL_INLINE float sum(const Lanes& v) {
    typedef float Half __attribute__((vector_size(2 * kLanes)));
    const Half h = __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
    return (h[0] + h[2]) + (h[1] + h[3]);
}

}  // namespace roundel
