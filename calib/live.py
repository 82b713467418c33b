# SPDX-License-Identifier: BSD-3-Clause
"""A wand waved before live cameras: collect detections, put the rig."""

import queue
import threading
import time
from collections import Counter

import zenoh
from rich.progress import BarColumn, Progress, TextColumn

from calib.errors import CalibrationError
from calib.messages import RigMessage
from calib.rig import Rig, dump_rig
from camera_node.messages import Detections, Keys, MessageError, decode, encode

DELIVERY_S = 2.0  # for the rig to reach whoever listens


def collect(
    session: zenoh.Session, arena: str, seconds: float, doing: str = "wave the wand"
) -> tuple[list[Detections], int]:
    """Detections of all cameras of an arena for a while, with a line of progress; and the number of bad messages.

    Raises:
        CalibrationError: nothing came.
    """
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    subscriber = session.declare_subscriber(
        Keys(arena).detections(), lambda sample: arrived.put(sample.payload.to_bytes())
    )
    messages, bad = [], 0
    seen: Counter[str] = Counter()
    columns = (TextColumn(doing), BarColumn(), TextColumn("{task.description}"))
    with Progress(*columns, transient=True) as progress:
        task = progress.add_task("waiting for cameras", total=seconds)
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                message = decode(arrived.get(timeout=min(left, 0.2)), Detections)
                messages.append(message)
                seen[message.camera] += len(message) > 0
            except queue.Empty:
                pass
            except MessageError:
                bad += 1
            told = ", ".join(f"{name} {n}" for name, n in sorted(seen.items()))
            progress.update(task, completed=seconds - left, description=told or "waiting for cameras")
    subscriber.undeclare()
    if not messages:
        raise CalibrationError(nothing_came(Keys(arena).detections(), seconds, bad))
    return messages, bad


def nothing_came(key: str, seconds: float, bad: int) -> str:
    """What to say where cameras are silent."""
    return (
        f"no detections on {key} in {seconds:g} s ({bad} bad messages); are the server and the cameras running, and "
        "--connect and --arena right?"
    )


def publish(session: zenoh.Session, arena: str, rig: Rig) -> bool:
    """Put the rig on its key; whether a subscriber was there to take it within two seconds."""
    publisher = session.declare_publisher(Keys(arena).rig, reliability=zenoh.Reliability.RELIABLE)
    listening = threading.Event()
    listener = publisher.declare_matching_listener(
        lambda status: listening.set() if status.matching else listening.clear()
    )
    taken = publisher.matching_status or listening.wait(DELIVERY_S)
    publisher.put(encode(RigMessage(t_ns=time.time_ns(), yaml=dump_rig(rig))))
    listener.undeclare()
    publisher.undeclare()
    return taken
