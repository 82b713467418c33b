# SPDX-License-Identifier: BSD-3-Clause
"""A camera node: frame -> detect -> stamp -> publish."""

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from camera_node.detection.overlay import draw_roundels
from camera_node.detection.roundels import Roundels
from camera_node.node.clock_sync import ClockSync
from camera_node.node.eye import Eye
from camera_node.node.status import NodeStatistics
from camera_node.protocol.messages import CameraStatus, Detections, Keys, Settings, encode
from camera_node.protocol.requests import (
    RequestError,
    encode_jpeg,
    encode_reply,
    parse_draw,
    parse_quality,
    parse_request,
    payload_of,
    respond,
)
from camera_node.protocol.session import ServerWatch
from camera_node.sources.frame import Frame, Source
from camera_node.sources.replay import PacedSource

log = logging.getLogger("camera_node")

STATUS_S = 1.0
LISTENER_S = 5.0  # how long a recording waits for somebody to listen
ROUTES_S = 0.3  # Zenoh routers know of a listener 0.1 s before they have agreed on the route to it


class Node:
    """One camera: its source, its detector and what it publishes, until the source ends or `close`."""

    def __init__(
        self,
        name: str,
        source: Source,
        session: zenoh.Session,
        arena: str = "arena",
        detector: dict[str, Any] | None = None,
        keep_stamps: bool = False,
    ) -> None:
        """Nothing is published before `run`.

        Args:
            name: the camera's name.
            source: closed by the node.
            session: left open.
            arena: the first part of all keys.
            detector: keyword arguments of `Detector`.
            keep_stamps: publish the source's times as they are, and not in the server's time.
        """
        self.name, self.source, self.session = name, source, session
        self.keys = Keys(arena)
        self.clock = ClockSync(session, self.keys)
        self.health = NodeStatistics(name)
        self.keep_stamps = keep_stamps
        self.eye = Eye(source, detector or {})
        self._seen: tuple[Frame, Roundels] | None = None
        self._closed = threading.Event()

    def run(self) -> None:
        """Publish every frame until the source ends or `close` is called.

        Raises:
            CameraError: the source's frames can't be read.
        """
        with contextlib.ExitStack() as stack:
            publisher = self._open(stack)
            for seq, frame in enumerate(self.source):
                roundels, detect_us = self._detect(frame)
                publisher.put(self._message(seq, frame, roundels, detect_us))
                self.health.count(frame, roundels, detect_us)
                self._seen = frame, roundels

    def close(self) -> None:
        """End `run`, from another thread."""
        self._closed.set()
        self.source.close()

    def _detect(self, frame: Frame) -> tuple[Roundels, float]:
        begun = time.perf_counter_ns()
        roundels = self.eye.detect(frame.image)
        return roundels, (time.perf_counter_ns() - begun) / 1000

    def _message(self, seq: int, frame: Frame, roundels: Roundels, detect_us: float) -> bytes:
        height, width = frame.image.shape
        t_ns, clock_error_us = self._stamp(frame)
        message = Detections.pack(
            roundels,
            camera=self.name,
            seq=seq,
            t_ns=t_ns,
            exposure_us=frame.exposure_us,
            detect_us=detect_us,
            sent_ns=self.clock.to_server(time.time_ns()),
            clock_error_us=clock_error_us,
            width=width,
            height=height,
        )
        return encode(message)

    def _stamp(self, frame: Frame) -> tuple[int, float]:
        """When it was taken, in the server's time, and what the clocks add to that at most, microseconds."""
        if self.keep_stamps:
            return frame.t_ns, 0.0
        estimate = self.clock.estimate(frame.t_ns)
        return (frame.t_ns + estimate[0], estimate[1] / 1000) if estimate else (frame.t_ns, math.nan)

    def _open(self, stack: contextlib.ExitStack) -> zenoh.Publisher:
        """Declare everything that this node says and answers; `stack` takes it back."""
        keys, name, session = self.keys, self.name, self.session
        stack.callback(self.close)
        publisher = session.declare_publisher(
            keys.detections(name),
            congestion_control=zenoh.CongestionControl.DROP,  # an old frame is worth nothing
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        stack.callback(publisher.undeclare)
        for key, answer in ((keys.snapshot(name), self._snapshot), (keys.settings(name), self._change)):
            queryable = session.declare_queryable(key, partial(self._answer, answer))
            stack.callback(queryable.undeclare)
        stack.callback(session.liveliness().declare_token(keys.camera_alive(name)).undeclare)
        watch = ServerWatch(session, keys.fusion_alive)
        stack.callback(watch.close)
        self.clock.start()
        stack.callback(self.clock.close)
        reporter = threading.Thread(target=self._report, args=(watch,), name="status", daemon=True)
        reporter.start()
        stack.callback(reporter.join, STATUS_S)
        stack.callback(self._closed.set)
        if isinstance(self.source, PacedSource):
            self._await_listener(publisher)
        return publisher

    def _await_listener(self, publisher: zenoh.Publisher) -> None:
        """A recording starts when somebody listens: a live camera can't wait, a recording need not lose frames."""
        listens = threading.Event()
        listener = publisher.declare_matching_listener(
            lambda status: listens.set() if status.matching else None
        )
        if not publisher.matching_status and not listens.wait(LISTENER_S):
            log.warning("nobody listens to %s; the recording starts all the same", self.name)
        listener.undeclare()
        self._closed.wait(ROUTES_S)

    def _report(self, watch: ServerWatch) -> None:
        publisher = self.session.declare_publisher(self.keys.camera_status(self.name))
        while not self._closed.wait(STATUS_S):
            watch.tell_absence()
            publisher.put(encode(self._status()))
        publisher.undeclare()

    def _status(self) -> CameraStatus:
        estimate = self.clock.estimate()
        return self.health.status(
            self.clock.to_server(time.time_ns()),
            dropped=getattr(self.source, "dropped", 0),  # sources that can't fall behind don't count
            threshold=self.eye.threshold,
            exposure_us=self.eye.settings.exposure_us,
            gain=self.eye.settings.gain,
            clock_offset_ms=estimate[0] / 1e6 if estimate else None,
            clock_error_ms=estimate[1] / 1e6 if estimate else None,
        )

    def _answer(self, answer: Callable[[zenoh.Query], bytes], query: zenoh.Query) -> None:
        if not respond(query, answer):
            self.health.refuse()

    def _snapshot(self, query: zenoh.Query) -> bytes:
        if self._seen is None:
            raise RequestError("no frame yet")
        frame, roundels = self._seen
        drawn = parse_draw(query.parameters)
        image = draw_roundels(frame.image, roundels) if drawn else frame.image
        return encode_jpeg(image, parse_quality(query.parameters))

    def _change(self, query: zenoh.Query) -> bytes:
        if payload := payload_of(query):
            self.eye.adjust(parse_request(payload, Settings))
        return encode_reply(payload, self.eye.settings)
