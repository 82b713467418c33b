# SPDX-License-Identifier: BSD-3-Clause
"""The responses of robots to errors of their cameras, and the claims that follow, against their definitions."""

import numpy as np
import pytest

from calib.rig.camera_errors import ERRORS
from camera_node.geometry.pose import rotation_from_vector
from fusion import _core
from fusion.model.states import predict
from tests.fusion.native.scene import ARRAY, scene

BODIES, DT = 5, 0.03


def test_a_step_of_the_response_is_that_of_its_equations():
    """S <- E F S - P sum w A^T B and D <- E F D F^T E^T + P (sum s w A^T A) P, with the derivatives B by the cameras
    that are compared with GTSAM; the focal length displaces the undistorted image in proportion."""
    states, observations = scene()
    n, d, rng = len(states), ERRORS * len(ARRAY.names), np.random.default_rng(3)
    seen, discs = observations.detections, observations.discs
    none = np.zeros(n, bool)
    before, motion = predict(states, np.full(n, DT), np.ones((n, 2)), none)
    information, P = _core.inverses(before.P), states.P
    poses = ARRAY.frame_poses(states, seen.exposures)
    equations = poses.linearize_centres(discs.columns, seen.xy, observations.whiten, none)
    weights, share = rng.uniform(0.2, 1.0, len(seen)), rng.uniform(0.0, 1.0, len(seen))
    S, root = rng.normal(size=(n, 12, d)), rng.normal(size=(n, 12, 12))
    D = root @ root.transpose(0, 2, 1)
    camera = seen.exposures.camera
    responses, counted = blocks(S), D.copy()
    _core.respond(
        poses, camera, equations, weights, share, seen.frame, discs.body,
        seen.xy, observations.whiten, information, P, motion.T, motion.dt, responses, counted,
    )  # fmt: skip
    B = poses.differentiate_by_camera(discs.columns, observations.whiten, seen.xy)
    F = motion.multiply(np.tile(np.eye(12), (n, 1, 1)))
    for b in range(n):
        mine = np.flatnonzero(discs.body == b)
        E = P[b] @ information[b] if len(mine) else np.eye(12)
        G, W = np.zeros((12, d)), np.zeros((12, 12))
        for k in mine:
            A, first = equations[k, :, :12], ERRORS * camera[seen.frame[k]]
            by_camera = np.where(np.arange(ERRORS) == 6, 0.0, B[k])  # clocks are noise of the detections
            G[:, first : first + ERRORS] += weights[k] * A.T @ by_camera
            W += weights[k] * share[k] * A.T @ A
        expected = E @ F[b] @ S[b] - P[b] @ G, E @ F[b] @ D[b] @ F[b].T @ E.T + P[b] @ W @ P[b]
        got = np.concatenate(responses[b], axis=1), counted[b]
        for found, right in zip(got, expected, strict=True):
            assert found == pytest.approx(right, rel=1e-6, abs=1e-6 * np.abs(right).max())


def blocks(S: np.ndarray) -> np.ndarray:
    """(B, C, 12, 8) of responses (B, 12, 8 C)."""
    return np.ascontiguousarray(S.reshape(len(S), 12, -1, ERRORS).swapaxes(1, 2))


def test_a_claim_has_the_covariance_of_the_cameras_in_place_of_what_was_counted():
    """And that of the body's own frame."""
    rng, d = np.random.default_rng(4), 3 * ERRORS
    P, counted, S = (rng.normal(size=(BODIES, 12, m)) for m in (12, 12, d))
    P, counted = P + P.transpose(0, 2, 1), counted + counted.transpose(0, 2, 1)
    L = np.tril(rng.normal(size=(d, d)))
    L[ERRORS:, :ERRORS] = 0.0  # of cameras that are independent of the first
    R, frame = rotation_from_vector(rng.normal(size=(BODIES, 3))), rng.normal(size=(BODIES, 6, 6))
    frame, turn = frame + frame.transpose(0, 2, 1), np.zeros((BODIES, 12, 6))
    turn[:, :3, :3], turn[:, 3:6, 3:] = np.eye(3), R
    S[:, :, :ERRORS] = 0.0  # of a camera that has never seen the bodies
    expected = P - counted + S @ L @ L.T @ S.transpose(0, 2, 1) + turn @ frame @ turn.transpose(0, 2, 1)
    assert _core.consider(P, counted, blocks(S), L, R, frame) == pytest.approx(expected, rel=1e-9, abs=1e-9)
