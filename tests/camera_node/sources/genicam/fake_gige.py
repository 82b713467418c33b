# SPDX-License-Identifier: BSD-3-Clause
"""A GigE Vision camera as a program of its own: Aravis's fake one, which sends real GVSP packets over loopback.

Its clock has an offset and a drift and can be latched (fake_gige.c). Its images are flat, or renderings of a scene;
their first eight pixels are the camera's own time stamp, little-endian nanoseconds.
"""

import ctypes
import os
import signal
import struct
import subprocess
import sys
import time
from ctypes import (
    CFUNCTYPE,
    POINTER,
    c_char_p,
    c_double,
    c_int64,
    c_size_t,
    c_ubyte,
    c_uint32,
    c_uint64,
    c_void_p,
)
from pathlib import Path

import numpy as np

from tests.conftest import ROOT
from tests.waiting import DEADLINE_S

SOURCE = Path(__file__).with_suffix(".c")
FILL = CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)
OFFSET_NS, DRIFT = 7_000_000_000_000, 40e-6


def compile_library(folder: Path) -> Path:
    """The preloaded library."""
    library = folder / "fake_gige.so"
    command = ["cc", "-O1", "-shared", "-fPIC", str(SOURCE), "-o", str(library), "-ldl"]
    subprocess.run(command, check=True, timeout=DEADLINE_S)
    return library


class FakeCamera:
    """The program, from construction until `stop`.

    Args:
        library: of `compile_library`.
        number: of the camera: its serial number and its address derive from it.
        lost: share of packets that are not sent.
        scene: a scene file, the camera in it and the Unix time of its time 0, ns; flat images without.
    """

    def __init__(
        self, library: Path, number: int, lost: float = 0.0, scene: tuple[Path, str, int] | None = None
    ) -> None:
        process = os.getpid()  # tests of other processes have cameras too, which all discoveries find
        self.serial = f"F{process}N{number}"
        self.address = f"127.{process // 250 % 250 + 1}.{process % 250 + 1}.{number}"
        self._environment = {
            **os.environ,
            "LD_PRELOAD": str(library),
            "FAKE_ADDRESS": self.address,
            "FAKE_OFFSET_NS": str(OFFSET_NS),
            "FAKE_DRIFT": str(DRIFT),
        }
        self._words = [self.serial, self.address, str(lost), *map(str, scene or ())]
        self.start()

    def start(self) -> None:
        """Start the program and wait until the camera answers."""
        command = [sys.executable, "-m", __name__, *self._words]
        self.process = subprocess.Popen(
            command, cwd=ROOT, env=self._environment, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def stop(self) -> None:
        """End the program at once, as if the camera lost its power."""
        self.process.kill()
        self.process.wait(DEADLINE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()


def stamp_in(image: np.ndarray) -> int:
    """The camera's own time stamp of an image, ns."""
    return struct.unpack("<q", image[0, :8].tobytes())[0]


def monotonic_of(device_ns: int) -> float:
    """The CLOCK_MONOTONIC, ns, at which the camera's clock read `device_ns`."""
    return (device_ns - OFFSET_NS) / (1 + DRIFT)


def _painter(scene: list[str]):
    """A function of the capture's Unix time, s, exposure, s, and shape that returns an image."""
    if not scene:
        return lambda t_s, exposure_s, shape: np.full(shape, 100, np.uint8)
    from camera_node.simulation.renderer import Renderer
    from camera_node.simulation.scene import Scene

    path, name, epoch_ns = scene
    renderer = Renderer(Scene.load(Path(path)), name)

    def paint(t_ns: int, exposure_s: float, shape: tuple[int, int]) -> np.ndarray:
        t_s = (t_ns - int(epoch_ns)) * 1e-9 + exposure_s / 2
        image = renderer.render(t_s, abs(round(t_s * 1000)))  # the number seeds the noise
        assert image.shape == shape
        return image.copy()

    return paint


def main(serial: str, address: str, lost: str, *scene: str) -> None:
    """Run the camera until the program is killed."""
    aravis = ctypes.CDLL("libaravis-0.8.so.0")
    clock = ctypes.CDLL(None).fake_clock_ns
    clock.restype = c_int64
    aravis.arv_gv_fake_camera_new.restype = c_void_p
    aravis.arv_gv_fake_camera_new.argtypes = [c_char_p, c_char_p]
    aravis.arv_gv_fake_camera_get_fake_camera.restype = c_void_p
    aravis.arv_gv_fake_camera_get_fake_camera.argtypes = [c_void_p]
    aravis.arv_gv_fake_camera_is_running.argtypes = [c_void_p]
    aravis.arv_fake_camera_set_fill_pattern.argtypes = [c_void_p, FILL, c_void_p]
    aravis.arv_buffer_get_data.restype = POINTER(c_ubyte)
    aravis.arv_buffer_get_data.argtypes = [c_void_p, POINTER(c_size_t)]
    aravis.arv_buffer_get_image_width.argtypes = aravis.arv_buffer_get_image_height.argtypes = [c_void_p]
    aravis.arv_buffer_set_timestamp.argtypes = [c_void_p, c_uint64]
    paint = _painter(list(scene))

    @FILL
    def fill(buffer: int, data: int, exposure_us: int, gain: int, pixel_format: int) -> None:
        device_ns = clock()
        aravis.arv_buffer_set_timestamp(buffer, device_ns)
        shape = (aravis.arv_buffer_get_image_height(buffer), aravis.arv_buffer_get_image_width(buffer))
        t_ns = round(monotonic_of(device_ns)) + time.time_ns() - time.monotonic_ns()
        image = paint(t_ns, exposure_us * 1e-6, shape)
        image[0, :8] = np.frombuffer(struct.pack("<q", device_ns), np.uint8)
        # The received size, which this function could return, is 0 here; the buffer holds a Mono8 image of this shape.
        ctypes.memmove(aravis.arv_buffer_get_data(buffer, None), image.ctypes.data, image.nbytes)

    gobject = ctypes.CDLL("libgobject-2.0.so.0")
    camera = aravis.arv_gv_fake_camera_new(address.encode(), serial.encode())
    assert camera
    assert aravis.arv_gv_fake_camera_is_running(camera)
    gobject.g_object_set(c_void_p(camera), b"gvsp-lost-ratio", c_double(float(lost)), None)
    aravis.arv_fake_camera_set_fill_pattern(aravis.arv_gv_fake_camera_get_fake_camera(camera), fill, None)
    print("ready", flush=True)
    signal.pause()  # until it is killed; the camera is a thread of Aravis


if __name__ == "__main__":
    main(*sys.argv[1:])
