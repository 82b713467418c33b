# SPDX-License-Identifier: BSD-3-Clause
"""A camera: a lens that stands somewhere."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.lens import Lens
from camera_node.pose import Pose, invert

Array = NDArray[np.float64]


class Camera(Lens, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A lens, its pose in the world (None until it is calibrated), and what its clock is off.

    True capture time = stamp + `time_offset_ms`. `covariance` is that of the pose in GTSAM's order (rotation in the
    camera's frame, then translation in the camera's frame), (6, 6), rad and m; None where it is not known.
    """

    T_world_cam: Pose | None = None
    time_offset_ms: float = 0.0
    covariance: tuple[tuple[float, ...], ...] | None = None
    lens_sigma: tuple[float, ...] | None = None

    def project_world(self, p_world: ArrayLike) -> Array:
        """Raw pixels (N, 2) of points (N, 3) in the world; NaN for those not before the camera."""
        return self.project(transform(invert(self.matrix()), p_world))

    def sees(self, uv: ArrayLike) -> NDArray[np.bool_]:
        """Which of the pixels (N, 2) lie in the image; NaN does not."""
        uv = np.asarray(uv, float).reshape(-1, 2)
        inside = (uv >= -0.5) & (uv < [self.width - 0.5, self.height - 0.5])
        return inside[:, 0] & inside[:, 1]

    def matrix(self) -> Array:
        """T_world_cam as a (4, 4) matrix.

        Raises:
            ValueError: the camera has no pose.
        """
        if self.T_world_cam is None:
            raise ValueError("the camera has no pose")
        return self.T_world_cam.matrix()


def transform(T: Array, points: ArrayLike) -> Array:
    """Points (N, 3) moved by the rigid motion T (4, 4)."""
    return np.asarray(points, float).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
