# SPDX-License-Identifier: BSD-3-Clause
"""Adjusts one lens and the board's poses by least squares on the corners of its views (Zhang 2000, section 3).

Works for every model of `camera_node.geometry.lens`, which provides the derivatives. Poses are eliminated view by view
(the Schur complement of bundle adjustment), so that the cost is linear in the number of views.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig.estimation import CAUCHY_SCALE, STEPS, cauchy_cost, cauchy_weights, coordinate_sigma, rms
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import motion_from, rotation_from_vector

MAX_ITERATIONS = 100
MAX_DAMPING = 1e10
# The prior of a lens, 1 sigma; it matters only where the views leave a parameter open.
CORNER_SIGMA_PX = 0.2  # of a detected corner: the weight of views against the prior
TERM_SIGMA = 0.2  # of each radial distortion term at the image's corner, as a fraction of the corner's radius
TANGENTIAL_SIGMA = 0.02  # the same, of tangential terms
SQUARE_SIGMA, ANY_SIGMA = 0.003, 0.3  # of fx / fy from 1: of square pixels, and of any
CENTRE_SIGMA = 0.05  # of the principal point from the image's centre, as a fraction of the longer side
RADIAL_POWERS = {"pinhole": [2, 4, 1, 1, 6], "fisheye": [2, 4, 6, 8]}  # of each coefficient; 1: tangential
FOCAL_STARTS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5, 2.5, 4.0)  # of the image's longer side
BAD_PX = 1e6  # the misfit of a view that a lens can't have seen


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board in one image: corners (n, 2), pixels, and (n, 3), metres on the board; and the image's name."""

    pixels: NDArray[np.float32]
    corners: NDArray[np.float32]
    name: str = ""

    @property
    def area(self) -> Array:
        """(n^2, 2) pixels across the part of the image that the board covers: the midpoints of all pairs."""
        return ((self.pixels[:, None] + self.pixels[None]) / 2).reshape(-1, 2).astype(float)


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Normal prior of `Lens.parameters`: mean (P,) and information (P, P), scaled to corners of 1 px."""

    mean: Array
    information: Array

    @classmethod
    def of(cls, lens: Lens, aspect_sigma: float) -> "LensPrior":
        """The prior of lenses with about the focal length of `lens`, and fx / fy near 1."""
        size = max(lens.width, lens.height)
        mean = np.array([0, 0, (lens.width - 1) / 2, (lens.height - 1) / 2, *[0.0] * len(lens.distortion)])
        weights = np.zeros(len(mean))
        weights[2:4] = (CENTRE_SIGMA * size) ** -2
        corner = np.hypot(lens.width, lens.height) / 2 / lens.fx
        powers = np.array(RADIAL_POWERS[lens.model])
        terms = np.where(powers == 1, TANGENTIAL_SIGMA, TERM_SIGMA) / corner**powers
        weights[4 : 4 + len(terms)] = (terms**-2)[: len(lens.distortion)]
        aspect = np.zeros(len(mean))
        aspect[:2] = 1 / (aspect_sigma * lens.fx), -1 / (aspect_sigma * lens.fx)
        return cls(mean, CORNER_SIGMA_PX**2 * (np.diag(weights) + np.outer(aspect, aspect)))

    def cost(self, lens: Lens) -> float:
        """Squared Mahalanobis distance of a lens from the mean."""
        off = lens.parameters - self.mean
        return float(off @ self.information @ off)


@dataclass(frozen=True, slots=True)
class AdjustedLens:
    """A lens adjusted to V views.

    Attributes:
        lens: the adjusted lens.
        poses: (V, 4, 4) T_cam_board.
        residuals: (n, 2) for each view, observed less predicted pixels.
        covariance: (4 + D, 4 + D) of `Lens.parameters`.
    """

    lens: Lens
    poses: Array
    residuals: list[Array]
    covariance: Array

    @property
    def view_rms_px(self) -> Array:
        """(V,) root mean square reprojection error of each view."""
        return np.array([rms(np.linalg.norm(r, axis=1)) for r in self.residuals])

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection error of all views."""
        return rms(np.linalg.norm(np.concatenate(self.residuals), axis=1))


