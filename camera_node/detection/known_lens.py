# SPDX-License-Identifier: BSD-3-Clause
"""Makes the outlines of detected roundels more precise where the camera's intrinsics are known.

See docs/design/detector_model.md, section 9a.
"""

import numpy as np

from camera_node import _core
from camera_node.detection.roundels import DetectedRoundels, Roundels
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens

# Of the learned error of the lens, relative to the largest offset. The least one is that of a focal length that is
# wrong by 0.4 %; at the largest one the roundels know nothing of the lens.
MIN_SIGMA, MAX_SIGMA = 0.002, 1.0
WRONG = 0.2  # from which the lens counts as another one: imperfect prints explain less
# 1.4 times the median of chi-square with two degrees of freedom, so that chance does not increase the error.
EXPECTED = 1.94
GAIN = 0.6  # of the logarithm of the error, for a frame in which all roundels contradict the lens
MAX_COEFFICIENTS = 12  # those of a tilted sensor are not supported


class KnownLens:
    """The intrinsics of a camera, and how far its roundels have agreed with them.

    A roundel is a circle in space, so that its picture has five unknowns where the detector fits seven. Each frame is
    also a test of the lens: the error that counts for it is learned, and a wrong lens is not used after a few frames.

    Attributes:
        lens: the intrinsics.
        sigma: standard deviation of the lens's error, relative to the largest offset between an outline's centre and
            the image of the disc's centre, D^2 / (4 f).
    """

    def __init__(self, lens: Lens) -> None:
        """Raise ConfigError if the native detector does not support the model of the lens."""
        if any(lens.distortion[MAX_COEFFICIENTS:]):
            raise ConfigError(
                "the lens has coefficients of a tilted sensor (tau_x, tau_y), which the detector does not support; "
                "calibrate it with 12 coefficients or fewer"
            )
        self.lens, self.sigma = lens, MIN_SIGMA
        numbers = np.ascontiguousarray(lens.parameters[: 4 + MAX_COEFFICIENTS])
        self._core = _core.Lens(lens.model == "fisheye", numbers)

    @property
    def contradicted(self) -> bool:
        """Whether the roundels contradict the lens: it is that of another camera, or of another focus or zoom."""
        return self.sigma > WRONG

    def constrain(self, roundels: DetectedRoundels) -> tuple[Roundels, Array]:
        """Condition the outlines on the lens.

        A roundel that contradicts the lens by more than three standard deviations stays as it was measured; so does
        one at which the lens has no inverse.

        Returns:
            The roundels without the other measurements of the fit, which hold for an unknown lens.
            (N,) chi-square of two degrees of freedom by which each measurement contradicts the lens; NaN where it
            could not be computed.
        """
        columns = roundels.uv, roundels.axes_px, roundels.angle_rad, roundels.offset_px, roundels.pose_cov
        rows = self._core.constrain(self.sigma, *(np.ascontiguousarray(column) for column in columns))
        u, v, major, minor, angle, uu, uv, vv, chi2 = rows.T
        cov = np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2)
        constrained = Roundels(
            np.column_stack([u, v]),
            cov,
            np.column_stack([major, minor]),
            angle,
            roundels.ratio,
            roundels.contrast,
            roundels.id,
            roundels.track,
            roundels.id_probability,
            roundels.rotation_rad,
            roundels.rotation_sigma,
        )
        return constrained, chi2

    def refine(self, roundels: DetectedRoundels) -> Roundels:
        """As `constrain`, for the roundels of the next frame; learns the lens's error from them."""
        constrained, chi2 = self.constrain(roundels)
        known = chi2[np.isfinite(chi2)]
        if len(known):
            above = float((known > EXPECTED).mean()) - 0.5
            self.sigma = float(np.clip(self.sigma * np.exp(GAIN * above), MIN_SIGMA, MAX_SIGMA))
        return constrained
