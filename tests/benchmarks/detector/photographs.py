# SPDX-License-Identifier: BSD-3-Clause
"""Photographs without roundels: shared ones, frames of shared videos, and those that installed packages contain.

For more, `apt-get install --no-install-recommends mate-backgrounds ukui-wallpapers lomiri-wallpapers-16.04
lomiri-wallpapers-20.04`: `views` uses the photographs in `/usr/share/backgrounds`.
"""

import importlib.util
from collections import Counter
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from camera_node.sources.recorded_frames import read_grey
from tests.benchmarks.detector.pictures import Grey

ABOVE = [folder / "shared" / "data" for folder in Path(__file__).resolve().parents[4:]]
SHARED = next((folder for folder in ABOVE if folder.exists()), ABOVE[0])
LENGTH = 960  # pixels: images of packages are scaled to this length and to half of it
PACKAGES = {  # folders of photographs in installed packages
    "skimage": "data/*",
    "gtsam": "Data/Balbianello/*.jpg",
    "matplotlib": "mpl-data/sample_data/grace_hopper.jpg",
    "viser": "_assets/hdri/*.jpg",
}
BACKGROUNDS = Path("/usr/share/backgrounds")
SCALES = (2.0, 1.0, 0.5, 0.25)  # of windows
WINDOW = (480, 640)
VIDEO_FRAMES = 12  # of a video, at equal intervals
DRAWN = ("color.png", "phantom.png", "logo.png", "horse.png", "chessboard_GRAY.png", "chessboard_RGB.png")


def photographs(n: int) -> Iterator[Grey]:
    """Up to `n` photographs, as far as they are available."""
    yield from (read_grey(path) for path in _shared())
    shipped = list(_shipped())
    for image in shipped:
        yield from (_scaled(image, length) for length in (LENGTH, LENGTH // 2))
    videos = sorted((SHARED / "webcams").glob("cam_*.mp4"))
    for video in videos:
        yield from _frames(video, (n - 2 * len(shipped)) // len(videos))


def views(counts: Counter[str]) -> Iterator[Grey]:
    """Windows of all photographs at four scales; those of one scale do not overlap. Counts photographs and windows."""
    for image in _distinct():
        counts["photographs"] += 1
        for scale in SCALES:
            scaled = _scaled(image, round(scale * max(image.shape)))
            rows, columns = (n // side for n, side in zip(scaled.shape, WINDOW, strict=True))
            for j, i in product(range(rows), range(columns)):
                counts["windows"] += 1
                v, u = j * WINDOW[0], i * WINDOW[1]
                yield np.ascontiguousarray(scaled[v : v + WINDOW[0], u : u + WINDOW[1]])


def _distinct() -> Iterator[Grey]:
    yield from (read_grey(path) for path in sorted(BACKGROUNDS.rglob("*.jpg")))
    yield from (read_grey(path) for path in _shared())
    yield from _shipped()
    for video in sorted((SHARED / "webcams").glob("cam_*.mp4")):
        yield from _frames(video, VIDEO_FRAMES)


def _shared() -> list[Path]:
    files = [SHARED / "photos" / name for name in ("cctag_01.png", "monocam_Test_Image.jpg")]
    return [path for path in files if path.exists()]


def _shipped() -> Iterator[Grey]:
    for package, pattern in PACKAGES.items():
        found = importlib.util.find_spec(package)
        if found is None or found.origin is None:
            continue
        for path in sorted(Path(found.origin).parent.glob(pattern)):
            if path.suffix in (".png", ".jpg", ".jpeg", ".tif") and path.name not in DRAWN:
                image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
                if image is not None:
                    yield image.astype(np.uint8)


def _scaled(image: Grey, length: int) -> Grey:
    scale = length / max(image.shape)
    return cv2.resize(
        image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    ).astype(np.uint8)


def _frames(video: Path, n: int) -> Iterator[Grey]:
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    every = max(1, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) // max(1, n))
    for k in range(n * every):
        if not capture.grab():
            break
        if k % every == 0:
            yield cv2.cvtColor(capture.retrieve()[1], cv2.COLOR_BGR2GRAY).astype(np.uint8)
    capture.release()
