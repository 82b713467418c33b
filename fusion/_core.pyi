import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CAUCHY: float
NOMINAL_WEIGHT: float
MIN_PARALLAX: float

class Poses:
    """Every body in every frame, at the frame's own time."""

    def __init__(
        self, R: Array, p: Array, omega: Array, v: Array, R_cam_world: Array, centres: Array, tau: Array, /
    ) -> None:
        """B bodies, R (B, 3, 3) and the rest (B, 3); F frames, R_cam_world (F, 3, 3), centres (F, 3), tau (F,)."""

    def view(self, frame: Index, body: Index, marker: Array, radius: Array, /) -> Array:
        """(11, N): centre, normal and q, camera frame, and the outline's centre xy, NaN where it can't be seen."""

    def linearise(
        self,
        frame: Index,
        body: Index,
        marker: Array,
        radius: Array,
        xy: Array,
        whiten: Array,
        single: NDArray[np.bool_],
        /,
    ) -> Array:
        """(N, 2, 13) whitened equations A delta = b of the bodies' errors, each A and then b; zeros if unseen.

        xy (2, N), whiten (2, 2, N), single (B,).
        """

    def linearise_outlines(
        self,
        frame: Index,
        body: Index,
        marker: Array,
        radius: Array,
        axes: Array,
        angle: Array,
        scale: Array,
        sigma: Array,
        /,
    ) -> Array:
        """(N, 2, 13) likewise of shears: axes (2, N), angle (N,), scale (2, 2, N), sigma (N,)."""

class ExpectedMarkers:
    """M markers of bodies that are followed, and how well their places are predicted."""

    def __init__(self, R: Array, P: Array, body: Index, marker: Array, radius: Array, /) -> None:
        """Bodies' R (B, 3, 3) and P (B, 12, 12); of each marker the body, the place (3, M) in it and the radius."""

    def covariances(self, tau: float, /) -> Array:
        """(M, 3, 3) of places in the world, tau seconds after the instant."""

    def candidates(
        self,
        poses: Poses,
        frame: Index,
        xy: Array,
        scale: Array,
        cov: Array,
        major: Array,
        focal: Array,
        /,
    ) -> tuple[Index, Array]:
        """(2, K) markers and detections within each other's gates, and (K,) what each pair costs.

        N detections in order of their frames: xy (2, N), scale and cov (2, 2, N), major (N,); focal (F,) by frame.
        """

def look_up(cells: Array, cell_px: float, uv: Array, /) -> tuple[Array, Array]:
    """(2, N) undistorted coordinates of pixels (N, 2), and (2, 2, N) the derivatives of pixels by these.

    cells (rows + 2, columns + 2, 20): see `native/inverse_lens.hpp`.
    """

def shears(axes: Array, angle: Array, centre: Array, normal: Array, radius: Array, scale: Array, /) -> Array:
    """(2, N) of measured ellipses, as discs should look with centre and normal (3, N)."""

def predict(
    R: Array,
    p: Array,
    omega: Array,
    v: Array,
    P: Array,
    dt: Array,
    densities: Array,
    single: NDArray[np.bool_],
    /,
) -> tuple[Array, Array, Array, Array]:
    """R (N, 3, 3), p (N, 3) and P (N, 12, 12) after dt (N,) seconds, and T (N, 3, 3): turns' errors by rates'.

    densities (N, 2) and single (N,) as `fusion.model.states.predict` has them.
    """

def reweigh(
    rows: Array, body: Index, information: Array, right: Array, weights: Array, /
) -> tuple[Array, Array, Array]:
    """Sums of K priors and N rows by robust weights: information (K, 12, 12), right (K, 12), weights (N,)."""

def remainder(rows: Array, body: Index, steps: Array, /) -> Array:
    """(2, N) whitened: what steps (K, 12) leave of the rows."""

def inverses(information: Array, /) -> Array:
    """(K, 12, 12) of positive definite matrices; raises RuntimeError where one is not."""

def densest_ranges(
    camera: Index,
    centre: Array,
    moved: Array,
    frame: Index,
    direction: Array,
    reach: Array,
    ranges: Array,
    /,
) -> Array:
    """(N,) the range of each ray at which most rays of other cameras meet it; NaN where none does.

    Of F frames the camera (F,), a row of the centres (C, 3), and how far a marker moves until then (F,); of N rays the
    frame (N,), direction (N, 3), noise by metre of range (N,) and ranges (N, K, 2): see `native/meetings.hpp`.
    """
