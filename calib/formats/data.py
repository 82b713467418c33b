# SPDX-License-Identifier: BSD-3-Clause
"""What the formats of other programs contain: cameras, and points that these cameras saw in numbered frames."""

import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.rig.estimation import STEPS
from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.config import write_table
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import Pose, invert, rotation_from_vector, skew

MAX_FILE_BYTES = 1 << 28  # of a table of points: an hour of 16 cameras at 60 Hz takes a fifth of it
GRID = 25  # points across and down the image
MAX_OFF_PX = 1.0  # a lens that differs more is another lens


@dataclass(frozen=True, slots=True)
class PixelOrigin:
    """Where a format counts pixels from.

    Attributes:
        first: the coordinates of the centre of the corner pixel, 0 or 1.
        y_up: whether y is counted from the lowest row upwards.
    """

    first: int
    y_up: bool = False

    def read(self, uv: Array, height: int | None = None) -> Array:
        """(n, 2) pixels with the centre of the top-left pixel at (0, 0), from pixels of this convention.

        Raises:
            CalibrationError: y is counted upwards, and no height is given.
        """
        return self._flip(np.asarray(uv, float) - self.first, height)

    def write(self, uv: Array, height: int | None = None) -> Array:
        """(n, 2) pixels of this convention, from pixels with the centre of the top-left pixel at (0, 0)."""
        return self._flip(np.asarray(uv, float), height) + self.first

    def _flip(self, uv: Array, height: int | None) -> Array:
        if not self.y_up:
            return uv
        if height is None:
            raise CalibrationError(
                "y is counted from the lowest row, so the height of the images is needed: give the camera profile too"
            )
        return np.column_stack([uv[:, 0], height - 1 - uv[:, 1]])

    def matrix(self, height: int) -> Array:
        """(3, 3) the change of homogeneous pixels into this convention."""
        corners = self.write(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), height)
        M = np.eye(3)
        M[:2, 2], M[:2, :2] = corners[0], (corners[1:] - corners[0]).T
        return M

    def require_opencv(self, program: str) -> None:
        """Raise CalibrationError if this is not OpenCV's convention, which is also that of a program."""
        if self != OPENCV:
            raise CalibrationError(
                f"{program} counts pixels from the top left, as OpenCV; leave out --first-pixel and --y-up"
            )


OPENCV = PixelOrigin(0)


@dataclass(frozen=True, slots=True)
class PointTable:
    """Points, one row each.

    Attributes:
        camera: (n,) names of the cameras.
        frame: (n,) numbers of the frames; frames of equal number are simultaneous unless `t_s` says otherwise.
        marker: (n,) numbers of the points, from 0.
        uv: (n, 2) raw pixels, the centre of the top-left pixel is (0, 0).
        t_s: (n,) time of each frame, seconds; None if the format has none.
    """

    camera: list[str]
    frame: Index
    marker: Index
    uv: Array
    t_s: Array | None = None

    def __len__(self) -> int:
        return len(self.uv)

    def write(self, path: Path) -> None:
        """Write `observations.csv`, with times or with numbers of frames.

        Raises:
            ConfigError: the file can't be written.
        """
        time, when = "frame", self.frame
        if self.t_s is not None:
            time, when = "t_ns", np.round((self.t_s - min(self.t_s.min(), 0)) * 1e9).astype(np.int64)
        u, v = ([f"{pixels:.4f}" for pixels in column] for column in self.uv.T)
        rows = zip(when.tolist(), self.camera, u, v, self.marker.tolist(), strict=True)
        write_table(path, f"{time},camera,u,v,marker", rows)


@dataclass(frozen=True, slots=True)
class ForeignData:
    """What was read from files of another program: cameras by name, points, the body that these points belong to where
    its shape is known, and remarks for the user."""

    cameras: dict[str, Camera] = field(default_factory=dict)
    points: PointTable | None = None
    wand: WandBody | None = None
    remarks: tuple[str, ...] = ()


def make_camera(
    size: Iterable[float],
    focal: Iterable[float],
    centre: Iterable[float],
    distortion: Iterable[float] = (),
    fisheye: bool = False,
    T_cam_world: Array | None = None,
    time_offset_ms: float = 0.0,
) -> Camera:
    """A camera, from width and height, fx and fy, and cx and cy, pixels, and a pose (4, 4) if it has one.

    Raises:
        CalibrationError: a value is impossible.
    """
    try:
        camera = Camera(
            **dict(zip(("width", "height"), map(int, size), strict=True)),
            **dict(zip(("fx", "fy", "cx", "cy"), map(float, (*focal, *centre)), strict=True)),
            distortion=tuple(map(float, distortion)),
            model="fisheye" if fisheye else "pinhole",
            T_world_cam=None if T_cam_world is None else Pose.from_matrix(invert(T_cam_world)),
            time_offset_ms=time_offset_ms,
        )
        msgspec.convert(msgspec.to_builtins(camera), Camera)  # the types too
    except (ValueError, TypeError, OverflowError) as error:
        raise CalibrationError(str(error)) from None
    return camera


