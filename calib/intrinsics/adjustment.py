# SPDX-License-Identifier: BSD-3-Clause
"""The least squares problem of one lens and the poses in which a board stood before it (Zhang 2000, section 3).

Works for every model that `camera_node.geometry.lens` knows: it asks the lens for its derivatives. Poses are eliminated
view by view (the Schur complement of bundle adjustment), so the cost grows with the number of views, not with its cube.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import rotation_from_vector

CAUCHY = 2.3849  # 95 % efficient on normal residuals
MAX_ITERATIONS = 100
# What lenses are like before any picture, 1 sigma; it decides only what the pictures leave open.
CORNER_SIGMA_PX = 0.2  # to which a corner is found: what pictures and priors are weighed by
TERM_SIGMA = 0.2  # of each distortion term at the image's corner, as a part of its distance from the middle
SKEW_SIGMA = 0.02  # the same of the tangential terms
PIXEL_SIGMA = 0.003  # of fx / fy from 1
MIDDLE_SIGMA = 0.05  # of the principal point from the image's middle, as a part of the longer side
FOCAL_STARTS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5, 2.5, 4.0)  # of the image's longer side


@dataclass(frozen=True, slots=True)
class BoardView:
    """Corners of the board in one picture: (n, 2) pixels and (n, 3) metres on the board, and the picture's name."""

    pixels: NDArray[np.float32]
    corners: NDArray[np.float32]
    name: str = ""

    @property
    def area(self) -> Array:
        """(n^2, 2) pixels all over the part of the image that the board takes up: the middles of all pairs."""
        return ((self.pixels[:, None] + self.pixels[None]) / 2).reshape(-1, 2).astype(float)


@dataclass(frozen=True, slots=True)
class Prior:
    """Normal prior of `Lens.parameters`: mean (P,) and information (P, P), scaled to corners of 1 px."""

    mean: Array
    information: Array

    @classmethod
    def of(cls, lens: Lens) -> "Prior":
        """The prior of lenses with about the focal length of `lens`."""
        size = max(lens.width, lens.height)
        mean = np.array([0, 0, (lens.width - 1) / 2, (lens.height - 1) / 2, *[0.0] * len(lens.distortion)])
        corner = np.hypot(lens.width, lens.height) / 2 / lens.fx
        weights = np.zeros(len(mean))
        weights[2:4] = (MIDDLE_SIGMA * size) ** -2
        tangential = lens.model == "pinhole"
        powers = [2, 4, 1, 1, 6] if tangential else [2, 4, 6, 8]
        sigmas = [SKEW_SIGMA if p == 1 else TERM_SIGMA for p in powers]
        terms = np.array(sigmas) / corner ** np.array(powers)
        weights[4 : 4 + len(terms)] = (terms**-2)[: len(lens.distortion)]
        square = np.zeros(len(mean))
        square[:2] = 1 / (PIXEL_SIGMA * lens.fx), -1 / (PIXEL_SIGMA * lens.fx)
        return cls(mean, CORNER_SIGMA_PX**2 * (np.diag(weights) + np.outer(square, square)))

    def cost(self, lens: Lens) -> float:
        """Squared Mahalanobis distance of a lens from it."""
        off = lens.parameters - self.mean
        return float(off @ self.information @ off)


@dataclass(frozen=True, slots=True)
class AdjustedLens:
    """A lens, T_cam_board (V, 4, 4) of its views, and what the views say of it.

    Attributes:
        residuals: seen less expected, pixels, (n, 2) a view.
        covariance: (4 + D, 4 + D) of `Lens.parameters`.
    """

    lens: Lens
    poses: Array
    residuals: list[Array]
    covariance: Array

    @property
    def view_rms_px(self) -> Array:
        """(V,) root mean square distance of seen from expected corners."""
        return np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in self.residuals])

    @property
    def rms_px(self) -> float:
        """The same over all views."""
        return float(np.sqrt(np.mean(np.concatenate([(r**2).sum(axis=1) for r in self.residuals]))))


