// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <array>
#include <cmath>

namespace roundel {

template <int N>
using Vector = std::array<double, N>;

/// The Cholesky factor L of a symmetric positive definite matrix A = L L^T. Only the lower triangle of A is
/// read.
template <int N>
class Cholesky {
  public:
    explicit Cholesky(const std::array<Vector<N>, N>& A) : L_(A) {
        for (int j = 0; j < N; ++j) {
            for (int k = 0; k < j; ++k) L_[j][j] -= L_[j][k] * L_[j][k];
            positive_ = positive_ && L_[j][j] > 1e-12 * A[j][j];
            if (!positive_) return;
            L_[j][j] = std::sqrt(L_[j][j]);
            per_diagonal_[j] = 1 / L_[j][j];
            for (int i = j + 1; i < N; ++i) {
                for (int k = 0; k < j; ++k) L_[i][j] -= L_[i][k] * L_[j][k];
                L_[i][j] *= per_diagonal_[j];
            }
        }
    }
    bool positive() const { return positive_; }
    /// Element (i, j) of L, for j <= i.
    double at(size_t i, size_t j) const { return L_[i][j]; }
    double log_determinant() const {
        double sum = 0;
        for (const double x : per_diagonal_) sum -= 2 * std::log(x);
        return sum;
    }
    /// Solves A x = b.
    Vector<N> solve(const Vector<N>& b) const { return solve_tail<N>(halfway(b)); }
    /// L^-1 b: the square of its norm is b^T A^-1 b.
    Vector<N> halfway(Vector<N> b) const {
        for (int i = 0; i < N; ++i) {
            for (int k = 0; k < i; ++k) b[i] -= L_[i][k] * b[k];
            b[i] *= per_diagonal_[i];
        }
        return b;
    }
    /// The last M elements of L^-T y, which depend on the last of y only.
    template <int M>
    Vector<M> solve_tail(const Vector<N>& y) const {
        constexpr int first = N - M;
        Vector<M> x;
        for (int i = M - 1; i >= 0; --i) {
            x[i] = y[first + i];
            for (int k = i + 1; k < M; ++k) x[i] -= L_[first + k][first + i] * x[k];
            x[i] *= per_diagonal_[first + i];
        }
        return x;
    }
    /// The last M rows and columns of the inverse of A. They depend on the last block of L only:
    /// (L_22 L_22^T)^-1.
    template <int M>
    std::array<Vector<M>, M> inverse_tail() const {
        constexpr int first = N - M;
        std::array<Vector<M>, M> K{};  // L_22^-1
        std::array<Vector<M>, M> inverse{};
        for (int j = 0; j < M; ++j) {
            K[j][j] = per_diagonal_[first + j];
            for (int i = j + 1; i < M; ++i) {
                for (int k = j; k < i; ++k) K[i][j] -= L_[first + i][first + k] * K[k][j];
                K[i][j] *= per_diagonal_[first + i];
            }
        }
        for (int i = 0; i < M; ++i)
            for (int j = 0; j < M; ++j)
                for (int k = std::max(i, j); k < M; ++k) inverse[i][j] += K[k][i] * K[k][j];
        return inverse;
    }

  private:
    std::array<Vector<N>, N> L_;
    Vector<N> per_diagonal_{};
    bool positive_ = true;
};

}  // namespace roundel
