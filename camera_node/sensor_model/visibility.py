# SPDX-License-Identifier: BSD-3-Clause
"""Which roundels a camera detects: the operational space through any lens, with slant, blur and motion."""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.lens import Lens
from camera_node.sensor_model import threshold
from camera_node.sensor_model.imaging import Imaging
from camera_node.sensor_model.operational_space import Pattern

OUTLINE_POINTS = 16
DEFAULT_IMAGING = Imaging()


@dataclass(frozen=True, slots=True, eq=False)
class ImageOfDiscs:
    """The images of N discs. Values are NaN for discs that are not in front of the camera.

    Attributes:
        uv: (N, 2) images of the centres, raw pixels.
        axes_px: (N, 2) full major and minor axis of the outer ellipse, with the lens as affine over the disc.
        slant_rad: (N,) angle between the normal and the line of sight; above pi/2 the printed side is not visible.
        motion_px: (N,) motion of the centre during the exposure.
    """

    uv: Array
    axes_px: Array
    slant_rad: Array
    motion_px: Array


def project_discs(
    lens: Lens, d_o: float, position_m: Array, normal: Array, motion_m: Array | None = None
) -> ImageOfDiscs:
    """Project discs of diameter d_o, metres.

    Args:
        lens: the camera, with any distortion.
        d_o: outer diameter, metres.
        position_m, normal: (N, 3) centres, and normals out of the printed side, camera frame.
        motion_m: (N, 3) motion during the exposure relative to the camera; none unless given.
    """
    position, n = np.atleast_2d(position_m).astype(float), np.atleast_2d(normal).astype(float)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    line = position / np.linalg.norm(position, axis=1, keepdims=True)
    uv, J = lens.project_with_jacobian(position)
    across = J @ (np.eye(3) - n[:, :, None] * n[:, None])  # displacements in the disc's plane only
    S = across @ across.mT * (d_o / 2) ** 2
    mean, half = (S[:, 0, 0] + S[:, 1, 1]) / 2, (S[:, 0, 0] - S[:, 1, 1]) / 2
    spread = np.hypot(half, S[:, 0, 1])
    axes = 2 * np.sqrt(np.maximum(np.stack([mean + spread, mean - spread], axis=1), 0.0))
    motion = np.zeros(len(uv))
    if motion_m is not None:
        motion = np.linalg.norm((J @ np.atleast_2d(motion_m)[..., None])[..., 0], axis=1)
    slant = np.arccos(np.clip(-(n * line).sum(axis=1), -1, 1))
    return ImageOfDiscs(uv, axes, slant, motion)


def outlines(lens: Lens, diameter_m: float, position_m: Array, normal: Array) -> Array:
    """(N, OUTLINE_POINTS, 2) raw pixels of the circles of `diameter_m` around positions (N, 3), exactly projected."""
    position, n = np.atleast_2d(position_m).astype(float), np.atleast_2d(normal).astype(float)
    aside = np.where(
        np.abs(n[:, :1]) < 0.9 * np.linalg.norm(n, axis=1, keepdims=True), [[1.0, 0, 0]], [[0, 1.0, 0]]
    )
    e1 = np.cross(n, aside)
    e2 = np.cross(n, e1)
    e1, e2 = (e / np.linalg.norm(e, axis=1, keepdims=True) for e in (e1, e2))
    angle = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)[:, None]
    points = position[:, None] + diameter_m / 2 * (np.cos(angle) * e1[:, None] + np.sin(angle) * e2[:, None])
    return lens.project(points.reshape(-1, 3)).reshape(len(position), OUTLINE_POINTS, 2)


def is_in_image(lens: Lens, diameter_m: float, position_m: Array, normal: Array) -> Mask:
    """(N,) whether circles of `diameter_m` around positions (N, 3) with normals (N, 3) are completely in the image.

    Points outside of the lens's view count as outside of the image even where its polynomial projects them into it.
    """
    uv = outlines(lens, diameter_m, position_m, normal)
    inside = (uv >= -0.5) & (uv < [lens.width - 0.5, lens.height - 0.5])
    return inside.all(axis=(1, 2)) & lens_sees(lens, position_m)


def lens_sees(lens: Lens, points: Array) -> Mask:
    """(N,) whether points (N, 3), camera frame, lie within the angle from the axis that the image's corners reach.

    A distortion polynomial projects points far beyond that angle into the image again.
    """
    return within_reach(np.atleast_2d(points), reach(lens))


