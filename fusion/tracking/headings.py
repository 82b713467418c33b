# SPDX-License-Identifier: BSD-3-Clause
"""Headings by codes: where the zero of a code is seen on the outline of its disc, expected and measured.

A disc of radius r around c with normal n (camera frame) has its zero at c + r z. The outline's shape S and centre e
follow from its dual conic, and the angle of S^(-1/2) (x - e) is what detectors measure (`Roundels.rotation_rad`).
"""

import numpy as np

from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.outline import half_axes_of
from camera_node.geometry.pose import rotation_from_vector
from fusion.model.observations import CameraArray, DetectionTable, Discs, MatchedObservations
from fusion.model.states import States

STEP = 1e-4  # rad, of the difference quotients
# Of the standard deviations that detectors claim: errors of compressed pictures are alike in successive frames.
WIDENED = 2.0


def read_headings(observations: MatchedObservations) -> Mask:
    """(N,) whether a rotation was read that its robot needs."""
    if observations.discs.zero is None:
        return np.zeros(len(observations), bool)
    known = np.isfinite(observations.detections.rotation) & np.isfinite(observations.discs.zero[0])
    return known & (observations.detections.code >= 0)


def linearize_headings(cameras: CameraArray, states: States, observations: MatchedObservations) -> Array:
    """(N, 2, 13) whitened equations of the rotations of N codes, as of `_core.FramePoses`; the second ones are zero.

    The derivatives are by the rotation of the body, which determines nearly all of a heading.
    """
    seen, discs = observations.detections, observations.discs
    steps = np.concatenate([np.zeros((1, 3)), STEP * np.eye(3)])
    expected = np.array([_expected(cameras, states, seen, discs, step) for step in steps])
    weight = 1 / (WIDENED * seen.rotation_sigma)
    equations = np.zeros((len(seen), 2, 13))
    by_rotation = _wrapped(expected[1:] - expected[0]) / STEP * weight
    equations[:, 0, :3] = by_rotation.T
    R = states.R[discs.body]
    equations[:, 0, 6:9] = seen.tau[:, None] * np.einsum("nij,jn->ni", R, by_rotation)
    equations[:, 0, 12] = _wrapped(seen.rotation - expected[0]) * weight
    equations[~np.isfinite(equations[:, 0]).all(1)] = 0
    return equations


def _expected(
    cameras: CameraArray, states: States, seen: DetectionTable, discs: Discs, turned: Array
) -> Array:
    """(N,) rotations of the codes of bodies that are turned by a vector (3,) in their own frames."""
    assert discs.zero is not None
    camera, body = seen.camera, discs.body
    moved = rotation_from_vector(seen.tau[:, None] * states.omega[body])
    R = cameras.R_cam_world[camera] @ moved @ states.R[body] @ rotation_from_vector(turned)
    at = states.p[body] + seen.tau[:, None] * states.v[body] - cameras.centres[camera]
    origin = np.einsum("nij,nj->ni", cameras.R_cam_world[camera], at)
    centre = origin + np.einsum("nij,jn->ni", R, discs.position)
    normal, zero = (np.einsum("nij,jn->ni", R, v) for v in (discs.normal, discs.zero))
    return rotation_seen(centre, normal, zero, discs.radius, seen.scale)


def rotation_seen(centre: Array, normal: Array, zero: Array, radius: Array, scale: Array) -> Array:
    """(N,) angles of S^(-1/2) (x - e), raw pixels.

    Args:
        centre, normal, zero: (N, 3) of discs and unit vectors, camera frame.
        radius: (N,) metres.
        scale: (2, 2, N) Jacobians of raw pixels with respect to the undistorted plane.
    """
    rr = radius[:, None, None] ** 2
    dual = centre[:, :, None] * centre[:, None] - rr * (np.eye(3) - normal[:, :, None] * normal[:, None])
    dual /= dual[:, 2:, 2:]
    e, rim = dual[:, :2, 2], centre + radius[:, None] * zero
    to_pixels = scale.transpose(2, 0, 1)
    shape = to_pixels @ (e[:, :, None] * e[:, None] - dual[:, :2, :2]) @ to_pixels.transpose(0, 2, 1)
    offset = np.einsum("nij,nj->ni", to_pixels, rim[:, :2] / rim[:, 2:] - e)
    # S^(1/2) is S + root I up to a positive factor, and its inverse that with exchanged rows.
    root = np.sqrt(np.maximum(np.linalg.det(shape), 0))
    x = (shape[:, 1, 1] + root) * offset[:, 0] - shape[:, 0, 1] * offset[:, 1]
    y = (shape[:, 0, 0] + root) * offset[:, 1] - shape[:, 0, 1] * offset[:, 0]
    return np.arctan2(y, x)


def zeros_of(
    cameras: CameraArray, seen: DetectionTable, centre: Array, normal: Array, radius: float
) -> Array:
    """(N, 3) unit vectors, world frame, to the zero of a code in N views of a disc around `centre` with `normal` (3,).

    To first order: an image displacement is a linear map of the one in the disc's plane.
    """
    across = np.linalg.svd(normal[None])[2][1:]
    R = cameras.R_cam_world[seen.camera]
    c = np.einsum("nij,nj->ni", R, centre - cameras.centres[seen.camera])
    rim = c[:, None] + radius * np.einsum("nij,kj->nki", R, across)
    moved = rim[..., :2] / rim[..., 2:] - (c[:, :2] / c[:, 2:])[:, None]
    J = np.einsum("ijn,nkj->nik", seen.scale, moved)
    half = half_axes_of(seen.axes_px.T, seen.angle_rad)
    root = half @ (half / np.linalg.norm(half, axis=1, keepdims=True)).transpose(0, 2, 1)
    q = np.column_stack([np.cos(seen.rotation), np.sin(seen.rotation)])
    weights = np.linalg.solve(J, root @ q[:, :, None])[:, :, 0]
    zeros = weights @ across
    return zeros / np.linalg.norm(zeros, axis=1, keepdims=True)


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi
