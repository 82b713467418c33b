// SPDX-License-Identifier: BSD-3-Clause
#include "disc_view.hpp"

namespace roundel::fusion {

Placed place(const Body& body, const Exposure& exposure) {
    const Matrix R_world = turn(exposure.tau * body.omega) * body.R;
    const Vector to = body.p + exposure.tau * body.v - exposure.centre;
    return {exposure.R_cam_world * R_world, R_world, exposure.R_cam_world * to};
}

View view(const Placed& body, const Vector& marker, double radius) {
    const Vector c = body.t_cam + body.R_cam * marker, n = body.R_cam.column2();
    const double size = radius * radius / c.z;
    const Vector q = c + (size * n.z) * n - Vector{0, 0, size};
    const double z = c.z > kNearM ? q.z : std::numeric_limits<double>::quiet_NaN();
    return {c, n, q, q.x / z, q.y / z};
}

Poses::Poses(std::vector<Body> bodies, std::vector<Exposure> exposures)
    : n_bodies_(bodies.size()), exposures_(std::move(exposures)) {
    placed_.reserve(exposures_.size() * n_bodies_);
    for (const Exposure& exposure : exposures_)
        for (const Body& body : bodies) placed_.push_back(place(body, exposure));
}

void view_all(const Poses& poses, const Discs& discs, double* to) {
    const size_t n = discs.size();
    for (size_t k = 0; k < n; ++k) {
        const View seen =
            view(poses.at(discs.frame[k], discs.body[k]), discs.marker.vector(k), discs.radius[k]);
        double* row = to + k;
        for (const Vector& v : {seen.centre, seen.normal, seen.q})
            for (const double value : {v.x, v.y, v.z}) *row = value, row += n;
        row[0] = seen.x;
        row[n] = seen.y;
    }
}

}  // namespace roundel::fusion
