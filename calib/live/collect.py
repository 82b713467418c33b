# SPDX-License-Identifier: BSD-3-Clause
"""Collects detections, and the sizes of images, from running cameras."""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import zenoh
from rich.progress import BarColumn, Progress, TextColumn

from calib.errors import CalibrationError
from calib.rig.coverage import Coverage
from calib.rig.rig import MAX_CAMERAS
from camera_node.foundation.arrays import Array
from camera_node.foundation.terminal import progress_console
from camera_node.protocol.messages import CameraStatus, Detections, Keys, MessageError, decode
from camera_node.protocol.publishers import Publishers
from camera_node.protocol.session import guarded

INSPECT_EVERY_S = 0.2
SILENT_S = 2.0  # without a frame: the camera counts as silent
COMPARED_NS = 500_000_000  # between two frames that show whether a roundel moves
MOVED_PX = 10.0  # in that time; a wand that is held still moves as far
LISTEN_S = 2.5  # a camera publishes its status once a second


@dataclass(slots=True)
class CollectedFrames:
    """Detections collected from running cameras.

    Attributes:
        messages: all detections, in the order of arrival.
        frames: number of frames with roundels, by camera.
        coverage: where in the image roundels were detected, by camera.
        last_seen_s: time of the last message, by camera.
        moved_s: when a roundel was last seen to move; None before.
        invalid: number of messages that could not be decoded.
        publishers: which frames count where two nodes publish under one name, or one sends a frame twice.
    """

    messages: list[Detections] = field(default_factory=list)
    frames: Counter[str] = field(default_factory=Counter)
    coverage: dict[str, Coverage] = field(default_factory=dict)
    last_seen_s: dict[str, float] = field(default_factory=dict)
    moved_s: float | None = None
    invalid: int = 0
    publishers: Publishers = field(default_factory=Publishers)
    _compared: dict[str, tuple[int, Array]] = field(default_factory=dict)  # time and centres of a frame

    def silent_cameras(self, now_s: float) -> list[str]:
        """Cameras that stopped sending: a running camera sends a message every frame, even without roundels."""
        return sorted(name for name, last in self.last_seen_s.items() if now_s - last > SILENT_S)

    def add(self, data: bytes, now_s: float) -> None:
        """Decode and append a message, or count it as invalid."""
        try:
            message = decode(data, Detections)
        except MessageError:
            self.invalid += 1
            return
        if not self.publishers.admits(message, round(now_s * 1e9)) or self.publishers.is_repeated(message):
            return
        self.messages.append(message)
        self.last_seen_s[message.camera] = now_s
        if not len(message):
            return
        self.frames[message.camera] += 1
        uv = message.unpack().uv
        self._note_motion(message.camera, message.t_ns, uv, now_s)
        new = Coverage.of(uv, message.width, message.height)
        before = self.coverage.get(message.camera)
        self.coverage[message.camera] = before + new if before else new

    def _note_motion(self, camera: str, t_ns: int, uv: Array, now_s: float) -> None:
        """Compare frames of a camera, half a second apart: roundels that are not where one was have moved."""
        then_ns, places = self._compared.get(camera, (t_ns - COMPARED_NS, uv))
        if 0 <= t_ns - then_ns < COMPARED_NS:
            return
        self._compared[camera] = t_ns, uv
        moved_px = np.linalg.norm(uv[:, None] - places, axis=2).min(axis=1)
        if moved_px.max() > MOVED_PX:
            self.moved_s = now_s


def collect_frames(
    session: zenoh.Session, arena: str, seconds: float, inspect: Callable[[CollectedFrames, float], str]
) -> tuple[CollectedFrames, str]:
    """Collect the detections of all cameras of an arena.

    Args:
        session, arena: where cameras publish.
        seconds: the longest duration; Ctrl-C ends it earlier and keeps the frames.
        inspect: called from this thread a few times a second, with the frames so far and the elapsed seconds; a text
            that it returns ends the collection and is the reason.

    Returns:
        the frames, and the reason for the end.

    Raises:
        CalibrationError: no message arrived.
    """
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    key = Keys(arena).detections()
    subscriber = session.declare_subscriber(key, lambda sample: arrived.put(sample.payload.to_bytes()))
    wand = session.liveliness().declare_token(
        Keys(arena).wand
    )  # while it exists, the server acquires no robots
    try:
        collected, reason = _receive(arrived, seconds, inspect)
    finally:
        wand.undeclare()
        subscriber.undeclare()
    if not collected.messages:
        raise CalibrationError(
            f"no camera of arena '{arena}' sent detections in {seconds:g} s ({collected.invalid} invalid messages); "
            f"roundel health --arena {arena} says why"
        )
    return collected, reason


def _receive(
    arrived: queue.SimpleQueue[bytes], seconds: float, inspect: Callable[[CollectedFrames, float], str]
) -> tuple[CollectedFrames, str]:
    collected, start, inspected = CollectedFrames(), time.monotonic(), 0.0
    try:
        while (elapsed := time.monotonic() - start) < seconds:
            with suppress(queue.Empty):
                collected.add(arrived.get(timeout=min(seconds - elapsed, INSPECT_EVERY_S)), elapsed)
            if elapsed - inspected < INSPECT_EVERY_S:
                continue
            inspected = elapsed
            if reason := inspect(collected, elapsed):
                return collected, reason
    except KeyboardInterrupt:
        return collected, "Ctrl-C; the frames collected so far are used"
    return collected, f"{seconds:g} s have passed"


def collect_with_progress(
    session: zenoh.Session, arena: str, seconds: float, description: str
) -> CollectedFrames:
    """Collect the detections of all cameras of an arena, with a progress bar.

    Raises:
        CalibrationError: no message arrived.
    """
    columns = (TextColumn(description), BarColumn(), TextColumn("{task.description}"))
    with Progress(*columns, transient=True, console=progress_console()) as progress:
        task = progress.add_task("waiting for cameras", total=seconds)

        def show(collected: CollectedFrames, elapsed: float) -> str:
            counts = ", ".join(f"{name} {n}" for name, n in sorted(collected.frames.items()))
            progress.update(task, completed=elapsed, description=counts or "waiting for cameras")
            return ""

        return collect_frames(session, arena, seconds, show)[0]


def running_camera_sizes(session: zenoh.Session, arena: str) -> dict[str, tuple[int, int]]:
    """Width and height, pixels, of all cameras that publish their status within `LISTEN_S`."""
    sizes: dict[str, tuple[int, int]] = {}
    key = Keys(arena).camera_status()

    def receive(sample: zenoh.Sample) -> None:
        try:
            status = decode(sample.payload.to_bytes(), CameraStatus)
        except MessageError:
            return
        if status.width > 0 and status.height > 0 and len(sizes) < MAX_CAMERAS:
            sizes[status.camera] = status.width, status.height

    subscriber = session.declare_subscriber(key, guarded(key, receive))
    threading.Event().wait(LISTEN_S)
    subscriber.undeclare()
    return dict(sizes)
