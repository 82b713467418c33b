// SPDX-License-Identifier: BSD-3-Clause
#include "elimination.hpp"

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "numeric/cholesky.hpp"

namespace roundel::fusion {
namespace {

/// The normal equations of the errors that bodies share. Columns: those of all cameras, of the places of the
/// markers of one robot, and the right side.
class Shared {
  public:
    Shared(size_t n_cameras, size_t n_places)
        : d(kCameraErrors * n_cameras), width(d + n_places + 1), H_((width - 1) * width) {}
    double* row(size_t i) { return H_.data() + i * width; }
    double& at(size_t i, size_t j) { return H_[i * width + j]; }

    /// Adds the priors of the places of markers.
    void add(const RobotPriors& priors, size_t first_marker, size_t end) {
        for (size_t i = d; i < end; ++i) {
            const size_t m = first_marker + (i - d) / kPlaceErrors, c = (i - d) % kPlaceErrors;
            at(i, i) = (1 + priors.damping) * at(i, i) + priors.of_places[m][c];
            at(i, width - 1) += priors.right_of_places[m][c];
        }
    }
    /// Eliminates the columns of places up to `end` (Gauss-Jordan) from the rows of `seen` columns: then the
    /// rows of places hold their solution.
    void eliminate_places(const std::vector<size_t>& seen, size_t end) {
        for (size_t p = d; p < end; ++p) {
            if (at(p, p) <= 0) throw std::runtime_error("a marker of a keyframe is not determined");
            const double pivot = 1 / at(p, p);
            for (const size_t j : seen) at(p, j) *= pivot;
            for (const size_t i : seen) {
                if (i == p || i == width - 1) continue;
                const double by = at(i, p);
                for (const size_t j : seen) at(i, j) -= by * at(p, j);
            }
        }
    }
    void forget_places(size_t end) {
        for (size_t i = 0; i < end; ++i)
            std::fill(row(i) + (i < d ? d : 0), row(i) + (i < d ? end : width), 0.0);
    }

    const size_t d, width;

