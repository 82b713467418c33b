# SPDX-License-Identifier: BSD-3-Clause
"""GenICam cameras (GigE Vision and USB3 Vision) as a source of frames, and the stream of images of one camera."""

import contextlib
import ctypes
import queue
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from ctypes import byref, c_size_t, c_ubyte, c_uint64
from functools import partial
from typing import Any

import numpy as np

from camera_node.clocks.device_clock import DeviceClock
from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import CameraDescription, Control, check_controls
from camera_node.sources.frame import Frame, SourceSettings
from camera_node.sources.genicam.aravis import AravisError, load_aravis
from camera_node.sources.genicam.genicam_camera import FoundCamera, GenicamCamera, find_camera, find_cameras
from camera_node.sources.genicam.pixel_formats import PixelFormat
from camera_node.sources.live import Capture, LiveSource

POP_S = 0.1  # longest wait for one buffer, between looks at other requests
START_S = 2.0  # longest wait for the first frame of a camera that runs freely
SILENCE_S = 1.0  # without a further frame, after which it counts as lost
REOPEN_S = 0.2  # between attempts, each of which waits for the camera's answer
REQUEST_S = 10.0  # longest wait of another thread for the one that reads
N_BUFFERS = 8
COMPLETE = 0  # ARV_BUFFER_STATUS_SUCCESS
MAX_PAYLOAD = 256_000_000  # bytes of one image


