# SPDX-License-Identifier: BSD-3-Clause
"""The observation model in NumPy, as the oracle of the native core.

Arrays store columns: (3, N) for N vectors. `fusion/native/disc_view.hpp` names the source of the equations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.pose import rotation_from_vector
from fusion.model.observations import (
    CameraArray,
    DetectionTable,
    Discs,
    Exposures,
    MatchedObservations,
    Views,
)
from fusion.model.states import (
    OMEGA,
    POSITION,
    THETA,
    VELOCITY,
    States,
    Transition,
)

NEAR_M = 1e-3
CAUCHY, NOMINAL_WEIGHT, CONVERGED = 4.0, 0.8983, 0.1
STEP = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Every body in every frame, column f * n_bodies + b: its pose in the camera frame, and its rotation in the world.

    `R_cam` and `R_world` (3, 3, K), `t_cam` (3, K).
    """

    n_bodies: int
    R_cam: Array
    t_cam: Array
    R_world: Array

    def columns(self, discs: Discs) -> Index:
        """(N,) the column of each disc."""
        return discs.frame * self.n_bodies + discs.body


def pose(cameras: CameraArray, states: States, exposures: Exposures) -> Poses:
    """Bodies at the capture time of each frame."""
    tau, R_cw, B = exposures.tau[:, None], cameras.R_cam_world[exposures.camera], len(states)
    R, v, omega = states.R.transpose(1, 2, 0), states.v.T, states.omega.T
    vectors = np.moveaxis(omega[:, None] * tau, 0, -1)
    turn = np.moveaxis(rotation_from_vector(vectors), (-2, -1), (0, 1))  # (3, 3, F, B)
    R_world = (
        turn[:, 0, None] * R[0, :, None] + turn[:, 1, None] * R[1, :, None] + turn[:, 2, None] * R[2, :, None]
    )
    to = states.p.T[:, None] + v[:, None] * tau - cameras.centres[exposures.camera].T[:, :, None]
    # One product for each camera: (F, 3, 3) of (F, 3, 3 B) and (F, 3, B).
    R_cam = R_cw @ R_world.transpose(2, 0, 1, 3).reshape(-1, 3, 3 * B)
    t_cam = R_cw @ to.transpose(1, 0, 2)
    return Poses(
        B,
        R_cam.reshape(-1, 3, 3, B).transpose(1, 2, 0, 3).reshape(3, 3, -1),
        t_cam.transpose(1, 0, 2).reshape(3, -1),
        R_world.reshape(3, 3, -1),
    )


def view(poses: Poses, discs: Discs) -> Views:
    """See `Views`."""
    at = poses.columns(discs)
    R = _take(poses.R_cam, at)
    c = _take(poses.t_cam, at) + np.einsum("ijn,jn->in", R, discs.position)
    n = np.einsum("ijn,jn->in", R, discs.normal)
    q = n * (n[2] * discs.radius**2 / c[2])
    q[2] -= discs.radius**2 / c[2]
    q += c
    z = np.where(c[2] > NEAR_M, q[2], np.nan)
    return Views(c, n, q, q[:2] / z)


def derive(
    cameras: CameraArray, poses: Poses, exposures: Exposures, discs: Discs, views: Views, whiten: Array
) -> Array:
    """(2, 12, N) derivatives of the outline's centre, times `whiten` (2, 2, N), by the error of the body.

    The derivatives by the velocities are tau times those by the pose.
    """
    at, tau = poses.columns(discs), exposures.tau[discs.frame]
    by_centre, by_normal = _by_disc(views, discs.radius, whiten)
    R = _take(poses.R_cam, at)
    h, k = np.einsum("ain,ijn->ajn", by_centre, R), np.einsum("ain,ijn->ajn", by_normal, R)
    J = np.empty((2, 12, len(at)))
    J[:, THETA] = np.cross(discs.position, h, axisb=1, axisa=0, axisc=1)  # h (w x m) = (m x h) w
    J[:, THETA] += np.cross(discs.normal, k, axisb=1, axisa=0, axisc=1)
    R_cw = _take(_rotations(cameras.R_cam_world), exposures.camera[discs.frame])
    J[:, POSITION] = np.einsum("ain,ijn->ajn", by_centre, R_cw)
    J[:, OMEGA] = tau * np.einsum("ain,jin->ajn", J[:, THETA], _take(poses.R_world, at))
    J[:, VELOCITY] = tau * J[:, POSITION]
    return J


