# SPDX-License-Identifier: BSD-3-Clause
"""A node's side of its registration: asks the server for name and settings, and follows their changes."""

import hashlib
import logging
import queue
import socket
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from camera_node.foundation.errors import NetworkError
from camera_node.protocol.messages import Keys, MessageError, Settings, decode, encode
from camera_node.protocol.registration import (
    CameraAssignment,
    CameraChange,
    CameraRegistration,
    assigned_key,
    change_key,
    register_key,
)
from camera_node.protocol.requests import RequestError, RequestSource, send_request
from camera_node.protocol.session import guarded

log = logging.getLogger("camera_node.registration")

MACHINE_ID = Path("/etc/machine-id")
QUEUED = 16  # events that wait for the thread: more than can arrive while one is handled
WAKE_S = 1.0  # between looks at whether the thread is to end
ASK_S = 5.0  # for one answer; then the next attempt


def camera_id(source: str) -> str:
    """A stable id of a source of this machine: of a device with a serial number, wherever it is plugged in.

    Two cameras of a machine never have the same id, and those of two machines neither: cheap cameras of one model share
    their serial number.

    Args:
        source: the `key` of its `SourceIdentity`.
    """
    return hashlib.sha256(f"roundel {_machine()} {source}".encode()).hexdigest()[:16]


def _machine() -> str:
    try:
        text = MACHINE_ID.read_text().strip()
    except OSError:
        text = ""
    return text or f"{socket.gethostname()} {uuid.getnode():x}"


class Registration:
    """Asks the server for a camera's assignment, and follows later changes in a thread of its own until `close`.

    Args:
        session: an open session; it is left open.
        arena: its name.
        request: describes the camera.

    Attributes:
        assigned: the last assignment; None before the first.
    """

    def __init__(self, session: zenoh.Session, arena: str, request: CameraRegistration) -> None:
        self._session, self._arena, self._request = session, arena, request
        self._events: queue.Queue[Callable[[], object]] = queue.Queue(QUEUED)
        self.assigned: CameraAssignment | None = None
        self._on_change: Callable[[CameraAssignment], object] = lambda assignment: None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="registration", daemon=True)

    def ask(self, stop: threading.Event) -> CameraAssignment | None:
        """The camera's assignment; waits until a server answers, and logs once that none does. None once `stop` is set.

        Raises:
            RequestError: the server refuses the camera.
        """
        since = time.monotonic()
        while not stop.is_set():
            try:
                self.assigned = self._request_assignment()
                return self.assigned
            except NetworkError as error:
                if time.monotonic() - since < 2 * ASK_S:
                    log.warning("%s; retrying", error)
        return None

    def follow(self, on_change: Callable[[CameraAssignment], object]) -> None:
        """Call `on_change` in this object's thread when name or settings change."""
        self._on_change = on_change
        key, alive = assigned_key(self._arena, self._request.id), Keys(self._arena).fusion_alive
        self._subscribers = [
            self._session.declare_subscriber(key, guarded(key, self._receive)),
            self._session.liveliness().declare_subscriber(alive, guarded(alive, self._return_of_server)),
        ]
        self._thread.start()

    def store(self, settings: Settings) -> None:
        """Have the server store settings that were changed at the node; returns at once."""
        change = CameraChange(
            camera=self._request.id, settings=settings, source=RequestSource.of("camera_node")
        )
        self._enqueue(
            lambda: send_request(self._session, change_key(self._arena), encode(change), ASK_S, ASK_S)
        )

    def close(self) -> None:
        """End the thread and the subscriptions."""
        if self._closed.is_set() or not self._thread.is_alive():
            return
        self._closed.set()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._enqueue(lambda: None)
        if threading.current_thread() is not self._thread:
            self._thread.join(2 * ASK_S)

    def _receive(self, sample: zenoh.Sample) -> None:
        try:
            assignment = decode(sample.payload.to_bytes(), CameraAssignment)
        except MessageError as error:
            log.warning("an invalid assignment is ignored: %s", error)
            return
        self._enqueue(lambda: self._apply(assignment))

    def _return_of_server(self, sample: zenoh.Sample) -> None:
        """Register again: a server without a folder for cameras has forgotten their names."""
        if sample.kind == zenoh.SampleKind.PUT:
            self._enqueue(lambda: self._apply(self._request_assignment()))

    def _request_assignment(self) -> CameraAssignment:
        assigned = self.assigned
        request = msgspec.structs.replace(self._request, name=assigned.name) if assigned else self._request
        answer = send_request(self._session, register_key(self._arena), encode(request), ASK_S, ASK_S)
        try:
            return decode(answer, CameraAssignment)
        except MessageError as error:
            raise RequestError(
                f"the server's answer to a registration is invalid ({error}); is it of this version of Roundel?"
            ) from None

    def _apply(self, assignment: CameraAssignment) -> None:
        before, self.assigned = self.assigned, assignment
        if (
            before is None
            or before.name != assignment.name
            or set_fields(assignment.settings) != set_fields(before.settings)
        ):
            self._on_change(assignment)

    def _enqueue(self, event: Callable[[], object]) -> None:
        try:
            self._events.put_nowait(event)
        except queue.Full:
            log.warning("a change of name or settings is lost: too many at once")

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                self._events.get(timeout=WAKE_S)()
            except queue.Empty:
                continue
            except (NetworkError, RequestError) as error:
                log.warning("name and settings are unchanged: %s", error)
            except Exception:  # the next event is another
                log.exception("a change of name or settings failed")


def set_fields(settings: Settings) -> dict[str, Any]:
    """The settings that are set."""
    return {name: value for name, value in msgspec.structs.asdict(settings).items() if value is not None}
