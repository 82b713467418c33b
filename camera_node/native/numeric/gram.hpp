// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>

#include "numeric/lanes.hpp"

namespace roundel {

/// Lanes per chunk of pixels. A chunk's columns fit into the first-level cache; the number is odd so that
/// columns do not share a cache bank.
constexpr int kChunk = 31;

/// `N` columns of a chunk of pixels, and the upper triangle of their products in pairs, lane by lane.
template <int N>
using Columns = Lanes[N][kChunk];
template <int N>
using Gram = Lanes[N][N];

/// Adds the products of columns i .. i + m with columns j .. j + n.
template <int i, int j, int m, int n, int N>
ROUNDEL_INLINE void multiply_tile(const Columns<N>& columns, int count, Gram<N>& gram) {
    Lanes s[m][n];
    for (int a = 0; a < m; ++a)
        for (int b = 0; b < n; ++b) s[a][b] = gram[i + a][j + b];
    for (int k = 0; k < count; ++k)
        for (int a = 0; a < m; ++a)
            for (int b = 0; b < n; ++b) s[a][b] += columns[i + a][k] * columns[j + b][k];
    for (int a = 0; a < m; ++a)
        for (int b = 0; b < n; ++b) gram[i + a][j + b] = s[a][b];
}

/// Adds the products from tile (i, j) on. The products of 2 x 4 columns fit into registers.
template <int i, int j, int N>
ROUNDEL_INLINE void multiply_from(const Columns<N>& columns, int count, Gram<N>& gram) {
    constexpr int m = std::min(2, N - i), n = std::min(4, N - j);
    multiply_tile<i, j, m, n, N>(columns, count, gram);
    if constexpr (j + n < N)
        multiply_from<i, j + n, N>(columns, count, gram);
    else if constexpr (i + m < N)
        multiply_from<i + m, i + m, N>(columns, count, gram);
}

/// Adds the products of `count` lanes.
template <int N>
ROUNDEL_INLINE void multiply_all(const Columns<N>& columns, int count, Gram<N>& gram) {
    multiply_from<0, 0, N>(columns, count, gram);
}

}  // namespace roundel