def _by_disc(views: Views, radius: Array, whiten: Array) -> tuple[Array, Array]:
    """Derivatives (2, 3, N) of the whitened outline's centre by the disc's centre and by its normal, camera frame.

    dq/dc = I - s/c_z e_z^T, dq/dn = r^2/c_z (n e_z^T + n_z I) with s = r^2/c_z (n_z n - e_z) = q - c.
    """
    g = np.empty((2, 3, len(radius)))
    g[:, :2] = whiten / views.q[2]
    g[:, 2] = -(g[:, 0] * views.xy[0] + g[:, 1] * views.xy[1])
    size = radius**2 / views.centre[2]
    by_normal = (size * views.normal[2]) * g
    by_normal[:, 2] += size * np.einsum("ain,in->an", g, views.normal)
    by_centre = g.copy()
    by_centre[:, 2] -= np.einsum("ain,in->an", g, views.q - views.centre) / views.centre[2]
    return by_centre, by_normal


def outlines(centre: Array, normal: Array, radius: Array, scale: Array) -> Array:
    """(N, 2, 2) shape matrices of discs' outlines in raw pixels; a circle of radius a has a^2 I.

    `centre` and `normal` (3, N) are in the camera frame; `scale` (2, 2, N) is the Jacobian of raw pixels by xy at the
    disc. The lens is taken as affine over the disc.
    """
    dual = centre[:, None] * centre - radius**2 * (np.eye(3)[:, :, None] - normal[:, None] * normal)
    dual = dual / dual[2, 2]
    shape = dual[:2, None, 2] * dual[None, :2, 2] - dual[:2, :2]
    return np.einsum("ian,abn,jbn->nij", scale, shape, scale)


def measured_outlines(axes_px: Array, angle_rad: Array) -> Array:
    """(N, 2, 2) shape matrices of ellipses with full axes (2, N) and the direction of the major axis (N,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    U = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return U @ (U.transpose(0, 2, 1) * (axes_px.T[:, :, None] / 2) ** 2)


def shears(measured: Array, expected: Array) -> Array:
    """(2, N) shears of outlines (N, 2, 2), where the expected ones are unit circles; 0 for similar outlines.

    The two components that do not change the area, divided by the size. Each has the variance 4 (sigma_axis / axis)^2.
    """
    l00 = np.sqrt(expected[:, 0, 0])  # L^-1 M L^-T, where L L^T is the expected shape
    l10 = expected[:, 1, 0] / l00
    l11 = np.sqrt(expected[:, 1, 1] - l10**2)
    a = measured[:, 0, 0] / l00**2
    b = (measured[:, 0, 1] / l00 - l10 * a) / l11
    c = (measured[:, 1, 1] - l10 * (2 * measured[:, 0, 1] / l00 - l10 * a)) / l11**2
    return np.stack([a - c, 2 * b]) / (np.sqrt(0.5) * (a + c))


def _rotations(R: Array) -> Array:
    """(..., 3, 3) -> (3, 3, K)."""
    return R.reshape(-1, 3, 3).transpose(1, 2, 0)


def _take(A: Array, columns: Index) -> Array:
    return np.take(A, columns, axis=-1)


def shape_rows(
    poses: Poses, discs: Discs, views: Views, observations: MatchedObservations, sigma: Array
) -> Array:
    """(N, 2, 13) equations of outlines, from difference quotients of their shears."""
    seen = observations.detections
    R = poses.R_cam[..., poses.columns(discs)]
    measured = measured_outlines(seen.axes_px, seen.angle_rad)
    first, second = plane_axes(discs.normal)
    across, along = np.einsum("ijn,jn->in", R, second), np.einsum("ijn,jn->in", R, first)
    turned = (views.normal, views.normal - STEP * across, views.normal + STEP * along)
    at, about_first, about_second = (
        shears(measured, outlines(views.centre, normal, discs.radius, seen.scale)) for normal in turned
    )
    rows = np.zeros((2, 13, len(discs)))
    rows[:, THETA] = ((at - about_first)[:, None] * first + (at - about_second)[:, None] * second) / STEP
    rows[:, 12] = at
    return (rows / sigma).transpose(2, 0, 1)


def plane_axes(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors (3, N) that make right-handed axes with unit normals (3, N): first, second, normal."""
    x, y = np.eye(3)[:2]
    beside = np.where(np.abs(normal[0]) < 0.7, x[:, None], y[:, None])
    second = np.cross(normal, beside, axis=0)
    second /= np.linalg.norm(second, axis=0)
    return np.asarray(np.cross(second, normal, axis=0), float), second


def reweigh(
    rows: Array, body: Index, information: Array, right: Array, weights: Array
) -> tuple[Array, Array, Array]:
    """Sums of priors and equations with Cauchy weights, updated until those of a body converge, four times at most."""
    A, b, weights = rows[:, :, :12], rows[:, :, 12], weights.copy()
    information, right = information.copy(), right.copy()
    for k in range(len(information)):
        mine = body == k
        sums = partial(_sums, A[mine], b[mine], information[k], right[k])
        weights[mine] = _converge(A[mine], b[mine], sums, weights[mine])
        information[k], right[k] = sums(weights[mine])
    return information, right, weights


