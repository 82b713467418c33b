# SPDX-License-Identifier: BSD-3-Clause
"""What the formats of other programs contain: cameras, and points that these cameras saw in numbered frames."""

import csv
import io
import os
import stat
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import Pose, invert, rotation_from_vector, skew

MAX_FILE_BYTES = 1 << 28  # of a table of points: an hour of 16 cameras at 60 Hz takes a fifth of it
GRID = 25  # points across and down the image
STEPS = 10
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
        when = (
            self.frame
            if self.t_s is None
            else np.round((self.t_s - min(self.t_s.min(), 0)) * 1e9).astype(np.int64)
        )
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["frame" if self.t_s is None else "t_ns", "camera", "u", "v", "marker"])
        for t, camera, (u, v), marker in zip(
            when.tolist(), self.camera, self.uv, self.marker.tolist(), strict=True
        ):
            writer.writerow([t, camera, f"{u:.4f}", f"{v:.4f}", marker])
        write_atomically(path, text.getvalue())


@dataclass(frozen=True, slots=True)
class ForeignData:
    """What was read from files of another program: cameras by name, points, the body that these points belong to where
    its shape is known, and remarks for the user."""

    cameras: dict[str, Camera] = field(default_factory=dict)
    points: PointTable | None = None
    wand: WandBody | None = None
    remarks: tuple[str, ...] = ()


def make_camera(width: float, height: float, **values) -> Camera:
    """A camera of the given image size, pixels, and other fields.

    Raises:
        CalibrationError: a value is impossible.
    """
    try:
        camera = Camera(width=int(width), height=int(height), **values)
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


def read_numbers(path: Path, separators: str = ",;\t") -> list[list[float]]:
    """The rows of numbers of a text file; `nan` is a number, lines that start with # or % are comments.

    Raises:
        ConfigError: the file can't be read, or a line has something else than numbers.
    """
    rows, table = [], str.maketrans(dict.fromkeys(separators, " "))
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
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, GRID), np.linspace(0, lens.height - 1, GRID))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = lens.rays(pixels)
    known = np.isfinite(rays).all(axis=1)
    for _ in range(STEPS):
        uv, _, J = shorter.project_with_jacobians(rays[known])
        step = np.linalg.lstsq(J.reshape(-1, J.shape[2]), (pixels[known] - uv).ravel())[0]
        shorter = shorter.with_parameters(shorter.parameters + step)
    off = _largest(pixels[known] - shorter.project(rays[known]))
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
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, GRID), np.linspace(0, lens.height - 1, GRID))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    xy = lens.normalise(pixels)
    known = np.isfinite(xy).all(axis=1)
    undistorted = np.column_stack([xy[known], np.ones(known.sum())]) @ lens.K.T
    rays, pixels = undistorted @ np.linalg.inv(K).T, pixels[known]
    if not known.any() or not (rays[:, 2] > 0).all():
        raise CalibrationError(f"{where}: the lens has no undistorted image; check its distortion")
    fitted = lens.with_parameters([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.distortion])
    turn = np.eye(3)
    try:
        for _ in range(STEPS):
            uv, J_point, J_lens = fitted.project_with_jacobians(rays @ turn.T)
            J = np.concatenate([J_lens, -J_point @ skew(rays @ turn.T)], axis=2)
            step = np.linalg.lstsq(J.reshape(-1, J.shape[2]), (pixels - uv).ravel())[0]
            fitted = fitted.with_parameters(fitted.parameters + step[:-3])
            turn = rotation_from_vector(step[-3:]) @ turn
    except (ValueError, np.linalg.LinAlgError):
        raise CalibrationError(
            f"{where}: no lens has these viewing rays; check the files of this camera"
        ) from None
    T = np.eye(4)
    T[:3, :3] = turn @ R
    T[:3, 3] = -T[:3, :3] @ centre
    placed = make_camera(
        **{name: getattr(fitted, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion")},
        T_world_cam=Pose.from_matrix(invert(T)),
    )
    return placed, _largest(pixels - fitted.project(rays @ turn.T))


def _decompose(P: Array, where: str) -> tuple[Array, Array, Array]:
    """The calibration matrix, the rotation from the world to the camera, and the camera's centre (3,), of a projection
    matrix (3, 4) of any scale and sign."""
    sides = np.linalg.norm(P[:, :3], axis=1) if np.isfinite(P).all() else np.zeros(3)
    if not sides.all() or abs(np.linalg.det(P[:, :3])) < 1e-9 * sides.prod():
        raise CalibrationError(f"{where} has no projection of a camera at a finite place")
    K, R, centre = cv2.decomposeProjectionMatrix(P * np.sign(np.linalg.det(P[:, :3])))[:3]
    signs = np.diag(np.sign(np.diag(K)))  # RQ decomposition is unique up to the signs of the diagonal
    return K @ signs / abs(K[2, 2]), signs @ R, (centre[:3] / centre[3]).ravel()


def _largest(offsets: Array) -> float:
    return float(np.linalg.norm(offsets, axis=1).max())