  private:
    std::vector<double> H_;
};

/// The sums of one body: its block, and by shared column its border.
struct BodyBlock {
    ErrorMatrix H{};
    std::vector<ErrorVector> border, solved;
};

/// Adds an observation to the block of its body and to the shared sums.
void add(const JointEquations& rows, double weight, size_t camera, size_t place, BodyBlock& block,
         Shared& shared) {
    std::array<size_t, kSharedErrors + 1> column;
    for (int i = 0; i < kCameraErrors; ++i) column[i] = camera + i;
    for (int i = 0; i < kPlaceErrors; ++i) column[kCameraErrors + i] = place + i;
    column[kSharedErrors] = shared.width - 1;
    for (const auto& row : rows.D) {
        const double* by_shared = row + kErrors;
        for (int i = 0; i < kErrors; ++i) {
            const double a = weight * row[i];
            for (int j = 0; j < kErrors; ++j) block.H[i][j] += a * row[j];
            for (int j = 0; j <= kSharedErrors; ++j) block.border[column[j]][i] += a * by_shared[j];
        }
        for (int i = 0; i < kSharedErrors; ++i) {
            double* to = shared.row(column[i]);
            for (int j = 0; j <= kSharedErrors; ++j) to[column[j]] += weight * by_shared[i] * by_shared[j];
        }
    }
}

/// Subtracts border^T H^-1 border from the shared sums of the columns that the body has.
void eliminate_body(BodyBlock& block, const std::vector<size_t>& seen, Shared& shared) {
    const Cholesky<kErrors> factor(block.H);
    if (!factor.positive()) throw std::runtime_error("a robot of a keyframe is not determined");
    for (const size_t j : seen) block.solved[j] = factor.solve(block.border[j]);
    for (const size_t k : seen) {
        if (k == shared.width - 1) continue;
        double* to = shared.row(k);
        for (const size_t j : seen)
            for (int i = 0; i < kErrors; ++i) to[j] -= block.border[k][i] * block.solved[j][i];
    }
}

/// The columns of the cameras that see some bodies, of places up to `end`, and of the right side.
std::vector<size_t> seen_columns(const JointSystem& system, const ByBody& of,
                                 const std::vector<size_t>& bodies, const Shared& shared, size_t end) {
    std::vector<char> is_seen(system.n_cameras);
    for (const size_t b : bodies)
        for (size_t at = of.first[b]; at < of.first[b + 1]; ++at)
            is_seen[system.camera[of.indices[at]]] = true;
    std::vector<size_t> seen;
    for (size_t j = 0; j < shared.d; ++j)
        if (is_seen[j / kCameraErrors]) seen.push_back(j);
    for (size_t j = shared.d; j < end; ++j) seen.push_back(j);
    seen.push_back(shared.width - 1);
    return seen;
}

/// Eliminates one robot: its bodies, and then the places of its markers.
void eliminate_robot(const JointSystem& system, const ByBody& of, const RobotPriors& priors,
                     const std::vector<size_t>& bodies, size_t first_marker, size_t n_markers, Shared& shared,
                     const Eliminated& to) {
    const size_t d = shared.d, end = d + kPlaceErrors * n_markers, right = shared.width - 1;
    std::vector<BodyBlock> blocks(bodies.size());
    for (size_t n = 0; n < bodies.size(); ++n) {
        const size_t b = bodies[n];
        BodyBlock& block = blocks[n];
        block.border.assign(shared.width, {});
        block.solved.assign(shared.width, {});
        for (size_t at = of.first[b]; at < of.first[b + 1]; ++at) {
            const size_t k = of.indices[at], marker = system.marker[k] - first_marker;
            if (marker >= n_markers) throw std::runtime_error("a marker belongs to another robot");
            add(system.equations[k], system.weights[k], kCameraErrors * system.camera[k],
                d + kPlaceErrors * marker, block, shared);
        }
        for (int i = 0; i < kErrors; ++i) {
            block.H[i][i] = (1 + priors.damping) * block.H[i][i] + priors.information[b][i];
            block.border[right][i] += priors.right[b][i];
        }
        eliminate_body(block, seen_columns(system, of, {b}, shared, end), shared);
    }
    shared.add(priors, first_marker, end);
    const size_t first = kPlaceErrors * first_marker, n_places = kPlaceErrors * system.n_markers;
    for (size_t i = d; i < end; ++i)
        std::copy_n(shared.row(i) + d, end - d, to.of_places + (first + i - d) * n_places + first);
    shared.eliminate_places(seen_columns(system, of, bodies, shared, end), end);
    const auto column = [&](size_t j) { return j < d ? j : right; };
    for (size_t i = d; i < end; ++i) {
        double* row = to.by_marker + (first + i - d) * (d + 1);
        for (size_t j = 0; j <= d; ++j) row[j] = shared.at(i, column(j));
    }
    for (size_t n = 0; n < bodies.size(); ++n)
        for (int i = 0; i < kErrors; ++i) {
            double* row = to.by_body + (bodies[n] * kErrors + i) * (d + 1);
            for (size_t j = 0; j <= d; ++j) {
                row[j] = blocks[n].solved[column(j)][i];
                for (size_t p = d; p < end; ++p) row[j] -= blocks[n].solved[p][i] * shared.at(p, column(j));
            }
        }
    shared.forget_places(end);
}

}  // namespace

void eliminate(const JointSystem& system, const RobotPriors& priors, const Eliminated& to) {
    const ByBody of({nullptr, system.body, system.n_equations, system.n_bodies});
    const auto owners = [&](int64_t robot) {
        return std::equal_range(system.owner, system.owner + system.n_markers, robot);
    };
    std::vector<std::vector<size_t>> by_robot;
    size_t most = 0;
    for (size_t b = 0; b < system.n_bodies; ++b) {
        by_robot.resize(std::max<size_t>(by_robot.size(), system.robot[b] + 1));
        by_robot[system.robot[b]].push_back(b);
        const auto [first, last] = owners(system.robot[b]);
        most = std::max<size_t>(most, last - first);
    }
    Shared shared(system.n_cameras, kPlaceErrors * most);
    for (size_t r = 0; r < by_robot.size(); ++r) {
        if (by_robot[r].empty()) continue;
        const auto [first, last] = owners(r);
        eliminate_robot(system, of, priors, by_robot[r], first - system.owner, last - first, shared, to);
    }
    for (size_t i = 0; i < shared.d; ++i) {
        double* row = to.reduced + i * (shared.d + 1);
        std::copy_n(shared.row(i), shared.d, row);
        row[shared.d] = shared.at(i, shared.width - 1);
    }
}

}  // namespace roundel::fusion