def adjust_lens(lens: Lens, views: Sequence[BoardView], robust: bool = False) -> AdjustedLens:
    """Levenberg-Marquardt from `lens`; with `robust`, corners that are far off count less (Cauchy's weights).

    Raises:
        ValueError: a view has no pose before this lens.
    """
    state, prior = _State(lens, _locate_all(lens, views)), Prior.of(lens)
    damping, residuals = 1e-3, _residuals(state, views)
    for _ in range(MAX_ITERATIONS):
        scale = CAUCHY * _spread(residuals) if robust else np.inf
        normal = _linearise(state, views, prior, scale)
        before = after = _cost(residuals, scale) + prior.cost(state.lens)
        while damping < 1e10:
            trial = state.moved(*normal.solve(damping))
            moved = _residuals(trial, views)
            if (after := _cost(moved, scale) + prior.cost(trial.lens)) <= before:
                state, residuals, damping = trial, moved, max(damping / 10, 1e-9)
                break
            damping *= 10
        if not before - after > 1e-9 * before + 1e-15:
            break
    return _finish(state, views, prior, residuals)


def _locate_all(lens: Lens, views: Sequence[BoardView]) -> Array:
    poses = [pose for view in views if (pose := locate(lens, view)) is not None]
    if len(poses) < len(views):
        raise ValueError("a view has no pose before this lens")
    return np.array(poses)


def start_lens(lens: Lens, views: Sequence[BoardView]) -> Lens:
    """The lens with the focal length, of several, that explains the views best without distortion."""
    size = max(lens.width, lens.height)
    starts = [replace_focal(lens, k * size) for k in FOCAL_STARTS]
    return min(starts, key=lambda start: float(np.median([_misfit(start, view) for view in views])))


def replace_focal(lens: Lens, focal_px: float) -> Lens:
    """The lens with both focal lengths set, pixels."""
    return lens.with_parameters([focal_px, focal_px, *lens.parameters[2:]])


