// SPDX-License-Identifier: BSD-3-Clause
#include "rig_response.hpp"

#include <algorithm>
#include <vector>

#include "numeric/simd.hpp"

namespace roundel::fusion {
namespace {

constexpr int kPoseErrors = 6, kFocal = 7;

/// Sums over the equations of a body in one frame: of a a^T for the six columns of the pose, and of a times
/// the derivative by the logarithm of the focal length.
struct ViewSums {
    bool is_seen;
    double by_pose[kErrors][kPoseErrors], by_focal[kErrors];
};

/// Adds the equations `first` to `last` of a body to the sums of their frames, and those counted for the
/// cameras.
void add(const WeightedEquations& observed, const size_t* first, const size_t* last, ViewSums* views,
         ErrorMatrix& counted) {
    for (; first != last; ++first) {
        const size_t k = *first;
        ViewSums& view = views[observed.frame[k]];
        view.is_seen = true;
        for (int a = 0; a < 2; ++a) {
            const double *row = observed.system.equations[k].A[a], weight = observed.weights[k];
            const double by_focal = observed.whiten.at(2 * a, k) * observed.xy.at(0, k) +
                                    observed.whiten.at(2 * a + 1, k) * observed.xy.at(1, k);
            for (int i = 0; i < kErrors; ++i) {
                const double scaled = weight * row[i], shared = scaled * observed.rig_share[k];
                for (int j = 0; j < kPoseErrors; ++j) view.by_pose[i][j] += scaled * row[j];
                for (int j = 0; j < kErrors; ++j) counted[i][j] += shared * row[j];
                view.by_focal[i] += scaled * by_focal;
            }
        }
    }
}

/// Subtracts the sums of a view from the columns of its camera. A camera that turns by w and moves by t in
/// its own frame shows the body as one that moved the other way: with the derivatives a_theta (body) and a_p
/// (world) of an equation, g = R_cam_world a_p, those by the camera are g x t_cam - R_cam a_theta and -g.
void subtract(const ViewSums& view, const BodyInCamera& body, const Matrix& R_cam_world, size_t d,
              double* columns) {
    for (int i = 0; i < kErrors; ++i) {
        const double* sums = view.by_pose[i];
        const Vector g = R_cam_world * Vector{sums[3], sums[4], sums[5]};
        const Vector turn = cross(g, body.t_cam) - body.R_cam * Vector{sums[0], sums[1], sums[2]};
        double* to = columns + i * d;
        to[0] -= turn.x;
        to[1] -= turn.y;
        to[2] -= turn.z;
        to[3] += g.x;
        to[4] += g.y;
        to[5] += g.z;
        to[kFocal] -= view.by_focal[i];
    }
}

/// to (12 x n) += A (12 x 12) times B (12 x n).
inline void add_product(const ErrorMatrix& A, const double* B, size_t n, double* to) {
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j < kErrors; ++j) {
            const double a = A[i][j];
            for (size_t k = 0; k < n; ++k) to[i * n + k] += a * B[j * n + k];
        }
}

/// Rows of the transition: rotations by angular velocities, positions by velocities; see `Transition`.
void move(const double* T, double dt, size_t n, double* rows) {
    for (int i = 0; i < 3; ++i)
        for (size_t k = 0; k < n; ++k) {
            for (int j = 0; j < 3; ++j) rows[i * n + k] += T[3 * i + j] * rows[(6 + j) * n + k];
            rows[(3 + i) * n + k] += dt * rows[(9 + i) * n + k];
        }
}

ErrorMatrix transposed_of(const ErrorMatrix& A) {
    ErrorMatrix B;
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j < kErrors; ++j) B[i][j] = A[j][i];
    return B;
}

/// F C F^T of a symmetric C.
void move_both(const double* T, double dt, ErrorMatrix& C) {
    for (int turn = 0; turn < 2; ++turn) {
        move(T, dt, kErrors, C[0].data());
        C = transposed_of(C);
    }
}

ROUNDEL_CLONES void multiply(const ErrorMatrix& A, const double* B, size_t n, double* to) {
    std::fill_n(to, kErrors * n, 0.0);
    add_product(A, B, n, to);
}

/// sums (12 x n) + A (12 x 12) times B (12 x n).
ROUNDEL_CLONES void accumulate(const ErrorMatrix& A, const double* B, size_t n, double* sums) {
    add_product(A, B, n, sums);
}

ErrorMatrix product(const ErrorMatrix& A, const ErrorMatrix& B) {
    ErrorMatrix to;
    multiply(A, B[0].data(), kErrors, to[0].data());
    return to;
}

}  // namespace

void respond(const FramePoses& poses, const WeightedEquations& observed, const FilterSteps& steps,
             const int64_t* camera, size_t n_cameras, double* responses, ErrorMatrix* counted) {
    const ByBody of(observed.system);
    const auto& exposures = poses.exposures();
    const size_t d = kCameraErrors * n_cameras;
    std::vector<ViewSums> views(exposures.size());
    std::vector<double> sums(kErrors * d);
    for (size_t b = 0; b < observed.system.n_bodies; ++b) {
        double* response = responses + b * kErrors * d;
        move(steps.T + 9 * b, steps.dt[b], d, response);
        move_both(steps.T + 9 * b, steps.dt[b], counted[b]);
        if (of.first[b] == of.first[b + 1]) continue;
        std::fill(views.begin(), views.end(), ViewSums{});
        ErrorMatrix added{};
        const size_t* indices = of.indices.data();
        add(observed, indices + of.first[b], indices + of.first[b + 1], views.data(), added);
        std::fill(sums.begin(), sums.end(), 0.0);
        for (size_t f = 0; f < views.size(); ++f)
            if (views[f].is_seen)
                subtract(views[f], poses.at(f, b), exposures[f].R_cam_world, d,
                         sums.data() + kCameraErrors * camera[f]);
        accumulate(steps.information[b], response, d, sums.data());
        multiply(steps.P[b], sums.data(), d, response);
        const ErrorMatrix weighted = product(steps.information[b], counted[b]);
        accumulate(weighted, steps.information[b][0].data(), kErrors, added[0].data());
        counted[b] = product(product(steps.P[b], added), steps.P[b]);
    }
}

ROUNDEL_CLONES void consider(const ErrorMatrix* P, const ErrorMatrix* counted, const double* responses,
                             const double* factor, size_t n_bodies, size_t d, ErrorMatrix* to) {
    std::vector<size_t> begin(d);  // of the first element of each row of the factor
    for (size_t j = 0; j < d; ++j)
        while (begin[j] < j && factor[j * d + begin[j]] == 0) ++begin[j];
    std::vector<double> scaled(kErrors * d);
    for (size_t b = 0; b < n_bodies; ++b) {
        const double* S = responses + b * kErrors * d;
        std::fill(scaled.begin(), scaled.end(), 0.0);
        for (int i = 0; i < kErrors; ++i)
            for (size_t j = 0; j < d; ++j) {
                const double s = S[i * d + j];
                for (size_t k = begin[j]; k <= j; ++k) scaled[i * d + k] += s * factor[j * d + k];
            }
        for (int i = 0; i < kErrors; ++i)
            for (int j = 0; j <= i; ++j) {
                double lanes[4] = {};
                for (size_t k = 0; k < d; k += 4)  // d is a multiple of 8
                    for (int l = 0; l < 4; ++l) lanes[l] += scaled[i * d + k + l] * scaled[j * d + k + l];
                const double rig = (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
                to[b][i][j] = to[b][j][i] = P[b][i][j] - counted[b][i][j] + rig;
            }
    }
}

}  // namespace roundel::fusion