def _sums(A: Array, b: Array, H: Array, g: Array, weights: Array) -> tuple[Array, Array]:
    return H + np.einsum("n,nai,naj->ij", weights, A, A), g + np.einsum("n,nai,na->i", weights, A, b)


def _converge(A: Array, b: Array, sums: Callable[[Array], tuple[Array, Array]], weights: Array) -> Array:
    for iteration in range(4 if len(A) else 0):
        rest = b - A @ np.linalg.solve(*sums(weights))
        updated = 1 / (NOMINAL_WEIGHT * (1 + np.sum(rest**2, 1) / CAUCHY**2))
        if iteration > 0 and np.abs(updated - weights).max() < CONVERGED:
            break
        weights = updated
    return weights


def candidates(
    cameras: CameraArray, states: States, seen: DetectionTable, discs: Discs, covariance: Array
) -> dict[tuple[int, int], float]:
    """Costs by disc and detection of one frame, within the gates; `covariance` (N, 3, 3) of the discs' positions."""
    views = view(pose(cameras, states, seen.exposures), discs)
    found = {}
    for i in np.flatnonzero((views.facing > 0.1) & np.isfinite(views.xy[0])):
        camera = seen.exposures.camera[discs.frame[i]]
        R, z = cameras.R_cam_world[camera], views.centre[2, i]
        J = (R[:2] - views.xy[:, i, None] * R[2]) / z
        depth = 0.05**2 + R[2] @ covariance[i] @ R[2] / z**2
        for j in np.flatnonzero(seen.frame == discs.frame[i]):
            scale = seen.scale[:, :, j]
            per_scale = np.linalg.inv(scale)
            noise = per_scale @ (seen.cov[:, :, j] + 0.7**2 * np.eye(2)) @ per_scale.T
            k, f = discs.body[i], discs.frame[i]
            R_body = rotation_from_vector(states.omega[k] * seen.exposures.tau[f]) @ states.R[k]
            velocity = states.v[k] + np.cross(states.omega[k], R_body @ discs.position[:, i])
            moved = J @ velocity * seen.exposures.tau_sigma[f]
            C = J @ covariance[i] @ J.T + noise + np.outer(moved, moved)
            off = seen.xy[:, j] - views.xy[:, i]
            d2 = off @ np.linalg.solve(C, off)
            shape = outlines(views.centre[:, [i]], views.normal[:, [i]], discs.radius[[i]], scale[..., None])
            size = np.log(seen.axes_px[0, j] / 2 / np.sqrt(np.linalg.eigvalsh(shape[0])[1]))
            if d2 < 13.8 and abs(size) <= np.log(1.35):
                cost = d2 + size**2 / depth + np.log(np.linalg.det(C) * cameras.focal[camera] ** 4 * depth)
                found[int(i), int(j)] = cost
    return found


def predict(states: States, dt: Array, densities: Array, single: Mask) -> tuple[States, Transition]:
    """See `fusion.model.states.predict`."""
    half = rotation_from_vector(states.omega * dt[:, None] / 2)
    R_half = half @ states.R
    T = np.where(single[:, None, None], 0.0, dt[:, None, None] * R_half.transpose(0, 2, 1))
    motion = Transition(T, dt)
    P = motion.multiply(motion.multiply(states.P).transpose(0, 2, 1)) + noise(dt, densities, R_half)
    for body in np.flatnonzero(
        single
    ):  # nothing is known of the rotation about the normal and of the angular velocity
        for error, variance in ((2, np.pi**2), (6, 100.0), (7, 100.0), (8, 100.0)):
            P[body, error] = P[body, :, error] = 0
            P[body, error, error] = variance
    moved = States(half @ R_half, states.p + states.v * dt[:, None], states.omega, states.v, P)
    return moved, motion


def noise(dt: Array, densities: Array, R_half: Array) -> Array:
    """(N, 12, 12) of white noise on acceleration: q [dt^3/3, dt^2/2; dt^2/2, dt]."""
    Q = np.zeros((len(dt), 12, 12))
    i = np.arange(3)
    for k, (place, rate) in enumerate(((THETA, OMEGA), (POSITION, VELOCITY))):
        q = densities[:, k]
        Q[:, place.start + i, place.start + i] = (q * dt**3 / 3)[:, None]
        Q[:, rate.start + i, rate.start + i] = (q * dt)[:, None]
        turn = R_half.transpose(0, 2, 1) if place is THETA else np.eye(3)
        Q[:, place, rate] = (q * dt**2 / 2)[:, None, None] * turn
        Q[:, rate, place] = np.swapaxes(Q[:, place, rate], 1, 2)
    return Q
