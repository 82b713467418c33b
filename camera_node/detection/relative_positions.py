# SPDX-License-Identifier: BSD-3-Clause
"""Positions of roundels relative to one calibrated camera, such as the camera that a robot carries.

See docs/relative.md.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.detection.disc_pose import DiscPoses, distances_by_principal_axis, locate_all
from camera_node.detection.roundels import DIAMETERS_M, DetectedRoundels, LocatedRoundels
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens

MAX_LOCATED = 64  # of one frame, the largest ones: the work for a frame is bounded


@dataclass(frozen=True)
class DiscLocalizer:
    """Locates roundels of one size in the frames of one camera.

    Attributes:
        lens: the camera's intrinsics.
        diameter_m: outer diameter of the black discs.

    Raises:
        ConfigError: no roundel has this diameter.
    """

    lens: Lens
    diameter_m: float

    def __post_init__(self) -> None:
        least, most = DIAMETERS_M
        if not least <= self.diameter_m <= most:
            raise ConfigError(
                f"the diameter is {self.diameter_m}; give that of the black disc, {least:g} to {most:g} m"
            )

    def check_size(self, width: int, height: int) -> None:
        """Raise ConfigError unless the intrinsics are those of images of this size."""
        lens = self.lens
        if (width, height) != (lens.width, lens.height):
            raise ConfigError(
                f"the camera's image has {width} x {height} px, but its intrinsics are for {lens.width} x "
                f"{lens.height} px; give --width and --height, or calibrate the lens at this size"
            )

    def locate(self, roundels: DetectedRoundels) -> LocatedRoundels:
        """Locate the roundels, the largest ones if there are many; those at which the lens has no inverse are left out.

        Position and covariance are the first two moments of the two-component mixture of both poses. Each component
        has the covariance of the least-squares adjustment.
        """
        if len(roundels) > MAX_LOCATED:
            roundels = roundels.select(np.argsort(-roundels.axes_px[:, 0], kind="stable")[:MAX_LOCATED])
        poses = locate_all(roundels, self.lens, self.diameter_m)
        position, cov = _moments(poses)
        distance = distances_by_principal_axis(roundels, self.lens, self.diameter_m)
        valid = np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(position).all(axis=1)
        return LocatedRoundels(
            position=position[valid],
            cov=cov[valid],
            normals=poses.normal[valid],
            probability=poses.probability[valid],
            normal_sigma=poses.normal_sigma[valid],
            axis_distance=distance[valid],
            id=roundels.id[valid],
            track=roundels.track[valid],
        )


def _moments(poses: DiscPoses) -> tuple[Array, Array]:
    """Mean (N, 3) and covariance (N, 3, 3) of the positions over both poses."""
    weight = poses.probability[..., None]
    mean = (weight * poses.position_m).sum(axis=1)
    apart = poses.position_m - mean[:, None]
    spread = poses.cov + apart[..., :, None] * apart[..., None, :]
    return mean, (weight[..., None] * spread).sum(axis=1)
