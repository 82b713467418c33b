// SPDX-License-Identifier: BSD-3-Clause
#pragma once

/// ROUNDEL_CLONES marks a function that is compiled for AVX2 beside the baseline, and chosen when the library
/// is loaded. What it calls must be inlined into it. Elsewhere the baseline has vectors of its own (NEON).
/// ROUNDEL_AVX2 and ROUNDEL_BASELINE mark the two variants where each is written by hand.
///
/// Floating point is never contracted and sums keep their lanes (see CMakeLists.txt), so that every machine,
/// with vectors or without, gives the same result to the last bit.
#if defined(__x86_64__) && defined(__linux__) && !defined(ROUNDEL_SCALAR)
#define ROUNDEL_CLONES __attribute__((target_clones("arch=x86-64-v3", "default")))
#define ROUNDEL_AVX2 __attribute__((target("arch=x86-64-v3")))
#define ROUNDEL_BASELINE __attribute__((target("default")))
#else
#define ROUNDEL_CLONES
#endif
