from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

CODE_SECTORS: int
CODE_RADII: tuple[float, float]  # of the ring of sectors, outer radii of the roundel

def code_words() -> list[int]: ...  # see `geometry.codes`
def fault_of_detections(
    max_rows: int, max_variance: float, /, *columns: bytes
) -> str: ...  # empty if there is none
def unpack_detections(
    uv: bytes,
    cov: bytes,
    axes_px: bytes,
    angle_rad: bytes,
    ratio: bytes,
    contrast: bytes,
    id_probability: bytes,
    rotation_rad: bytes,
    rotation_sigma: bytes,
) -> NDArray[
    np.float64
]: ...  # (14 N,) the columns of `protocol.messages.Detections`, covariances with 4 numbers
def quaternions(
    rotations: NDArray[np.float64],
) -> NDArray[np.float64]: ...  # (N, 4) of (N, 3, 3), see `geometry.pose.wxyz_from_rotation`
def distance_by_principal_axis(diameter: float, major: float) -> float: ...
def disc_pictures(
    position: NDArray[np.float64], normal: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...  # see `geometry.outline`

class Lens:
    """Intrinsics: fx, fy, cx, cy and up to 12 distortion numbers in OpenCV's order, or 4 of a fisheye."""

    def __init__(self, is_fisheye: bool, numbers: NDArray[np.float64]) -> None: ...
    def constrain(
        self,
        lens_sigma: float,
        uv: NDArray[np.float64],
        axes_px: NDArray[np.float64],
        angle_rad: NDArray[np.float64],
        offset_px: NDArray[np.float64],
        pose_cov: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """(N, 9): u, v, major, minor, angle, the covariance uu, uv, vv, and chi-square (NaN if unchanged)."""

class RoundelLimits:
    """The limits within which a ring counts as a roundel. Without `inner_ratios` the detector finds the prints."""

    def __init__(
        self,
        inner_ratios: list[float],
        ratio_tolerance: float,
        min_diameter: float,
        max_diameter: float,
        min_contrast: float,
    ) -> None: ...

class FrameColumns(TypedDict):
    """The N roundels of a frame, in pixels and grey levels.

    `offset_px` points from the outer ellipse's centre to the image of the disc's centre. `pose_cov` is the covariance
    of u, v, of the shape xx, xy, yy (the ellipse is centre + A q, |q| = 1) and of the offset.
    """

    uv: NDArray[np.float64]  # (N, 2)
    axes_px: NDArray[np.float64]  # (N, 2) full axes, major first
    angle_rad: NDArray[np.float64]  # (N,)
    ratio: NDArray[np.float64]  # (N,)
    contrast: NDArray[np.float64]  # (N,)
    offset_px: NDArray[np.float64]  # (N, 2)
    pose_cov: NDArray[np.float64]  # (N, 7, 7)
    track: NDArray[np.int32]  # (N,)
    id: NDArray[np.int32]  # (N,) certain code, -1 for none; what follows is NaN without one
    id_probability: NDArray[np.float64]  # (N,)
    rotation_rad: NDArray[np.float64]  # (N,)
    rotation_sigma: NDArray[np.float64]  # (N,)
    n_postponed: int  # seeds left for the next frame

class Detector:
    def __init__(self, limits: RoundelLimits, search_share: float, by_paper: bool) -> None: ...
    def detect(self, image: NDArray[np.uint8]) -> FrameColumns: ...
    def explain(self, image: NDArray[np.uint8]) -> NDArray[np.float64]: ...  # (N, 9): see `refusals`
    def take_over(self, other: Detector) -> None: ...
    @property
    def theta(self) -> float | None: ...
    @property
    def tone_exponent(self) -> float | None: ...
    @property
    def found_ratios(self) -> list[float]: ...