def adjust_lens(
    lens: Lens, views: Sequence[BoardView], robust: bool = False, aspect_sigma: float = SQUARE_SIGMA
) -> AdjustedLens:
    """Adjust from `lens` by Levenberg-Marquardt; with `robust`, under the Cauchy loss.

    Args:
        lens: the start.
        views: of the board.
        robust: whether corners may be wrong.
        aspect_sigma: prior standard deviation of fx / fy.

    Raises:
        ValueError: the board can't be located in a view with this lens.
    """
    state, prior = _State(lens, _locate_all(lens, views)), LensPrior.of(lens, aspect_sigma)
    damping, residuals = 1e-3, _residuals(state, views)
    for _ in range(MAX_ITERATIONS):
        distances = np.linalg.norm(np.concatenate(residuals), axis=1)
        scale = CAUCHY_SCALE * max(coordinate_sigma(distances), 1e-6) if robust else np.inf
        normal = _linearize(state, views, prior, scale)
        before = after = _cost(residuals, scale) + prior.cost(state.lens)
        while damping < MAX_DAMPING:
            trial = state.moved(*normal.solve(damping))
            trial_residuals = _residuals(trial, views)
            if (after := _cost(trial_residuals, scale) + prior.cost(trial.lens)) <= before:
                state, residuals, damping = trial, trial_residuals, max(damping / 10, 1e-9)
                break
            damping *= 10
        if not before - after > 1e-9 * before + 1e-15:
            break
    return AdjustedLens(state.lens, state.poses, residuals, _covariance(state, views, prior, residuals))


def held_out_rms(lens: Lens, views: Sequence[BoardView]) -> float:
    """RMS reprojection error, pixels, of views that a lens was not adjusted to: only the board's poses are adjusted."""
    known = [view for view in views if locate_board(lens, view) is not None]
    if not known:
        return float("inf")
    state, prior = _State(lens, _locate_all(lens, known)), LensPrior.of(lens, ANY_SIGMA)
    still = np.zeros(len(lens.parameters))
    for _ in range(STEPS):
        normal = _linearize(state, known, prior, np.inf)
        steps = np.linalg.solve(normal.H_vv, normal.g_v[:, :, None])[:, :, 0]
        state = state.moved(still, np.asarray(steps, float))
    squares = np.concatenate([(r**2).sum(axis=1) for r in _residuals(state, known)])
    return float(np.sqrt(np.nan_to_num(squares, nan=BAD_PX**2).mean()))


def _locate_all(lens: Lens, views: Sequence[BoardView]) -> Array:
    poses = [pose for view in views if (pose := locate_board(lens, view)) is not None]
    if len(poses) < len(views):
        raise ValueError("the board can't be located in a view with this lens")
    return np.array(poses)


def choose_focal_length(lens: Lens, views: Sequence[BoardView]) -> Lens:
    """The lens with the focal length, out of a fixed list, that fits the views best without distortion."""
    size = max(lens.width, lens.height)
    candidates = [lens.with_parameters([k * size, k * size, *lens.parameters[2:]]) for k in FOCAL_STARTS]
    return min(candidates, key=lambda lens: float(np.median([_misfit_px(lens, view) for view in views])))


