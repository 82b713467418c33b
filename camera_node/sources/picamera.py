# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of a Raspberry Pi on its CSI connectors, through picamera2 and libcamera.

`SensorTimestamp` is the time, on CLOCK_BOOTTIME, at which the first row of the sensor's active area is sent, which is
the end of that row's exposure (picamera2 issue 821, and the manual's section on requests at specific times, which takes
the stamp minus the exposure time as the start). The middle row of the image is later by half the readout.
"""

import time
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import CameraAbsentError, CameraError, ConfigError
from camera_node.foundation.extras import require
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import CameraDescription, Control, Mode, check_controls
from camera_node.sources.frame import Frame, SourceSettings
from camera_node.sources.live import Capture, LiveSource

SIZE = (1280, 800)  # of the image unless given
BUFFERS = 8  # three are with the node: the waiting frame, the one in detection, and the latest for previews
SILENCE_S = 3.0
GLOBAL_SHUTTERS = ("imx296", "ov9281", "ov7251", "ov2311", "ov9782")
SYNC_MODES = {"Off": 0, "Server": 1, "Client": 2}  # libcamera's rpi::SyncMode
SYNC_MARGIN = 0.98  # of the mode's greatest rate: synchronization lengthens and shortens frames
# Sharpening and noise reduction move and widen edges; the detector fits them as the lens makes them.
PLAIN_IMAGE = {"Sharpness": 0.0, "NoiseReductionMode": 0}


@dataclass(frozen=True, slots=True)
class Readout:
    """How the rows of a sensor mode are read.

    Attributes:
        mode_us: from the first to the last row of the mode; 0 of a global shutter.
        first_row, rows: of the mode, in rows of the whole sensor.
    """

    mode_us: float
    first_row: float
    rows: float

    def of(self, metadata: Mapping[str, Any]) -> tuple[float, float]:
        """The readout of the image and its middle row's delay after the mode's first row, microseconds."""
        crop = metadata.get("ScalerCrop")
        first, rows = (crop[1], crop[3]) if crop and crop[3] > 0 else (self.first_row, self.rows)
        share = self.mode_us / self.rows
        return share * rows, share * (first + rows / 2 - self.first_row)


class PicameraCapture(Capture):
    """An open camera that delivers the Y plane of YUV420, without a copy.

    Args:
        number: of the camera, as `Picamera2(number)` takes it.
        settings, controls: are applied before it starts.

    Raises:
        CameraAbsentError: there is no such camera, or another program uses it.
        ConfigError: it does not offer a control, or picamera2 is missing.
    """

    incomplete = lost_packets = 0
    has_exposure = True

    def __init__(self, number: int, settings: SourceSettings, controls: Mapping[str, ControlValue]) -> None:
        self._module = _picamera2()
        self.name = f"picamera:{number}"
        try:
            self._camera = self._module.Picamera2(number)
        except (RuntimeError, IndexError) as error:
            reason = str(error) or type(error).__name__
            raise CameraAbsentError(
                f"{self.name} does not open ({reason}); is it connected, and used by no other program?"
            ) from None
        try:
            self._start(settings, controls)
        except RuntimeError as error:
            self._camera.close()
            raise CameraError(f"{self.name} does not start: {error}") from None
        except BaseException:
            self._camera.close()
            raise

    def read(self) -> Frame:
        """See `Capture.read`."""
        try:
            request = self._camera.wait(self._camera.capture_request(wait=False), timeout=SILENCE_S)
        except (TimeoutError, RuntimeError) as error:
            raise CameraError(f"no frame within {SILENCE_S:g} s ({error or type(error).__name__})") from None
        metadata = request.get_metadata()
        image = np.asarray(_BorrowedBuffer(request, self._module))[: self._size[1], : self._size[0]]
        return self._frame(image, metadata)

    def offered(self) -> Mapping[str, Control]:
        """See `Capture.offered`."""
        described = (_describe(name, limits) for name, limits in self._camera.camera_controls.items())
        return {control.name: control for control in described if control is not None}

    def adjust(
        self, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        """See `Capture.adjust`; a few frames pass until the sensor follows, and each frame has its own exposure."""
        self._camera.set_controls({**_exposure_controls(exposure_us, gain), **_numbered(controls)})

    def close(self) -> None:
        self._camera.close()

    def _start(self, settings: SourceSettings, controls: Mapping[str, ControlValue]) -> None:
        offered = self.offered()
        check_controls(controls, offered, self.name)
        self._size = (settings.width or SIZE[0], settings.height or SIZE[1])
        modes = list(
            self._camera.sensor_modes
        )  # reads each mode; possible before the camera is configured only
        wanted = {name: value for name, value in PLAIN_IMAGE.items() if name in offered}
        wanted |= _exposure_controls(settings.exposure_us, settings.gain) | _numbered(controls)
        if settings.fps is not None:
            wanted["FrameRate"] = settings.fps
        configuration = self._camera.create_video_configuration(
            main={"size": self._size, "format": "YUV420"}, controls=wanted, buffer_count=BUFFERS, queue=False
        )
        self._camera.configure(configuration)
        mode = self._mode(modes)
        self._check_rate(settings.fps, mode, controls)
        self._readout = self._readout_of(mode)
        self._camera.start()

    def _mode(self, modes: list[dict[str, Any]]) -> dict[str, Any]:
        """The sensor mode in use; empty if unknown."""
        sensor = self._camera.camera_configuration().get("sensor") or {}
        wanted = (sensor.get("output_size"), sensor.get("bit_depth"))
        return next((mode for mode in modes if (mode["size"], mode["bit_depth"]) == wanted), {})

    def _check_rate(
        self, fps: float | None, mode: dict[str, Any], controls: Mapping[str, ControlValue]
    ) -> None:
        limit = mode.get("fps")
        is_synchronized = _numbered(controls).get("SyncMode", 0) != 0
        if limit is None or not is_synchronized or (fps is not None and fps <= SYNC_MARGIN * limit):
            return
        raise ConfigError(
            f"{self.name}: SyncMode needs a frame rate below the {limit:g} Hz of its mode; "
            f"give --fps {int(SYNC_MARGIN * limit)} or less"
        )

    def _readout_of(self, mode: dict[str, Any]) -> Readout:
        """The readout takes nearly the whole shortest frame, because sensors pause a few rows only between frames."""
        model = str(self._camera.camera_properties.get("Model", "")).lower()
        is_global = any(name in model for name in GLOBAL_SHUTTERS)
        mode_us = 0.0 if is_global or not mode.get("fps") else 1e6 / mode["fps"]
        crop = mode.get("crop_limits") or (0, 0, *self._size)
        return Readout(mode_us, crop[1], crop[3])

    def _frame(self, image: Grey, metadata: Mapping[str, Any]) -> Frame:
        exposure_us = float(metadata.get("ExposureTime", 0.0))
        readout_us, delay_us = self._readout.of(metadata)
        end_ns = metadata.get("SensorTimestamp") or _boot_ns()
        t_ns = end_ns + unix_ahead_ns(_boot_ns) + round(1000 * (delay_us - exposure_us / 2))
        return Frame(image, t_ns, exposure_us, readout_us=readout_us)


def _boot_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class _BorrowedBuffer:
    """The memory of a request's main image, as NumPy reads it; the request is released with the last array of it."""

    def __init__(self, request: Any, module: Any) -> None:
        mapped = module.MappedArray(request, "main", write=False)
        self.__array_interface__ = mapped.__enter__().array.__array_interface__
        weakref.finalize(self, _release, mapped, request)


