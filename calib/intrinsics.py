# SPDX-License-Identifier: BSD-3-Clause
"""From views of a board to a lens (Zhang 2000, as OpenCV implements it)."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.board import BoardFinder
from calib.camera import Camera
from calib.errors import CalibrationError
from calib.rig import Rig
from camera_node.errors import CameraError
from camera_node.pixels import Grey
from camera_node.source import read_grey

Array = NDArray[np.float64]

IMAGES = (".png", ".jpg", ".jpeg")
VIDEOS = (".mp4", ".avi", ".mkv", ".mov")
MIN_VIEWS = 8
MAX_VIEWS = 60  # more make it slow, not better
MIN_TURN_DEG = 10.0  # that views must differ by: parallel views leave the focal length open
GRID = (5, 4)  # cells of the image in which corners are counted


@dataclass(frozen=True, slots=True)
class CalibratedLens:
    """A calibrated lens: the camera, views used and offered, RMS reprojection error, and the share of the image's
    cells in which corners were seen."""

    camera: Camera
    views: int
    frames: int
    rms_px: float
    coverage: float


@dataclass(frozen=True, slots=True)
class BoardView:
    """Corners of the board in one frame: (n, 2) pixels and (n, 3) metres on the board."""

    pixels: NDArray[np.float32]
    corners: NDArray[np.float32]


def find_cameras(path: Path, camera: str | None) -> dict[str, Path]:
    """Where each camera's frames are: `<path>/<camera>/`, a folder of images, or videos named like cameras.

    Raises:
        CameraError: nothing is there, or the camera of the frames has no name.
    """
    if path.is_file():
        return {camera or path.stem: path}
    if not path.is_dir():
        raise CameraError(f"{path} does not exist; give a folder of frames, or a video")
    entries = sorted(path.iterdir())
    if any(entry.suffix.lower() in IMAGES for entry in entries):
        return {camera or path.name: path}
    found = {e.name: e for e in entries if e.is_dir()}
    found |= {e.stem: e for e in entries if e.suffix.lower() in VIDEOS}
    if camera is not None:
        found = {name: entry for name, entry in found.items() if name == camera}
    if not found:
        raise CameraError(
            f"{path} holds no frames{f' of {camera}' if camera else ''}; give {path}/<camera>/*.png"
        )
    return found


def read_frames(path: Path) -> Iterator[Grey]:
    """The grey images of a folder or a video.

    Raises:
        CameraError: the folder holds no images, or the file is no video.
    """
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGES)
        if not files:
            raise CameraError(f"{path} holds no PNG or JPEG images")
        yield from map(read_grey, files)
        return
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise CameraError(f"{path} is no video that OpenCV reads")
    while (image := video.read()[1]) is not None:
        yield cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
    video.release()


def calibrate_lens(name: str, frames: Iterable[Grey], finder: BoardFinder) -> CalibratedLens:
    """The lens of camera `name` from frames of a board.

    Raises:
        CalibrationError: too few views, views that can't fix a lens, or frames of different sizes.
    """
    views, size, count = [], None, 0
    for image in frames:
        count += 1
        if size is not None and size != image.shape[::-1]:
            raise CalibrationError(f"camera '{name}' has frames of different sizes; keep one size")
        size = image.shape[::-1]
        if found := finder.find(image):
            views.append(BoardView(*found))
    if size is None or len(views) < MIN_VIEWS:
        raise CalibrationError(
            f"camera '{name}': the board is in {len(views)} of {count} frames, {MIN_VIEWS} are needed; does --board "
            "match the print? Show it at several tilts, near and far, and in every corner of the image"
        )
    return _solve(name, views, (int(size[0]), int(size[1])), count)


def _solve(name: str, views: list[BoardView], size: tuple[int, int], count: int) -> CalibratedLens:
    chosen = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, MAX_VIEWS).astype(int))]
    try:
        rms, K, distortion, turns = _zhang(chosen, size)
        errors = np.array([_error(view, K, distortion) for view in chosen])
        # Views in motion blur stand out from the rest: leave them out, once.
        kept = [v for v, e in zip(chosen, errors, strict=True) if e <= 3 * np.median(errors)]
        rms, K, distortion, turns = _zhang(kept, size)
    except cv2.error:
        raise CalibrationError(f"camera '{name}': {_ADVICE}") from None
    spread = _largest_turn_deg(turns)
    if spread < MIN_TURN_DEG or not (0.2 < K[0, 0] / max(size) < 20) or not np.isfinite(distortion).all():
        raise CalibrationError(f"camera '{name}': the views differ by {spread:.0f} degrees; {_ADVICE}")
    camera = Camera(
        width=size[0],
        height=size[1],
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        distortion=tuple(float(x) for x in distortion),
    )
    return CalibratedLens(camera, len(kept), count, rms, _coverage(kept, size))


_ADVICE = "views of the board that are all parallel can't fix a lens; tilt it by 30 degrees to all sides"


def _zhang(views: Sequence[BoardView], size: tuple[int, int]) -> tuple[float, Array, Array, list[Array]]:
    corners, pixels = [view.corners for view in views], [view.pixels for view in views]
    rms, K, distortion, turns, _ = cv2.calibrateCamera(corners, pixels, size, np.eye(3), np.zeros(5))
    return (
        float(rms),
        np.asarray(K, float),
        np.ravel(distortion)[:5].astype(float),
        [np.ravel(t).astype(float) for t in turns],
    )


def _error(view: BoardView, K: Array, distortion: Array) -> float:
    _, turn, shift = cv2.solvePnP(view.corners, view.pixels, K, distortion)
    seen = cv2.projectPoints(view.corners, turn, shift, K, distortion)[0].reshape(-1, 2)
    return float(np.sqrt(((seen - view.pixels) ** 2).sum(axis=1).mean()))


def _largest_turn_deg(turns: Sequence[Array]) -> float:
    """The largest angle between the board's normals in any two views."""
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))


def _coverage(views: Sequence[BoardView], size: tuple[int, int]) -> float:
    pixels = np.concatenate([view.pixels for view in views])
    counts = np.histogram2d(pixels[:, 0], pixels[:, 1], GRID, [[0, size[0]], [0, size[1]]])[0]
    return float((counts > 0).mean())


def merge(rig: Rig | None, lenses: dict[str, CalibratedLens]) -> Rig:
    """The rig with new lenses; a camera's pose belongs to the lens that it was found with and goes."""
    cameras = dict(rig.cameras) if rig else {}
    cameras |= {name: lens.camera for name, lens in lenses.items()}
    return msgspec.structs.replace(rig or Rig(cameras={}), cameras=cameras)
