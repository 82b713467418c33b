import numpy as np
from numpy.typing import NDArray

def distance_by_principal_axis(diameter: float, major: float) -> float: ...

class Detector:
    def __init__(
        self,
        inner_ratios: list[float],
        ratio_tolerance: float,
        min_diameter: float,
        max_diameter: float,
        min_contrast: float,
        search_share: float,
        by_paper: bool,
    ) -> None: ...
    def detect(self, image: NDArray[np.uint8]) -> NDArray[np.float64]:
        """One row of 38 a roundel.

        u, v, major, minor, angle, ratio, contrast; offset_u, offset_v from the ellipse's centre to the disc's own;
        the track's number; then the upper triangle, row by row, of the covariance (7, 7) of what the pose follows
        from: u, v, the shape xx, xy, yy (the ellipse is centre + A q, |q| = 1), offset_u and offset_v.
        """

    def take_over(self, other: Detector) -> None: ...
    @property
    def theta(self) -> float: ...
    @property
    def postponed(self) -> int: ...