class GenicamCapture(Capture):
    """An open camera that delivers. Its time stamps are taken as the start of the exposure, as SFNC describes them.

    Args:
        found: which camera.
        settings, controls: are applied before the stream starts.

    Raises:
        CameraError: the camera does not open or refuses a setting.
        ConfigError: the camera does not offer a control or its value.
    """

    has_exposure = True

    def __init__(
        self, found: FoundCamera, settings: SourceSettings, controls: Mapping[str, ControlValue]
    ) -> None:
        self._camera = GenicamCamera(found)
        self.name = self._camera.name
        self._requests: queue.SimpleQueue[tuple[Callable[[], Any], Future]] = queue.SimpleQueue()
        self._past_incomplete = self._past_lost = 0  # of streams before the present one
        try:
            if not self._camera.is_controlled():
                raise CameraError(f"{self.name} is controlled by another program; stop that one")
            if controls:
                check_controls(controls, self._camera.controls(), self.name)
            self._camera.configure(settings, controls)
            self._period_s = 1 / settings.fps if settings.fps else 0.0
            self._begin()
        except BaseException:
            self._camera.close()
            raise

    @property
    def incomplete(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]: read only
        """See `Source`."""
        return self._past_incomplete + self._stream.incomplete

    @property
    def lost_packets(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]: read only
        """See `Source`."""
        return self._past_lost + self._known_lost

    def read(self) -> Frame | None:
        """See `Capture.read`."""
        try:
            return self._next()
        except CameraError:
            self._refuse()
            raise

    def _next(self) -> Frame | None:
        silence_s = max(SILENCE_S if self._has_delivered else START_S, 3 * self._period_s)
        end_s = time.monotonic() + silence_s
        while time.monotonic() < end_s:
            self._serve()
            if (stamped := self._stream.pop(POP_S)) is not None:
                self._known_lost, self._has_delivered = self._stream.lost_packets(), True
                self._clock.refresh()  # not of a silent camera: a request without an answer takes three seconds
                return self._frame(*stamped)
            if not self._camera.is_controlled():
                raise CameraError("the camera does not answer any more, or another program took it over")
        self._known_lost = self._stream.lost_packets()
        if self._is_triggered:
            return None
        raise CameraError(
            f"no complete frame within {silence_s:g} s, {self.incomplete} incomplete ones so far; "
            "check the firewall (UDP) and the packet size"
        )

    def offered(self) -> Mapping[str, Control]:
        """See `Capture.offered`."""
        return self._in_reader(self._camera.controls)

    def adjust(
        self, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        """See `Capture.adjust`. What can't be set during an acquisition, such as PixelFormat, restarts it."""
        self._in_reader(partial(self._apply, exposure_us, gain, controls))

    def close(self) -> None:
        self._refuse()
        self._stream.close()
        self._camera.close()

    def _begin(self) -> None:
        """Start the stream in the camera's present settings."""
        self._is_triggered = self._camera.is_triggered()
        self._exposure_us = self._camera.exposure_us()
        self._clock = DeviceClock(self._camera.clock())
        self._clock.refresh()
        self._stream = GenicamStream(self._camera, self._camera.pixel_format())
        self._known_lost, self._has_delivered = 0, False

    def _frame(self, image: Grey, device_ns: int) -> Frame:
        t_ns, error_us = self._clock.to_unix(device_ns)
        return Frame(image, t_ns + round(self._exposure_us * 500), self._exposure_us, error_us)

    def _apply(
        self, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        self._camera.set_exposure(exposure_us, gain)
        try:
            self._camera.set_controls(controls)
        except AravisError:
            self._restart_with(controls)
        self._is_triggered = self._camera.is_triggered()
        self._exposure_us = self._camera.exposure_us()

    def _restart_with(self, controls: Mapping[str, ControlValue]) -> None:
        self._past_incomplete, self._past_lost = (
            self.incomplete,
            self._past_lost + self._stream.lost_packets(),
        )
        self._stream.close()
        try:
            self._camera.set_controls(controls)
        finally:
            self._begin()

    def _in_reader(self, function: Callable[[], Any]) -> Any:
        """Call a function in the thread that reads, because neither camera nor stream may be used by two at once."""
        future: Future = Future()
        self._requests.put((function, future))
        try:
            return future.result(REQUEST_S)
        except TimeoutError:
            raise CameraError(f"{self.name} does not answer; try again") from None

    def _serve(self) -> None:
        """Make the calls that other threads requested."""
        while not self._requests.empty():
            function, future = self._requests.get()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(function())
            except Exception as error:  # goes to the thread that waits
                future.set_exception(error)

    def _refuse(self) -> None:
        """Fail the requests that wait."""
        while not self._requests.empty():
            self._requests.get()[1].set_exception(CameraError(f"{self.name} is being closed; try again"))


def open_genicam(text: str, settings: SourceSettings) -> LiveSource:
    """A source of frames of a camera by serial number, id or address; raises as `GenicamCapture`.

    A lost camera is tried at its last address, where it answers as soon as it returns, and then searched for.
    """
    last: list[FoundCamera] = []

    def open_camera(now: SourceSettings, controls: Mapping[str, ControlValue]) -> GenicamCapture:
        with contextlib.suppress(CameraError):
            if last:
                return GenicamCapture(last[0], now, controls)
        last[:] = [find_camera(text)]
        return GenicamCapture(last[0], now, controls)

    return LiveSource(open_camera, settings, REOPEN_S)


def genicam_key(text: str) -> tuple[str, str]:
    """The key of a camera, its serial number, and its model; raises CameraAbsentError or ConfigError."""
    found = find_camera(text)
    return f"genicam {found.vendor} {found.model} {found.serial or found.id}", found.label


def list_genicam() -> list[CameraDescription]:
    """The cameras that answer; raises ConfigError where Aravis is missing."""
    return [_describe(found) for found in find_cameras()]


def _describe(found: FoundCamera) -> CameraDescription:
    name = f"{found.vendor} {found.model}"
    place = found.address or found.protocol
    try:
        camera = GenicamCamera(found)
    except CameraError as error:
        return CameraDescription("genicam", found.source, name, found.serial, note=str(error))
    try:
        note = f"at {place}" if camera.is_controlled() else f"at {place}; another program controls it"
        modes, controls = camera.modes(), tuple(camera.controls().values())
        return CameraDescription("genicam", found.source, name, found.serial, modes, controls, note)
    except (CameraError, ConfigError) as error:
        return CameraDescription("genicam", found.source, name, found.serial, note=str(error))
    finally:
        camera.close()


class GenicamStream:
    """A running acquisition, until `close`.

    Attributes:
        incomplete: images of which packets are missing.

    Raises:
        AravisError: the camera refuses to start.
    """

    def __init__(self, camera: GenicamCamera, pixel_format: PixelFormat) -> None:
        self._aravis, self._camera, self._format = load_aravis(), camera, pixel_format
        self.incomplete = 0
        payload = self._aravis.call("arv_camera_get_payload", camera.handle)
        if not 0 < payload <= MAX_PAYLOAD:
            raise AravisError(f"{camera.name} states images of {payload} bytes")
        self._handle: int = self._aravis.call("arv_camera_create_stream", camera.handle, None, None)
        try:
            for _ in range(N_BUFFERS):
                buffer = self._aravis.plain("arv_buffer_new_allocate", payload)
                self._aravis.plain("arv_stream_push_buffer", self._handle, buffer)
            self._aravis.call("arv_camera_start_acquisition", camera.handle)
        except AravisError:
            self._aravis.release(self._handle)
            raise

    def pop(self, timeout_s: float) -> tuple[Grey, int] | None:
        """The next complete image (h, w) and the camera's own time stamp, ns; None if none arrives in time.

        Raises:
            AravisError: after `close`.
        """
        if not self._handle:
            raise AravisError("the acquisition did not start again")
        buffer = self._aravis.plain("arv_stream_timeout_pop_buffer", self._handle, round(timeout_s * 1e6))
        if not buffer:
            return None
        try:
            return self._convert(buffer)
        finally:
            self._aravis.plain("arv_stream_push_buffer", self._handle, buffer)

    def lost_packets(self) -> int:
        """Packets that never arrived, since the start; 0 for USB."""
        if not (self._handle and self._camera.is_network):
            return 0
        resent, missing = c_uint64(), c_uint64()
        self._aravis.plain("arv_gv_stream_get_statistics", self._handle, byref(resent), byref(missing))
        return missing.value

    def close(self) -> None:
        """Stop the acquisition; also of a camera that no longer answers, and twice."""
        handle, self._handle = self._handle, 0
        if not handle:
            return
        if self._camera.is_controlled():  # otherwise each request takes seconds until it fails
            with contextlib.suppress(AravisError):
                self._aravis.call("arv_camera_stop_acquisition", self._camera.handle)
        self._aravis.release(handle)

    def _convert(self, buffer: int) -> tuple[Grey, int] | None:
        if self._aravis.plain("arv_buffer_get_status", buffer) != COMPLETE:
            self.incomplete += 1
            return None
        size = c_size_t()
        address = self._aravis.plain("arv_buffer_get_image_data", buffer, byref(size))
        width = self._aravis.plain("arv_buffer_get_image_width", buffer)
        height = self._aravis.plain("arv_buffer_get_image_height", buffer)
        if not address or width <= 0 or height <= 0:
            self.incomplete += 1
            return None
        pixels = np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(c_ubyte)), (size.value,))
        try:
            image = self._format.to_grey(pixels, width, height)
        except ValueError:
            self.incomplete += 1
            return None
        return image, self._aravis.plain("arv_buffer_get_timestamp", buffer)