def reach(lens: Lens) -> float:
    """The tangent of the angle from the axis that the image's corners reach."""
    u, v = (np.linspace(-0.5, n - 0.5, 9) for n in (lens.width, lens.height))
    frame = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = lens.normalise(frame)
    return float(np.linalg.norm(xy[np.isfinite(xy).all(axis=1)], axis=1).max(initial=0.0))


def within_reach(points: Array, tangent: float | Array) -> Mask:
    """(..., N) whether points (..., N, 3) lie within an angle from the axis, by its tangent, which is not exact."""
    radius = np.linalg.norm(points[..., :2], axis=-1)
    return (points[..., 2] > 0) & (radius <= 1.02 * tangent * points[..., 2])


def is_detected(
    lens: Lens,
    pattern: Pattern,
    position_m: Array,
    normal: Array,
    imaging: Imaging = DEFAULT_IMAGING,
    velocity_mps: Array | None = None,
) -> Mask:
    """Predict which roundels our detector finds in a new image.

    At most a tenth of the disc's diameter is beyond the image's border, its printed side is visible, its axes are large
    enough for its slant and the blur, and it moves by no more than three quarters of its diameter during the exposure.
    Nothing occludes it, and the ground around its card has no more contrast than the print.

    Args:
        lens: the camera.
        pattern: the print.
        position_m, normal: (N, 3) centres, and normals out of the printed side, camera frame.
        imaging: blur, contrast and exposure.
        velocity_mps: (N, 3) velocities relative to the camera, camera frame; none unless given.

    Returns:
        (N,) whether each roundel is detected.
    """
    motion_m = None if velocity_mps is None else np.atleast_2d(velocity_mps) * imaging.exposure_s
    image = project_discs(lens, pattern.d_o, position_m, normal, motion_m)
    needed = (1 - 2 * threshold.CUT_SHARE) * pattern.d_o
    visible = (image.slant_rad < np.pi / 2) & is_in_image(lens, needed, position_m, normal)
    return visible & is_large_enough(image, imaging)


def is_large_enough(
    image: ImageOfDiscs, imaging: Imaging = DEFAULT_IMAGING, share: float = threshold.NEARLY_ALL
) -> Mask:
    """(N,) whether the detector finds at least a share of the roundels of these axes, slants and motions."""
    major, minor = image.axes_px.T
    with np.errstate(invalid="ignore"):
        apparent = np.arccos(np.clip(minor / major, 0, 1))
        smallest = threshold.smallest_major_px(apparent, imaging, share)
        moves = image.motion_px > threshold.MOVING_SHARE * minor
        smallest = np.where(moves, np.maximum(smallest, threshold.MOVING_PX), smallest)
        fits = (major >= np.maximum(smallest, threshold.MIN_DIAMETER_PX)) & (
            major <= threshold.MAX_DIAMETER_PX
        )
        slow = image.motion_px <= threshold.LONGEST_SHARE * major
    return fits & slow & (imaging.contrast >= threshold.MIN_CONTRAST)


def detection_range(
    lens: Lens, pattern: Pattern, phi: float = 0.0, imaging: Imaging = DEFAULT_IMAGING
) -> tuple[float, float]:
    """v_min and v_max along the optical axis for our detector, metres; (nan, nan) where it finds none at any distance.

    Args:
        lens: the camera.
        pattern: the print.
        phi: rotation of the pattern about the image's vertical axis, radians.
        imaging: blur and contrast; the pattern does not move.
    """
    normal = np.array([np.sin(phi), 0.0, -np.cos(phi)])
    # Steps of 3 % from an image of the disc that is ten images large to one of a hundredth of a pixel.
    first = pattern.d_o * min(lens.fx, lens.fy) / (10 * max(lens.width, lens.height))
    x = np.asarray(first * 1.03 ** np.arange(500), float)
    v_min = v_max = float("nan")
    for _ in range(3):
        found = is_detected(lens, pattern, _on_axis(x), np.tile(normal, (len(x), 1)), imaging)
        if not found.any():
            break
        low, high = np.flatnonzero(found)[[0, -1]]
        v_min, v_max = float(x[low]), float(x[high])
        nearer, farther = x[max(low - 1, 0)], x[min(high + 1, len(x) - 1)]
        x = np.asarray([*np.linspace(nearer, v_min, 40), *np.linspace(v_max, farther, 40)], float)
    return v_min, v_max


def _on_axis(x: Array) -> Array:
    return np.column_stack([np.zeros((len(x), 2)), x])