def locate(lens: Lens, view: BoardView) -> Array | None:
    """T_cam_board (4, 4) of one view (Collins and Bartoli 2014, in OpenCV); None where the lens can't have seen it."""
    xy = lens.normalise(view.pixels)
    known = np.isfinite(xy).all(axis=1)
    if known.sum() < 4:
        return None
    try:
        ok, turn, shift = cv2.solvePnP(
            view.corners[known].astype(float), xy[known], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # corners on one line
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector(np.ravel(turn)), np.ravel(shift)
    return T if ok and (view.corners @ T[2, :3] + T[2, 3] > 0).all() else None


def _misfit(lens: Lens, view: BoardView) -> float:
    if (T := locate(lens, view)) is None:
        return 1e6
    miss = view.pixels - lens.project(view.corners @ T[:3, :3].T + T[:3, 3])
    return float(np.nan_to_num(np.sqrt((miss**2).sum(axis=1).mean()), nan=1e6))


@dataclass(frozen=True, slots=True)
class _State:
    lens: Lens
    poses: Array

    def moved(self, by_lens: Array, by_poses: Array) -> "_State":
        """After a step: parameters, where no focal length shrinks to less than half; poses in the camera's frame."""
        parameters = self.lens.parameters + by_lens
        parameters[:2] = np.maximum(parameters[:2], self.lens.parameters[:2] / 2)
        lens = self.lens.with_parameters(parameters)
        poses = self.poses.copy()
        for T, xi in zip(poses, by_poses, strict=True):
            R = rotation_from_vector(xi[:3])
            T[:3, :3], T[:3, 3] = R @ T[:3, :3], T[:3, 3] + xi[3:]
        return _State(lens, poses)


@dataclass(frozen=True, slots=True)
class _Normal:
    """Normal equations, poses apart: H_ll (P, P), H_lv (V, P, 6), H_vv (V, 6, 6), g_l (P,), g_v (V, 6)."""

    H_ll: Array
    H_lv: Array
    H_vv: Array
    g_l: Array
    g_v: Array

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Steps (P,) of the lens and (V, 6) of the poses, diagonals grown by `damping`."""
        H_vv = self.H_vv * (1 + damping * np.eye(6))
        K = self.H_lv @ np.linalg.inv(H_vv)
        S = self.H_ll * (1 + damping * np.eye(len(self.g_l))) - (K @ np.swapaxes(self.H_lv, 1, 2)).sum(axis=0)
        by_lens = np.linalg.lstsq(S, self.g_l - np.einsum("vpi,vi->p", K, self.g_v))[0]
        rest = self.g_v - np.einsum("vpi,p->vi", self.H_lv, by_lens)
        return by_lens, np.linalg.solve(H_vv, rest[:, :, None])[:, :, 0]

    def lens_information(self) -> Array:
        """(P, P) of the lens alone, poses marginalised, for corners of 1 px."""
        K = self.H_lv @ np.linalg.inv(self.H_vv)
        return self.H_ll - (K @ np.swapaxes(self.H_lv, 1, 2)).sum(axis=0)


def _linearise(state: _State, views: Sequence[BoardView], prior: Prior, scale: float) -> _Normal:
    H_ll, rest = prior.information, []
    g_l = prior.information @ (prior.mean - state.lens.parameters)
    for view, T in zip(views, state.poses, strict=True):
        turned = view.corners @ T[:3, :3].T
        uv, J_point, J_l = state.lens.project_with_jacobians(turned + T[:3, 3])
        # dp = w x (R X) + t for a turn w about the board's own place and a shift t.
        J_v = np.concatenate([np.cross(turned[:, None, :], J_point), J_point], axis=2)
        r = view.pixels - uv
        w = 1 / (1 + (np.linalg.norm(r, axis=1) / scale) ** 2)
        wJ_l, wJ_v = w[:, None, None] * J_l, w[:, None, None] * J_v
        H_ll = H_ll + np.einsum("nij,nik->jk", wJ_l, J_l)
        g_l = g_l + np.einsum("nij,ni->j", wJ_l, r)
        parts = ("nij,nik->jk", wJ_l, J_v), ("nij,nik->jk", wJ_v, J_v), ("nij,ni->j", wJ_v, r)
        rest.append([np.einsum(*part) for part in parts])
    H_lv, H_vv, g_v = (np.array(part) for part in zip(*rest, strict=True))
    return _Normal(H_ll, H_lv, H_vv, g_l, g_v)


def _residuals(state: _State, views: Sequence[BoardView]) -> list[Array]:
    """Seen less expected pixels, (n, 2) a view; NaN for a corner that is not before the camera."""
    return [
        view.pixels - state.lens.project(view.corners @ T[:3, :3].T + T[:3, 3])
        for view, T in zip(views, state.poses, strict=True)
    ]


def _cost(residuals: Sequence[Array], scale: float) -> float:
    """Sum over all corners, square pixels; NaN, which is below nothing, where one is not before the camera."""
    squares = np.concatenate([(r**2).sum(axis=1) for r in residuals])
    return float(squares.sum() if np.isinf(scale) else (scale**2 * np.log1p(squares / scale**2)).sum())


def _spread(residuals: Sequence[Array]) -> float:
    """Robust standard deviation of one coordinate, pixels: the median of a Rayleigh distribution is 1.1774 of it."""
    return max(float(np.median(np.linalg.norm(np.concatenate(residuals), axis=1))) / 1.1774, 1e-6)


def _finish(state: _State, views: Sequence[BoardView], prior: Prior, residuals: list[Array]) -> AdjustedLens:
    information = _linearise(state, views, prior, np.inf).lens_information()
    free = sum(r.size for r in residuals) - len(state.lens.parameters) - 6 * len(views)
    variance = sum(float((r**2).sum()) for r in residuals) / max(free, 1)
    # Parameters differ by orders of magnitude: scaled to 1, the matrix has an inverse.
    sigma = np.sqrt(np.diag(information))
    covariance = variance * np.linalg.pinv(information / np.outer(sigma, sigma), hermitian=True)
    return AdjustedLens(state.lens, state.poses, residuals, covariance / np.outer(sigma, sigma))
