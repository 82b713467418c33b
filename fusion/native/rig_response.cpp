// SPDX-License-Identifier: BSD-3-Clause
#include "rig_response.hpp"

#include <algorithm>
#include <vector>

#include "numeric/simd.hpp"

namespace roundel::fusion {
namespace {

constexpr int kPoseErrors = 6;

/// Sums over the equations of a body in one frame: of a a^T for the six columns of the pose, and of a times
/// the derivative by the logarithm of the focal length.
struct ViewSums {
    double by_pose[kErrors][kPoseErrors], by_focal[kErrors];
};

/// Adds the equations k of a body to the sums of their frame, and to what is counted for the cameras.
ROUNDEL_CLONES void add(const WeightedEquations& observed, size_t k, ViewSums& view, ErrorMatrix& counted) {
    const Equations equations = observed.system.equations[k];  // a copy, which cannot alias the sums
    const double *u = equations.A[0], *v = equations.A[1], weight = observed.weights[k];
    const double x = observed.xy.at(0, k), y = observed.xy.at(1, k), shared = observed.rig_share[k];
    const double u_focal = observed.whiten.at(0, k) * x + observed.whiten.at(1, k) * y;
    const double v_focal = observed.whiten.at(2, k) * x + observed.whiten.at(3, k) * y;
    for (int i = 0; i < kErrors; ++i) {
        const double by_u = weight * u[i], by_v = weight * v[i];
        for (int j = 0; j < kPoseErrors; ++j) view.by_pose[i][j] += by_u * u[j] + by_v * v[j];
        for (int j = 0; j < kErrors; ++j) counted[i][j] += shared * (by_u * u[j] + by_v * v[j]);
        view.by_focal[i] += by_u * u_focal + by_v * v_focal;
    }
}

/// Adds the sums of a view to those by the errors of its camera. A camera that turns by w and moves by t in
/// its own frame shows the body as one that moved the other way: with the derivatives a_theta (body) and a_p
/// (world) of an equation, g = R_cam_world a_p, those by the camera are g x t_cam - R_cam a_theta and -g.
void add(const ViewSums& view, const BodyInCamera& body, const Matrix& R_cam_world, CameraBlock& sums) {
    for (int i = 0; i < kErrors; ++i) {
        const double* pose = view.by_pose[i];
        const Vector g = R_cam_world * Vector{pose[3], pose[4], pose[5]};
        const Vector turn = cross(g, body.t_cam) - body.R_cam * Vector{pose[0], pose[1], pose[2]};
        const double by_error[kCameraErrors] = {turn.x, turn.y, turn.z, -g.x,
                                                -g.y,   -g.z,   0,      view.by_focal[i]};
        for (int j = 0; j < kCameraErrors; ++j) sums[i][j] += by_error[j];
    }
}

/// to (12 x n) += A (12 x 12) times B (12 x n), four columns at a time: compilers keep their sums in
/// registers.
template <class Rows>
inline void add_product(const ErrorMatrix& A, const Rows& B, double sign, Rows& to) {
    for (size_t first = 0; first < B[0].size(); first += 4)
        for (int i = 0; i < kErrors; ++i) {
            double sums[4];
            for (int k = 0; k < 4; ++k) sums[k] = to[i][first + k];
            for (int j = 0; j < kErrors; ++j) {
                const double a = sign * A[i][j];
                for (int k = 0; k < 4; ++k) sums[k] += a * B[j][first + k];
            }
            for (int k = 0; k < 4; ++k) to[i][first + k] = sums[k];
        }
}

/// Rows of the transition: rotations by angular velocities, positions by velocities; see `Transition`.
template <class Rows>
inline void move(const double* T, double dt, Rows& rows) {
    for (int i = 0; i < 3; ++i)
        for (size_t k = 0; k < rows[0].size(); ++k) {
            for (int j = 0; j < 3; ++j) rows[i][k] += T[3 * i + j] * rows[6 + j][k];
            rows[3 + i][k] += dt * rows[9 + i][k];
        }
}

inline ErrorMatrix transposed_of(const ErrorMatrix& A) {
    ErrorMatrix B;
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j < kErrors; ++j) B[i][j] = A[j][i];
    return B;
}

inline ErrorMatrix product(const ErrorMatrix& A, const ErrorMatrix& B) {
    ErrorMatrix to{};
    add_product(A, B, 1, to);
    return to;
}

/// A step of the part of P that counts the cameras: E F D F^T E^T + P added P.
ROUNDEL_CLONES void step_counted(const double* T, double dt, const ErrorMatrix& E, const ErrorMatrix& P,
                                 const ErrorMatrix& added, ErrorMatrix& D) {
    ErrorMatrix half = D;
    move(T, dt, half);
    half = transposed_of(product(E, half));
    move(T, dt, half);
    D = product(E, half);
    add_product(product(P, added), P, 1, D);
}

/// A step of the columns of one camera: E F S.
ROUNDEL_CLONES void step_response(const double* T, double dt, const ErrorMatrix& E, CameraBlock& S) {
    CameraBlock before = S;
    move(T, dt, before);
    S = {};
    add_product(E, before, 1, S);
}

ROUNDEL_CLONES void subtract_product(const ErrorMatrix& P, const CameraBlock& sums, CameraBlock& S) {
    add_product(P, sums, -1, S);
}

ROUNDEL_CLONES void gain_of(const ErrorMatrix& P, const ErrorMatrix& information, ErrorMatrix& E) {
    E = product(P, information);
}

ErrorMatrix identity() {
    ErrorMatrix I{};
    for (int i = 0; i < kErrors; ++i) I[i][i] = 1;
    return I;
}

bool is_zero(const CameraBlock& block) {
    return std::all_of(block.begin(), block.end(), [](const auto& row) {
        return std::all_of(row.begin(), row.end(), [](double x) { return x == 0; });
    });
}

/// The products S L of a body (12 x 8 C), and which cameras have columns that are not zero.
struct ScaledResponse {
    size_t n_cameras, d = kCameraErrors * n_cameras;
    std::vector<double> columns = std::vector<double>(kErrors * d);
    std::vector<char> used = std::vector<char>(n_cameras);
};

/// Adds the columns of one camera; `begin` is the first element of each row of the factor.
ROUNDEL_CLONES void scale(const CameraBlock& S, size_t camera, const double* factor, const size_t* begin,
                          ScaledResponse& to) {
    for (size_t column = 0; column < kCameraErrors; ++column) {
        const size_t j = camera * kCameraErrors + column;
        const double* row = factor + j * to.d;
        for (size_t c = begin[j] / kCameraErrors; c <= camera; ++c) to.used[c] = true;
        for (int i = 0; i < kErrors; ++i) {
            const double s = S[i][column];
            double* sums = to.columns.data() + i * to.d;
            if (s == 0) continue;
            for (size_t k = begin[j]; k <= j; ++k) sums[k] += s * row[k];
        }
    }
}

/// Adds the covariance by the cameras.
ROUNDEL_CLONES void add_square(const ScaledResponse& scaled, ErrorMatrix& to) {
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j <= i; ++j) {
            const double *first = scaled.columns.data() + i * scaled.d,
                         *second = scaled.columns.data() + j * scaled.d;
            double lanes[4] = {};
            for (size_t c = 0; c < scaled.n_cameras; ++c) {
                if (!scaled.used[c]) continue;
                for (size_t k = c * kCameraErrors; k < (c + 1) * kCameraErrors; k += 4)
                    for (int l = 0; l < 4; ++l) lanes[l] += first[k + l] * second[k + l];
            }
            to[i][j] += (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
            to[j][i] = to[i][j];
        }
}

/// Adds T frame T^T, where T turns the position of a body's frame by R.
void add_turned(const double* frame, const double* R, ErrorMatrix& to) {
    const auto block = [frame](int i, int j) {
        const double* at = frame + 18 * i + 3 * j;
        return Matrix{{at[0], at[1], at[2]}, {at[6], at[7], at[8]}, {at[12], at[13], at[14]}};
    };
    const Matrix turn{{R[0], R[1], R[2]}, {R[3], R[4], R[5]}, {R[6], R[7], R[8]}};
    const auto add = [&to](int row, int column, const Matrix& by) {
        const Vector rows[] = {by.r0, by.r1, by.r2};
        for (int i = 0; i < 3; ++i) {
            to[row + i][column] += rows[i].x;
            to[row + i][column + 1] += rows[i].y;
            to[row + i][column + 2] += rows[i].z;
        }
    };
    const Matrix mixed = turn * block(1, 0);
    add(kTheta, kTheta, block(0, 0));
    add(kPosition, kTheta, mixed);
    add(kTheta, kPosition, transposed(mixed));
    add(kPosition, kPosition, turn * block(1, 1) * transposed(turn));
}

}  // namespace

