// SPDX-License-Identifier: BSD-3-Clause
#pragma once

/// ROUNDEL_CLONES marks a function that is compiled for AVX2 as well as for the baseline; the loader chooses
/// the variant. All functions that it calls must be inlined into it. On other architectures the baseline
/// includes vectors (NEON). ROUNDEL_AVX2 and ROUNDEL_BASELINE mark the two variants of a function written by
/// hand.
///
/// Floating-point operations are never contracted (see CMakeLists.txt) and sums keep the order of the lanes,
/// so that every machine, with or without vectors, computes the same result to the last bit.
#if defined(__x86_64__) && defined(__linux__) && !defined(ROUNDEL_SCALAR)
#define ROUNDEL_CLONES __attribute__((target_clones("arch=x86-64-v3", "default")))
#define ROUNDEL_AVX2 __attribute__((target("avx2")))
#define ROUNDEL_BASELINE __attribute__((target("default")))
#else
#define ROUNDEL_CLONES
#endif
