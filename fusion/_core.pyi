import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CAUCHY: float
NOMINAL_WEIGHT: float

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

def shears(axes: Array, angle: Array, centre: Array, normal: Array, radius: Array, scale: Array, /) -> Array:
    """(2, N) of measured ellipses, as discs should look with centre and normal (3, N)."""

def reweigh(
    rows: Array, body: Index, information: Array, right: Array, weights: Array, /
) -> tuple[Array, Array, Array]:
    """Sums of K priors and N rows by robust weights: information (K, 12, 12), right (K, 12), weights (N,)."""

def remainder(rows: Array, body: Index, steps: Array, /) -> Array:
    """(2, N) whitened: what steps (K, 12) leave of the rows."""