def _release(mapped: Any, request: Any) -> None:
    mapped.__exit__(None, None, None)
    request.release()


def open_picamera(text: str, settings: SourceSettings) -> LiveSource:
    """A source of frames of a camera by its number, or the only one; raises as `PicameraCapture`."""
    number = _find(text)["Num"]
    return LiveSource(lambda now, controls: PicameraCapture(number, now, controls), settings)


def picamera_key(text: str) -> tuple[str, str]:
    """The key of a camera, its connector, and its model; raises CameraAbsentError or ConfigError."""
    info = _find(text)
    return f"csi {info['Id']}", f"{info['Model']} (camera {info['Num']})"


def list_picamera() -> list[CameraDescription]:
    """The cameras on CSI connectors; raises ConfigError where picamera2 is missing."""
    return [_describe_camera(info) for info in _cameras()]


@cache
def local_picameras() -> tuple[str, ...]:
    """The `--source` of each camera; none without picamera2. They can't be plugged in while the machine runs."""
    try:
        return tuple(f"picamera:{info['Num']}" for info in _cameras())
    except ConfigError:
        return ()


def _picamera2() -> Any:
    return require("picamera2", "picamera", "a camera of a Raspberry Pi")


def _cameras() -> list[dict[str, Any]]:
    """Without USB cameras, which the driver v4l2 reads."""
    return [info for info in _picamera2().Picamera2.global_camera_info() if "/usb" not in info["Id"]]