void respond(const FramePoses& poses, const WeightedEquations& observed, const FilterSteps& steps,
             const int64_t* camera, size_t n_cameras, CameraBlock* responses, ErrorMatrix* counted) {
    const ByBody of(observed.system);
    const auto& exposures = poses.exposures();
    std::vector<CameraBlock> sums(n_cameras);
    std::vector<char> is_seen(n_cameras);
    for (size_t b = 0; b < observed.system.n_bodies; ++b) {
        std::fill(is_seen.begin(), is_seen.end(), false);
        ErrorMatrix added{}, E = identity();
        if (of.first[b] < of.first[b + 1]) gain_of(steps.P[b], steps.information[b], E);
        for (size_t at = of.first[b]; at < of.first[b + 1];) {
            const int64_t f = observed.frame[of.indices[at]], c = camera[f];
            ViewSums view{};
            for (; at < of.first[b + 1] && observed.frame[of.indices[at]] == f; ++at)
                add(observed, of.indices[at], view, added);
            if (!is_seen[c]) sums[c] = {};
            is_seen[c] = true;
            add(view, poses.at(f, b), exposures[f].R_cam_world, sums[c]);
        }
        const double *T = steps.T + 9 * b, dt = steps.dt[b];
        step_counted(T, dt, E, steps.P[b], added, counted[b]);
        for (size_t c = 0; c < n_cameras; ++c) {
            CameraBlock& S = responses[b * n_cameras + c];
            if (!is_zero(S)) step_response(T, dt, E, S);  // otherwise it has never seen the body
            if (is_seen[c]) subtract_product(steps.P[b], sums[c], S);
        }
    }
}

void consider(const ErrorMatrix* P, const Considered& bodies, const double* factor, size_t n_bodies,
              size_t n_cameras, ErrorMatrix* to) {
    const size_t d = kCameraErrors * n_cameras;
    std::vector<size_t> begin(d);  // of the first element of each row of the factor
    for (size_t j = 0; j < d; ++j) {
        const double* row = factor + j * d;
        begin[j] = size_t(std::find_if(row, row + j, [](double x) { return x != 0; }) - row);
    }
    for (size_t b = 0; b < n_bodies; ++b) {
        ScaledResponse scaled{n_cameras};
        for (size_t c = 0; c < n_cameras; ++c) {
            const CameraBlock& S = bodies.responses[b * n_cameras + c];
            if (!is_zero(S)) scale(S, c, factor, begin.data(), scaled);
        }
        for (int i = 0; i < kErrors; ++i)
            for (int j = 0; j < kErrors; ++j) to[b][i][j] = P[b][i][j] - bodies.counted[b][i][j];
        add_square(scaled, to[b]);
        add_turned(bodies.frame + 36 * b, bodies.R + 9 * b, to[b]);
    }
}

}  // namespace roundel::fusion
