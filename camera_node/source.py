# SPDX-License-Identifier: BSD-3-Clause
"""Where frames come from."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.errors import CameraError

Grey = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Frame:
    """One image: grey (h, w) uint8; `t_ns` is the middle of its exposure on this machine's Unix clock."""

    image: Grey
    t_ns: int
    exposure_us: float = 0.0


class Source(Protocol):
    """A camera, a file or a simulation. Iterating ends where the source ends; a live camera's never does."""

    def __iter__(self) -> Iterator[Frame]: ...

    def close(self) -> None: ...


class FolderSource:
    """A folder of frames `<t_ns>.png|jpg` in the order of their times."""

    def __init__(self, folder: Path) -> None:
        """Raises CameraError where the folder is missing, or holds no frames named by their capture time."""
        if not folder.is_dir():
            raise CameraError(f"{folder} is no folder; frames are expected as {folder}/<t_ns>.png or .jpg")
        files = [path for path in folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg")]
        if bad := [path.name for path in files if not path.stem.isdigit()]:
            raise CameraError(
                f"{folder / min(bad)} is not named by its capture time in nanoseconds, as <t_ns>.png"
            )
        if not files:
            raise CameraError(f"{folder} holds no frames; they are expected as {folder}/<t_ns>.png or .jpg")
        self.files = sorted(files, key=lambda path: int(path.stem))

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Frame]:
        return (Frame(read_grey(path), int(path.stem)) for path in self.files)

    def close(self) -> None:
        pass


def read_grey(path: Path) -> Grey:
    """The grey image (h, w) uint8 of a file.

    Raises:
        CameraError: the file is missing or is no image.
    """
    if not path.is_file():
        raise CameraError(f"{path} does not exist; check the path")
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE) if path.stat().st_size else None
    if image is None:
        raise CameraError(f"{path} is no image that OpenCV reads; give a PNG or JPEG file")
    return np.ascontiguousarray(image, np.uint8)
