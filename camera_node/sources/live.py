# SPDX-License-Identifier: BSD-3-Clause
"""A source that reads a camera in a thread of its own and opens it again when it stops delivering."""

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Protocol

from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import Control, check_controls
from camera_node.sources.frame import Frame, Source, SourceSettings, parse_controls

log = logging.getLogger("camera_node.device")

DEFAULTS = SourceSettings()
REOPEN_S = 1.0
# Longest wait for the thread, which may be waiting for a camera that is away; the thread releases it later.
CLOSE_S = 2.0


class Capture(Protocol):
    """An open camera. The thread that opened it makes all calls, except those of `offered` and `adjust`.

    Attributes:
        name: of the camera in messages, without credentials.
        has_exposure: whether exposure and gain can be set.
        incomplete, lost_packets: as of `Source`, since this camera was opened.
    """

    name: str
    has_exposure: bool
    incomplete: int
    lost_packets: int

    def read(self) -> Frame | None:
        """The next frame, within a few seconds; None if none came but the camera may still deliver (a trigger).

        Raises:
            CameraError: the camera does not deliver; it is to be closed and opened again.
        """
        ...

    def offered(self) -> Mapping[str, Control]:
        """The controls that can be set while the camera runs, by name."""
        ...

    def adjust(
        self, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        """Set what is given before the next frame; never while another thread is in `close`.

        Raises:
            CameraError: the camera refuses a value; the others may be set.
        """
        ...

    def close(self) -> None:
        """Release the camera."""
        ...


class LiveSource(Source):
    """Delivers the newest frame of a camera; older frames that were not read in time are counted in `dropped`.

    When the camera stops delivering, the thread logs that once and tries to open the camera until it delivers again.

    Args:
        open: opens the camera with settings and controls; raises CameraError where that fails.
        settings: with which it is opened, and changed by `adjust`.
        reopen_s: time between attempts.

    Raises:
        CameraError: the camera does not open, now.
        ConfigError: the camera refuses a setting.
    """

    def __init__(
        self,
        open: Callable[[SourceSettings, Mapping[str, ControlValue]], Capture],
        settings: SourceSettings = DEFAULTS,
        reopen_s: float = REOPEN_S,
    ) -> None:
        self._open, self._settings, self._reopen_s = open, settings, reopen_s
        self._controls = parse_controls(settings.controls)
        self._capture: Capture | None = open(settings, self._controls)
        self.name = self._capture.name
        self._has_exposure = self._capture.has_exposure
        self._past_incomplete = self._past_lost = 0  # of earlier captures
        self._is_lost = False
        self._newest = NewestFrame()
        self._changing = threading.Lock()  # of the capture and its settings; not held while a frame is read
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"read {self.name}", daemon=True)
        self._thread.start()

    @property
    def exposure_us(self) -> float | None:
        return self._settings.exposure_us if self._has_exposure else None

    @property
    def gain(self) -> float | None:
        return self._settings.gain if self._has_exposure else None

    @property
    def controls(self) -> Mapping[str, ControlValue]:
        return self._controls

    @property
    def dropped(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]: read only
        """See `Source`."""
        return self._newest.dropped

    @property
    def incomplete(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]: read only
        """See `Source`."""
        capture = self._capture
        return self._past_incomplete + (capture.incomplete if capture else 0)

    @property
    def lost_packets(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]: read only
        """See `Source`."""
        capture = self._capture
        return self._past_lost + (capture.lost_packets if capture else 0)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._newest)

    def adjust(
        self,
        exposure_us: float | None = None,
        gain: float | None = None,
        controls: Mapping[str, ControlValue] | None = None,
    ) -> None:
        """See `Source.adjust`. While the camera is absent, the values are stored for its return."""
        controls = controls or {}
        if not self._has_exposure and (exposure_us is not None or gain is not None):
            raise ConfigError(f"{self.name} has no exposure or gain to set; set them in the camera")
        with self._changing:
            if self._capture is not None:
                self._adjust(self._capture, exposure_us, gain, controls)
            given = {"exposure_us": exposure_us, "gain": gain}
            self._settings = replace(self._settings, **{k: v for k, v in given.items() if v is not None})
            self._controls = {**self._controls, **controls}

    def close(self) -> None:
        self._closed.set()
        self._newest.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(CLOSE_S)

    @staticmethod
    def _adjust(
        capture: Capture, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        try:
            if controls:
                check_controls(controls, capture.offered(), capture.name)
            capture.adjust(exposure_us, gain, controls)
        except CameraError as error:
            raise ConfigError(str(error)) from None

    def _run(self) -> None:
        while not self._closed.is_set():
            if not (self._grab(self._capture) if self._capture else self._reopen()):
                self._closed.wait(self._reopen_s)
        self._release()

    def _grab(self, capture: Capture) -> bool:
        try:
            frame = capture.read()
        except CameraError as error:
            self._report_loss(error)
            return False
        if frame is not None:
            self._deliver(frame)
        return True

    def _report_loss(self, error: CameraError) -> None:
        if not self._is_lost and not self._closed.is_set():
            text = "%s delivers no frames (%s); reopening it every %g s"
            log.warning(text, self.name, error, self._reopen_s)
        self._is_lost = True
        self._release()

    def _release(self) -> None:
        with self._changing:
            capture, self._capture = self._capture, None
            if capture is not None:
                self._past_incomplete += capture.incomplete
                self._past_lost += capture.lost_packets
                capture.close()

    def _deliver(self, frame: Frame) -> None:
        if self._is_lost:
            log.warning("%s delivers frames again", self.name)
        self._is_lost = False
        self._newest.put(frame)

    def _reopen(self) -> bool:
        before = self._settings, self._controls
        try:
            capture = self._open(*before)
        except (CameraError, ConfigError) as error:
            log.debug("%s", error)
            return False
        with self._changing:
            if is_current := before == (self._settings, self._controls):
                self._capture = capture
        if not is_current:  # they were changed while the camera was opened
            capture.close()
        return is_current


class NewestFrame:
    """Iterating yields the newest frame, each at most once, until `close`.

    Attributes:
        dropped: frames that a newer one replaced before they were read.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._latest: Frame | None = None
        self._arrived = threading.Condition()
        self._is_closed = False

    def put(self, frame: Frame) -> None:
        """Replace the frame that waits."""
        with self._arrived:
            self.dropped += self._latest is not None
            self._latest = frame
            self._arrived.notify_all()

    def close(self) -> None:
        """End the iteration, also one in another thread."""
        with self._arrived:
            self._is_closed = True
            self._arrived.notify_all()

    def __iter__(self) -> Iterator[Frame]:
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._latest or self._is_closed)
                if self._is_closed:
                    return
                frame, self._latest = self._latest, None
            if frame is not None:
                yield frame
