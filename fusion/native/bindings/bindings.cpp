// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/nanobind.h>

namespace roundel::fusion {
void bind_poses(nanobind::module_& m);
void bind_detections(nanobind::module_& m);
void bind_equations(nanobind::module_& m);
void bind_rays(nanobind::module_& m);
void bind_constellation(nanobind::module_& m);
}  // namespace roundel::fusion

NB_MODULE(_core, m) {
    nanobind::set_leak_warnings(false);  // a stopped server may hold arrays when Python exits
    roundel::fusion::bind_poses(m);
    roundel::fusion::bind_detections(m);
    roundel::fusion::bind_equations(m);
    roundel::fusion::bind_rays(m);
    roundel::fusion::bind_constellation(m);
}
