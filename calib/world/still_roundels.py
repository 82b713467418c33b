# SPDX-License-Identifier: BSD-3-Clause
"""Finds stationary roundels in the images of cameras, and the images of their discs' own centres."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera
from camera_node.detection.disc_pose import DiscPose, locate
from camera_node.detection.roundels import Roundel, Roundels
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.outline import half_axes_of
from camera_node.protocol.messages import Detections

STILL_PX = 2.0  # radius within which a stationary roundel is detected
MIN_PRESENCE = 0.3  # fraction of a camera's frames with the roundel
ANY_DIAMETER_M = 1.0  # the image of a disc's centre is the same for all discs with the same outline


@dataclass(frozen=True, slots=True)
class StillRoundel:
    """A stationary roundel in the image of one camera.

    Attributes:
        camera: its name.
        uv: (2,) mean centre of the ellipse, raw pixels.
        name: its number, or "code 7" of a code that was read; empty without either.
        shape: (2, 2) mean of a^2 e e' + b^2 f f' for ellipses with half axes a and b along the unit vectors e and f,
            square pixels; NaN where it is unknown.
    """

    camera: str
    uv: Array
    name: str
    shape: Array


def find_still_roundels(messages: Sequence[Detections]) -> list[StillRoundel]:
    """Find the roundels that each camera detects at the same pixel, under one name or none, in 30 % of its frames or
    more."""
    frames: dict[str, list[Roundels]] = {}
    for message in messages:
        frames.setdefault(message.camera, []).append(message.unpack())
    found = []
    for camera, seen in frames.items():
        uv, names = np.concatenate([r.uv for r in seen]), np.concatenate([_names(r) for r in seen])
        shapes = np.concatenate([_shapes(r) for r in seen])
        order = np.argsort(names, kind="stable")
        for rows in np.split(order, np.flatnonzero(names[order[1:]] != names[order[:-1]]) + 1):
            for cluster in _clusters(uv[rows]):
                if len(cluster) >= max(MIN_PRESENCE * len(seen), 1):
                    chosen = rows[cluster]
                    mean, shape = uv[chosen].mean(axis=0), shapes[chosen].mean(axis=0)
                    found.append(StillRoundel(camera, mean, str(names[chosen[0]]), shape))
    return found


def _names(roundels: Roundels) -> NDArray[np.str_]:
    """(N,) names as in `StillRoundel`."""
    numbers = roundels.id.astype(str)
    with_codes = np.where(np.isfinite(roundels.id_probability), np.char.add("code ", numbers), numbers)
    return np.where(roundels.id < 0, "", with_codes)


def _shapes(roundels: Roundels) -> Array:
    """(N, 2, 2) shapes as in `StillRoundel`."""
    half_axes = half_axes_of(roundels.axes_px, roundels.angle_rad)
    return half_axes @ half_axes.mT


def _clusters(uv: Array) -> Iterator[Index]:
    """Yield the indices of pixels (N, 2) that are near each other."""
    remaining = np.ones(len(uv), bool)
    while remaining.any():
        cluster = _first_cluster(uv, remaining)
        remaining &= ~cluster
        yield np.flatnonzero(cluster)


def _first_cluster(uv: Array, remaining: Mask) -> Mask:
    """(N,) the remaining pixels (N, 2) near the first one, which is always included."""
    first = int(remaining.argmax())
    cluster = remaining & (np.linalg.norm(uv - uv[first], axis=1) < STILL_PX)
    centre = np.median(uv[cluster], axis=0)
    cluster = remaining & (np.linalg.norm(uv - centre, axis=1) < STILL_PX)
    cluster[first] = True
    return cluster


def disc_centres(cameras: Sequence[Camera], roundels: Sequence[StillRoundel]) -> Array:
    """(N, 2) images of the centre of one disc in N cameras, raw pixels.

    Perspective and distortion displace the centre of the ellipse, by 0.1 px for a disc of 20 px that is slanted by 45
    degrees: towards the camera in all views, so that the point would be too low. An ellipse has two poses, and the
    true ones are those whose normals agree in the world.

    Args:
        cameras: placed, that see the disc.
        roundels: the disc, by camera. Where fewer than two have a shape, the ellipses' centres are returned.
    """
    centres, normals, seen = np.array([r.uv for r in roundels]), [], []
    for k, (camera, roundel) in enumerate(zip(cameras, roundels, strict=True)):
        if poses := _poses(camera, roundel):
            normals.append([camera.matrix()[:3, :3] @ pose.normal for pose in poses])
            seen.append((k, [pose.centre_uv for pose in poses]))
    if len(seen) < 2:
        return centres
    n = np.array(normals)  # (views, 2, 3)
    cosines = np.einsum("vpi,qi->qvp", n, n.reshape(-1, 3))
    best = int(cosines.max(axis=2).sum(axis=1).argmax())
    for (k, uv), pose in zip(seen, cosines[best].argmax(axis=1).tolist(), strict=True):
        centres[k] = uv[pose]
    return centres


def _poses(camera: Camera, roundel: StillRoundel) -> tuple[DiscPose, DiscPose] | None:
    """Both poses of the disc; None where its shape or the inverse of the lens is unknown."""
    if not np.isfinite(roundel.shape).all():
        return None
    squares, along = np.linalg.eigh(roundel.shape)
    angle, axes = float(np.arctan2(along[1, 1], along[0, 1])), 2 * np.sqrt(np.maximum(squares[::-1], 0))
    unknown = np.full((2, 2), np.nan)
    return locate(Roundel(roundel.uv, unknown, axes, angle, np.nan, np.nan), camera, ANY_DIAMETER_M)
