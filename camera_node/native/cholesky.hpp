// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <cmath>

namespace roundel {

template <int N>
using Vector = std::array<double, N>;

/// The lower triangle L of a symmetric positive definite matrix A = L L^T, of which only the lower triangle
/// is read.
template <int N>
class Cholesky {
  public:
    explicit Cholesky(const std::array<Vector<N>, N>& A) : L_(A) {
        for (int j = 0; j < N; ++j) {
            for (int k = 0; k < j; ++k) L_[j][j] -= L_[j][k] * L_[j][k];
            positive_ = positive_ && L_[j][j] > 1e-12 * A[j][j];
            if (!positive_) return;
            L_[j][j] = std::sqrt(L_[j][j]);
            for (int i = j + 1; i < N; ++i) {
                for (int k = 0; k < j; ++k) L_[i][j] -= L_[i][k] * L_[j][k];
                L_[i][j] /= L_[j][j];
            }
        }
    }
    bool positive() const { return positive_; }
    /// x of A x = b.
    Vector<N> solve(Vector<N> b) const {
        for (int i = 0; i < N; ++i) {
            for (int k = 0; k < i; ++k) b[i] -= L_[i][k] * b[k];
            b[i] /= L_[i][i];
        }
        for (int i = N - 1; i >= 0; --i) {
            for (int k = i + 1; k < N; ++k) b[i] -= L_[k][i] * b[k];
            b[i] /= L_[i][i];
        }
        return b;
    }

  private:
    std::array<Vector<N>, N> L_;
    bool positive_ = true;
};

}  // namespace roundel