def locate_board(lens: Lens, view: BoardView) -> Array | None:
    """T_cam_board (4, 4) of one view (Collins and Bartoli 2014, in OpenCV); None if the lens can't have seen it."""
    xy = lens.normalise(view.pixels)
    known = np.isfinite(xy).all(axis=1)
    if known.sum() < 4:
        return None
    try:
        ok, rotation, translation = cv2.solvePnP(
            view.corners[known].astype(float), xy[known], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # collinear corners
        return None
    T = motion_from(rotation, translation)
    return T if ok and (view.corners @ T[2, :3] + T[2, 3] > 0).all() else None


def _misfit_px(lens: Lens, view: BoardView) -> float:
    if (T := locate_board(lens, view)) is None:
        return BAD_PX
    residuals = view.pixels - lens.project(view.corners @ T[:3, :3].T + T[:3, 3])
    return float(np.nan_to_num(np.sqrt((residuals**2).sum(axis=1).mean()), nan=BAD_PX))


@dataclass(frozen=True, slots=True)
class _State:
    lens: Lens
    poses: Array

    def moved(self, lens_step: Array, pose_steps: Array) -> "_State":
        """The state after a step (P,) of the parameters and (V, 6) of the poses, in the camera's frame.

        A focal length shrinks to half at most.
        """
        parameters = self.lens.parameters + lens_step
        parameters[:2] = np.maximum(parameters[:2], self.lens.parameters[:2] / 2)
        lens = self.lens.with_parameters(parameters)
        poses = self.poses.copy()
        for T, xi in zip(poses, pose_steps, strict=True):
            R = rotation_from_vector(xi[:3])
            T[:3, :3], T[:3, 3] = R @ T[:3, :3], T[:3, 3] + xi[3:]
        return _State(lens, poses)


@dataclass(frozen=True, slots=True)
class _NormalEquations:
    """Blocks of lens l and views v: H_ll (P, P), H_lv (V, P, 6), H_vv (V, 6, 6), g_l (P,), g_v (V, 6)."""

    H_ll: Array
    H_lv: Array
    H_vv: Array
    g_l: Array
    g_v: Array

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Steps (P,) of the lens and (V, 6) of the poses, with diagonals multiplied by 1 + damping."""
        H_vv = self.H_vv * (1 + damping * np.eye(6))
        K = self.H_lv @ np.linalg.inv(H_vv)
        S = self.H_ll * (1 + damping * np.eye(len(self.g_l))) - (K @ np.swapaxes(self.H_lv, 1, 2)).sum(axis=0)
        lens_step = np.linalg.lstsq(S, self.g_l - np.einsum("vpi,vi->p", K, self.g_v))[0]
        rest = self.g_v - np.einsum("vpi,p->vi", self.H_lv, lens_step)
        return lens_step, np.linalg.solve(H_vv, rest[:, :, None])[:, :, 0]

    def lens_information(self) -> Array:
        """(P, P) information of the lens with the poses marginalized, for corners of 1 px."""
        K = self.H_lv @ np.linalg.inv(self.H_vv)
        return self.H_ll - (K @ np.swapaxes(self.H_lv, 1, 2)).sum(axis=0)


def _linearize(state: _State, views: Sequence[BoardView], prior: LensPrior, scale: float) -> _NormalEquations:
    H_ll, blocks = prior.information, []
    g_l = prior.information @ (prior.mean - state.lens.parameters)
    for view, T in zip(views, state.poses, strict=True):
        rotated = view.corners @ T[:3, :3].T
        uv, J_point, J_l = state.lens.project_with_jacobians(rotated + T[:3, 3])
        # dp = w x (R X) + t for a rotation w about the board's origin and a translation t.
        J_v = np.concatenate([np.cross(rotated[:, None, :], J_point), J_point], axis=2)
        r = view.pixels - uv
        w = cauchy_weights(np.linalg.norm(r, axis=1), scale)
        wJ_l, wJ_v = w[:, None, None] * J_l, w[:, None, None] * J_v
        H_ll = H_ll + np.einsum("nij,nik->jk", wJ_l, J_l)
        g_l = g_l + np.einsum("nij,ni->j", wJ_l, r)
        terms = ("nij,nik->jk", wJ_l, J_v), ("nij,nik->jk", wJ_v, J_v), ("nij,ni->j", wJ_v, r)
        blocks.append([np.einsum(*term) for term in terms])
    H_lv, H_vv, g_v = (np.array(part) for part in zip(*blocks, strict=True))
    return _NormalEquations(H_ll, H_lv, H_vv, g_l, g_v)


def _residuals(state: _State, views: Sequence[BoardView]) -> list[Array]:
    """(n, 2) for each view, observed less predicted pixels; NaN for a corner that is not in front of the camera."""
    return [
        view.pixels - state.lens.project(view.corners @ T[:3, :3].T + T[:3, 3])
        for view, T in zip(views, state.poses, strict=True)
    ]


def _cost(residuals: Sequence[Array], scale: float) -> float:
    """Sum over all corners, square pixels; NaN, which is never below another cost, with a corner behind the camera."""
    squares = np.concatenate([(r**2).sum(axis=1) for r in residuals])
    return cauchy_cost(squares, scale)


def _covariance(state: _State, views: Sequence[BoardView], prior: LensPrior, residuals: list[Array]) -> Array:
    """(P, P) of the lens's parameters, scaled by the variance of the residuals."""
    information = _linearize(state, views, prior, np.inf).lens_information()
    freedom = sum(r.size for r in residuals) - len(state.lens.parameters) - 6 * len(views)
    variance = sum(float((r**2).sum()) for r in residuals) / max(freedom, 1)
    # Parameters differ by orders of magnitude: the matrix is inverted with a unit diagonal.
    sigma = np.sqrt(np.diag(information))
    covariance = variance * np.linalg.pinv(information / np.outer(sigma, sigma), hermitian=True)
    return covariance / np.outer(sigma, sigma)
