# SPDX-License-Identifier: BSD-3-Clause
"""Live cameras: collect what they see, put the rig."""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import zenoh
from rich.progress import BarColumn, Progress, TextColumn

from calib.errors import CalibrationError
from calib.rig.coverage import Coverage
from calib.rig.messages import RigMessage
from calib.rig.rig import Rig
from camera_node.protocol.messages import Detections, Keys, MessageError, decode, encode
from camera_node.terminal import progress_console

DELIVERY_S = 2.0  # for the rig to reach whoever listens
LOOK_EVERY_S = 0.2
SILENT_S = 2.0  # without a frame: a camera that is lost


@dataclass(slots=True)
class CollectedFrames:
    """What came so far: messages; by camera the frames with roundels and where in its image they were, and when
    it was heard last, seconds; and how many messages were none."""

    messages: list[Detections] = field(default_factory=list)
    frames: Counter[str] = field(default_factory=Counter)
    coverage: dict[str, Coverage] = field(default_factory=dict)
    latest: dict[str, float] = field(default_factory=dict)
    bad: int = 0

    def silent(self, now: float) -> list[str]:
        """Cameras that sent messages and stopped: a camera sends one every frame, with roundels or without."""
        return sorted(name for name, last in self.latest.items() if now - last > SILENT_S)

    def take(self, data: bytes, now: float) -> None:
        """Count and keep a message, or count what is none."""
        try:
            message = decode(data, Detections)
        except MessageError:
            self.bad += 1
            return
        self.messages.append(message)
        self.latest[message.camera] = now
        if not len(message):
            return
        self.frames[message.camera] += 1
        seen = Coverage.of(message.unpack().uv, message.width, message.height)
        before = self.coverage.get(message.camera)
        self.coverage[message.camera] = before + seen if before else seen


def listen(
    session: zenoh.Session, arena: str, seconds: float, look: Callable[[CollectedFrames, float], str]
) -> tuple[CollectedFrames, str]:
    """Hear all cameras of an arena for a while.

    Args:
        session, arena: where cameras publish.
        seconds: how long at the most; Ctrl-C ends it before, and keeps what came.
        look: called a few times a second, from this thread, with what came and the seconds that passed; ends it by
            the reason that it returns, and goes on where that is empty.

    Returns:
        what came, and why it ended.

    Raises:
        CalibrationError: nothing came.
    """
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    key = Keys(arena).detections()
    subscriber = session.declare_subscriber(key, lambda sample: arrived.put(sample.payload.to_bytes()))
    try:
        heard, why = _follow(arrived, seconds, look)
    finally:
        subscriber.undeclare()
    if not heard.messages:
        raise CalibrationError(
            f"no detections on {key} in {seconds:g} s ({heard.bad} bad messages); are the server and the cameras "
            "running, and --connect and --arena right?"
        )
    return heard, why


def _follow(
    arrived: queue.SimpleQueue[bytes], seconds: float, look: Callable[[CollectedFrames, float], str]
) -> tuple[CollectedFrames, str]:
    heard, begun, looked = CollectedFrames(), time.monotonic(), 0.0
    try:
        while (passed := time.monotonic() - begun) < seconds:
            with suppress(queue.Empty):
                heard.take(arrived.get(timeout=min(seconds - passed, LOOK_EVERY_S)), passed)
            if passed - looked < LOOK_EVERY_S:
                continue
            looked = passed
            if why := look(heard, passed):
                return heard, why
    except KeyboardInterrupt:
        return heard, "Ctrl-C; what was seen until then counts"
    return heard, f"{seconds:g} s are over"


def collect(session: zenoh.Session, arena: str, seconds: float, doing: str) -> CollectedFrames:
    """What all cameras of an arena see for a while, with a line of progress.

    Raises:
        CalibrationError: nothing came.
    """
    columns = (TextColumn(doing), BarColumn(), TextColumn("{task.description}"))
    with Progress(*columns, transient=True, console=progress_console()) as progress:
        task = progress.add_task("waiting for cameras", total=seconds)

        def show(heard: CollectedFrames, passed: float) -> str:
            told = ", ".join(f"{name} {n}" for name, n in sorted(heard.frames.items()))
            progress.update(task, completed=passed, description=told or "waiting for cameras")
            return ""

        return listen(session, arena, seconds, show)[0]


def publish(session: zenoh.Session, arena: str, rig: Rig) -> bool:
    """Put the rig on its key; whether a subscriber was there to take it within two seconds."""
    publisher = session.declare_publisher(Keys(arena).rig, reliability=zenoh.Reliability.RELIABLE)
    listening = threading.Event()
    listener = publisher.declare_matching_listener(
        lambda status: listening.set() if status.matching else listening.clear()
    )
    taken = publisher.matching_status or listening.wait(DELIVERY_S)
    publisher.put(encode(RigMessage.of(rig)))
    listener.undeclare()
    publisher.undeclare()
    return taken
