# SPDX-License-Identifier: BSD-3-Clause
"""A stand-in for picamera2: the part of its documented interface that the driver uses, for machines without libcamera.

It follows picamera2 0.3.25: `CompletedRequest`, `MappedArray`, `capture_request(wait=False)` with `wait(job, timeout)`,
`sensor_modes`, `camera_controls` as (least, greatest, default). The metadata have the keys and types that an IMX219 of
a Raspberry Pi 4 reports in mode 1640 x 1232. Frames come as fast as they are asked for, while buffers are free.
"""

import time
from concurrent.futures import Future
from typing import Any, ClassVar

import numpy as np

CAMERAS = [
    {"Model": "imx219", "Location": 2, "Rotation": 180, "Id": "/base/soc/i2c0mux/i2c@1/imx219@10", "Num": 0},
    {"Model": "ov9281", "Location": 2, "Rotation": 0, "Id": "/base/soc/i2c0mux/i2c@0/ov9281@60", "Num": 1},
    {"Model": "HD Webcam", "Id": "/base/scb/pcie@7d500000/usb@0,0-1.3:1.0-046d:0825", "Num": 2},
]
MODES = [
    {"format": "SRGGB10_CSI2P", "unpacked": "SRGGB10", "bit_depth": 10, "size": (640, 480), "fps": 206.65}
    | {"crop_limits": (1000, 752, 1280, 960), "exposure_limits": (75, 11766829, None)},
    {"format": "SRGGB10_CSI2P", "unpacked": "SRGGB10", "bit_depth": 10, "size": (1640, 1232), "fps": 41.85}
    | {"crop_limits": (0, 0, 3280, 2464), "exposure_limits": (75, 11766829, None)},
]
METADATA = {
    "ExposureTime": 9981,
    "AnalogueGain": 2.0,
    "DigitalGain": 1.0,
    "FrameDuration": 33322,
    "ScalerCrop": (0, 206, 3280, 2050),
    "SensorBlackLevels": (4096, 4096, 4096, 4096),
    "FocusFoM": 1213,
    "AeLocked": True,
    "ColourTemperature": 3947,
    "Lux": 121.3,
}
STRIDE_STEP = 64  # bytes to which rows are padded


class CompletedRequest:
    """One frame; its buffer is written again after `release`."""

    def __init__(self, camera: "Picamera2", metadata: dict[str, Any]) -> None:
        self.config = camera.camera_configuration()
        self.released = 0
        self._metadata = metadata
        height, stride = self.config["main"]["size"][1], self.config["main"]["stride"]
        self.buffer = np.full((height * 3 // 2, stride), 90, np.uint8)

    def get_metadata(self) -> dict[str, Any]:
        return dict(self._metadata)

    def release(self) -> None:
        self.released += 1
        self.buffer[:] = 0


class MappedArray:
    def __init__(
        self, request: CompletedRequest, stream: str, reshape: bool = True, write: bool = True
    ) -> None:
        assert (stream, reshape, write) == ("main", True, False)
        self._request = request
        self.array: np.ndarray | None = None

    def __enter__(self) -> "MappedArray":
        self.array = self._request.buffer
        return self

    def __exit__(self, exc_type: Any, exc_value: Any, exc_traceback: Any) -> None:
        self.array = None


class Picamera2:
    """`opened` has all instances; `is_silent` makes a camera deliver nothing, as a cable that was pulled."""

    opened: ClassVar[list["Picamera2"]] = []

    def __init__(self, camera_num: int = 0) -> None:
        if any(camera.number == camera_num and not camera.is_closed for camera in self.opened):
            raise RuntimeError("Failed to acquire camera: Device or resource busy")
        self.number = camera_num
        self.is_closed = self.is_started = self.is_silent = False
        self.requests: list[CompletedRequest] = []
        self.set: dict[str, Any] = {}
        self._configuration: dict[str, Any] = {}
        self.opened.append(self)

    @staticmethod
    def global_camera_info() -> list[dict[str, Any]]:
        return [dict(info) for info in CAMERAS]

    @property
    def camera_properties(self) -> dict[str, Any]:
        return {"Model": CAMERAS[self.number]["Model"], "PixelArraySize": (3280, 2464)}

    @property
    def sensor_modes(self) -> list[dict[str, Any]]:
        assert not self._configuration, "the modes can't be read after the configuration"
        return [dict(mode) for mode in MODES]

    @property
    def camera_controls(self) -> dict[str, tuple[Any, Any, Any]]:
        return {
            "AeEnable": (False, True, True),
            "ExposureTime": (75, 11766829, 20000),
            "AnalogueGain": (1.0, 10.666, 1.0),
            "Sharpness": (0.0, 16.0, 1.0),
            "NoiseReductionMode": (0, 4, 0),
            "ColourGains": ((0.0, 0.0), (32.0, 32.0), None),
            "SyncMode": (0, 2, 0),
        }

    def create_video_configuration(self, **options: Any) -> dict[str, Any]:
        assert set(options) == {"main", "controls", "buffer_count", "queue"}
        return options

    def configure(self, configuration: dict[str, Any]) -> None:
        width, height = configuration["main"]["size"]
        stride = -(-width // STRIDE_STEP) * STRIDE_STEP
        main = {"format": configuration["main"]["format"], "size": (width, height), "stride": stride}
        sensor = {"output_size": MODES[1]["size"], "bit_depth": 10}
        self._configuration = {"main": main, "sensor": sensor}
        self._buffers = configuration["buffer_count"]
        self.set |= configuration["controls"]

    def camera_configuration(self) -> dict[str, Any]:
        return self._configuration

    def start(self) -> None:
        self.is_started = True

    def set_controls(self, controls: dict[str, Any]) -> None:
        self.set |= controls

    def capture_request(self, wait: bool | None = None) -> Future:
        assert self.is_started
        assert wait is False
        job: Future = Future()
        if not self.is_silent and sum(not request.released for request in self.requests) < self._buffers:
            stamp = {"SensorTimestamp": time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 20_000_000}
            self.requests.append(CompletedRequest(self, METADATA | stamp))
            job.set_result(self.requests[-1])
        return job

    def wait(self, job: Future, timeout: float | None = None) -> CompletedRequest:
        return job.result(timeout)

    def close(self) -> None:
        self.is_closed = True
