// SPDX-License-Identifier: BSD-3-Clause
#include "disc_view.hpp"

#include "numeric/disc_outline.hpp"

namespace roundel::fusion {

BodyInCamera transform(const Body& body, const Exposure& exposure) {
    const Matrix R_world = rotation_from_vector(exposure.tau * body.omega) * body.R;
    const Vector from_camera = body.p + exposure.tau * body.v - exposure.centre;
    const Matrix& R = exposure.R_cam_world;
    return {R * R_world, R_world, R * from_camera, R * body.omega, R * body.v};
}

DiscView view_disc(const BodyInCamera& body, const DiscOnBody& disc) {
    const Vector c = body.t_cam + body.R_cam * disc.position, n = body.R_cam * disc.normal;
    const Vector q = outline_centre(c, n, disc.radius);
    const double z = c.z > kNearM ? q.z : std::numeric_limits<double>::quiet_NaN();
    return {c, n, q, q.x / z, q.y / z};
}

FramePoses::FramePoses(const std::vector<Body>& bodies, const std::vector<Exposure>& exposures)
    : n_bodies_(bodies.size()),
      bodies_(bodies),
      exposures_(exposures),
      poses_(std::make_unique_for_overwrite<BodyInCamera[]>(bodies.size() * exposures.size())),
      is_known_(bodies.size() * exposures.size()) {}

Exposure FramePoses::exposure(const Discs& discs, size_t k) const {
    Exposure row = exposures_[discs.frame[k]];
    row.tau += discs.delay[k];
    return row;
}

BodyInCamera FramePoses::at(const Discs& discs, size_t k) const {
    if (discs.delay[k] == 0) return at(discs.frame[k], discs.body[k]);
    return transform(bodies_[discs.body[k]], exposure(discs, k));
}

void view_discs(const FramePoses& poses, const Discs& discs, double* to) {
    const size_t n = discs.size();
    for (size_t k = 0; k < n; ++k) {
        const DiscView seen = view_disc(poses.at(discs, k), discs.at(k));
        double* row = to + k;
        for (const Vector& v : {seen.centre, seen.normal, seen.q})
            for (const double value : {v.x, v.y, v.z}) {
                *row = value;
                row += n;
            }
        row[0] = seen.x;
        row[n] = seen.y;
    }
}

}  // namespace roundel::fusion
