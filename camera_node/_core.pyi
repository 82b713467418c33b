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
        """One row of 16 a roundel.

        u, v, cov_uu, cov_uv, cov_vv, major, minor, angle, ratio, contrast; then the disc's own centre:
        offset_u, offset_v from the ellipse's, and their covariance uu, uv, vv; and the track's number.
        """

    def take_over(self, other: Detector) -> None: ...
    @property
    def theta(self) -> float: ...
    @property
    def postponed(self) -> int: ...