def read_text(path: Path) -> str:
    """The text of a regular file of limited size.

    Raises:
        ConfigError: it is missing, too large, or not text.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{path} is not a regular file")
            data = file.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ConfigError(f"{path} has more than {MAX_FILE_BYTES} bytes; is it the right file?")
        return data.decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror}; check the path") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path} is not a text file; check the path and --format") from None


def read_numbers(path: Path) -> list[list[float]]:
    """The rows of numbers of a text file; `nan` is a number, lines that start with # or % are comments.

    Raises:
        ConfigError: the file can't be read, or a line has something else than numbers.
    """
    rows, table = [], str.maketrans(",;\t", "   ")
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.translate(table).split()
        if not words or words[0].startswith(("#", "%")):
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            raise ConfigError(f"{path}, line {number}: '{line[:60]}' is not a row of numbers") from None
    return rows


def with_coefficients(name: str, lens: Lens, count: int) -> tuple[Lens, float]:
    """The lens with `count` distortion coefficients that is nearest to a lens over its image.

    Focal length, centre and coefficients are adjusted by Gauss-Newton to the viewing rays of a grid of pixels.

    Returns:
        the lens, and the largest distance between both lenses' pixels of one ray.

    Raises:
        CalibrationError: they differ by more than 1 px.
    """
    coefficients = (*lens.distortion, *[0.0] * count)
    shorter = lens.with_parameters([*lens.parameters[:4], *coefficients[:count]])
    if not any(coefficients[count:]):
        return shorter, 0.0
    pixels = _grid_pixels(lens)
    rays = lens.rays(pixels)
    known = np.isfinite(rays).all(axis=1)
    shorter, _, off = _fit_lens(shorter, rays[known], pixels[known], turned=False)
    if not off <= MAX_OFF_PX:
        raise CalibrationError(
            f"camera '{name}': its lens can't be written with {count} distortion coefficients, as this format has; "
            f"it would be off by {off:.1f} px"
        )
    return shorter, off


def place_by_projection(lens: Camera, P: Array, where: str) -> tuple[Camera, float]:
    """The camera of a projection matrix that maps the world to undistorted pixels of a lens.

    The calibration matrix of the projection is often another one than that of the lens, because the other program
    adjusted it after the distortion was removed. Lens and rotation are adjusted to the viewing rays of both together.

    Args:
        lens: the lens that was used to remove the distortion.
        P: (3, 4) projection matrix of any scale and sign.
        where: what the errors name.

    Returns:
        the camera, and the largest distance between the pixels of one ray by it and by the two files, pixels.

    Raises:
        CalibrationError: the matrix is not that of a camera at a finite place.
    """
    K, R, centre = _decompose(P, where)
    pixels = _grid_pixels(lens)
    xy = lens.normalise(pixels)
    known = np.isfinite(xy).all(axis=1)
    undistorted = np.column_stack([xy[known], np.ones(known.sum())]) @ lens.K.T
    rays, pixels = undistorted @ np.linalg.inv(K).T, pixels[known]
    if not known.any() or not (rays[:, 2] > 0).all():
        raise CalibrationError(f"{where}: the lens has no undistorted image; check its distortion")
    fitted = lens.with_parameters([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.distortion])
    try:
        fitted, turn, off = _fit_lens(fitted, rays, pixels, turned=True)
    except (ValueError, np.linalg.LinAlgError):
        raise CalibrationError(
            f"{where}: no lens has these viewing rays; check the files of this camera"
        ) from None
    T = np.eye(4)
    T[:3, :3] = turn @ R
    T[:3, 3] = -T[:3, :3] @ centre
    f, centre, shape = fitted.parameters[:2], fitted.parameters[2:4], fitted.distortion
    return make_camera((lens.width, lens.height), f, centre, shape, T_cam_world=T), off


def _grid_pixels(lens: Lens) -> Array:
    """(n, 2) pixels all over an image."""
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, GRID), np.linspace(0, lens.height - 1, GRID))
    return np.column_stack([u.ravel(), v.ravel()])


def _fit_lens(lens: Lens, rays: Array, pixels: Array, turned: bool) -> tuple[Lens, Array, float]:
    """A lens, and with `turned` a rotation (3, 3) of viewing rays (n, 3), adjusted to pixels (n, 2) by Gauss-Newton;
    and the largest distance, pixels."""
    turn = np.eye(3)
    for _ in range(STEPS):
        uv, J_point, J_lens = lens.project_with_jacobians(rays @ turn.T)
        by_turn = -J_point @ skew(rays @ turn.T) if turned else np.zeros((len(rays), 2, 3))
        J = np.concatenate([J_lens, by_turn], axis=2).reshape(-1, J_lens.shape[2] + 3)
        step = np.linalg.lstsq(J, (pixels - uv).ravel())[0]
        lens = lens.with_parameters(lens.parameters + step[:-3])
        turn = rotation_from_vector(step[-3:]) @ turn
    return lens, turn, float(np.linalg.norm(pixels - lens.project(rays @ turn.T), axis=1).max())


def _decompose(P: Array, where: str) -> tuple[Array, Array, Array]:
    """The calibration matrix, the rotation from the world to the camera, and the camera's centre (3,), of a projection
    matrix (3, 4) of any scale and sign."""
    sides = np.linalg.norm(P[:, :3], axis=1) if np.isfinite(P).all() else np.zeros(3)
    if not sides.all() or abs(np.linalg.det(P[:, :3])) < 1e-9 * sides.prod():
        raise CalibrationError(f"{where} has no projection of a camera at a finite place")
    K, R, centre = cv2.decomposeProjectionMatrix(P * np.sign(np.linalg.det(P[:, :3])))[:3]
    signs = np.diag(np.sign(np.diag(K)))  # RQ decomposition is unique up to the signs of the diagonal
    return K @ signs / abs(K[2, 2]), signs @ R, (centre[:3] / centre[3]).ravel()