def _find(text: str) -> dict[str, Any]:
    cameras = _cameras()
    matching = [info for info in cameras if not text or text in (str(info["Num"]), info["Model"], info["Id"])]
    if len(matching) == 1:
        return matching[0]
    present = ", ".join(f"picamera:{info['Num']} ({info['Model']})" for info in cameras) or "none"
    raise CameraAbsentError(
        f"{'several fit' if matching else 'no camera'} picamera:{text}; present: {present}"
    )


def _describe_camera(info: dict[str, Any]) -> CameraDescription:
    source = f"picamera:{info['Num']}"
    try:
        camera = _picamera2().Picamera2(info["Num"])
    except (RuntimeError, IndexError) as error:
        return CameraDescription("picamera", source, info["Model"], info["Id"], note=f"in use? {error}")
    try:
        modes = tuple(_mode_of(m) for m in camera.sensor_modes)
        controls = (_describe(name, limits) for name, limits in camera.camera_controls.items())
        known = tuple(control for control in controls if control is not None)
        return CameraDescription("picamera", source, info["Model"], info["Id"], modes, known)
    finally:
        camera.close()


def _mode_of(mode: Mapping[str, Any]) -> Mode:
    width, height = mode["size"]
    return Mode(width, height, str(mode["format"]), float(mode["fps"]))


def _exposure_controls(exposure_us: float | None, gain: float | None) -> dict[str, Any]:
    """libcamera's controls of a fixed exposure and gain; either ends the automatic exposure."""
    wanted: dict[str, Any] = {}
    if exposure_us is not None:
        wanted["ExposureTime"] = round(exposure_us)
    if gain is not None:
        wanted["AnalogueGain"] = gain
    return {"AeEnable": False, **wanted} if wanted else {}


def _numbered(controls: Mapping[str, ControlValue]) -> dict[str, ControlValue]:
    """Controls with the number of a `SyncMode` that is given by its name."""
    return {
        name: SYNC_MODES[value] if name == "SyncMode" and isinstance(value, str) else value
        for name, value in controls.items()
    }


def _describe(name: str, limits: tuple[Any, Any, Any]) -> Control | None:
    """A control of libcamera with its least, greatest and default value; None for one that is no single number."""
    low, high, default = limits
    if name == "SyncMode":
        return Control(name, "menu", low=0, high=2, entries=tuple(SYNC_MODES), value="Off")
    for kind, type_ in (("boolean", bool), ("integer", int), ("float", float)):
        if isinstance(low, type_):
            value = default if isinstance(default, type_) else None
            if kind == "boolean":
                return Control(name, kind, value=value)
            return Control(name, kind, low, high, value=value)  # pyright: ignore[reportArgumentType]: a literal
    return None
