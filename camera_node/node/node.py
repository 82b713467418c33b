# SPDX-License-Identifier: BSD-3-Clause
"""A camera node: reads frames, detects roundels, stamps them with the server's time and publishes them."""

import contextlib
import logging
import math
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import zenoh

from camera_node.detection.detector import Detector
from camera_node.detection.overlay import draw_refused, draw_roundels
from camera_node.detection.refusals import explain
from camera_node.detection.relative_positions import DiscLocalizer
from camera_node.foundation.errors import RoundelError
from camera_node.foundation.rate_limit import RateLimit
from camera_node.foundation.service import ServiceManager
from camera_node.node.clock_sync import ClockSync
from camera_node.node.node_status import NodeStatistics
from camera_node.node.preview import Content, PreviewPublisher
from camera_node.node.rig_lens import RigLens
from camera_node.node.server_registration import Registration, set_fields
from camera_node.protocol.messages import CameraStatus, Detections, Keys, RelativePositions, Settings, encode
from camera_node.protocol.registration import CameraAssignment
from camera_node.protocol.requests import (
    RequestError,
    encode_jpeg,
    encode_reply,
    parse_flag,
    parse_quality,
    parse_request,
    payload_of,
    respond,
    sender_of,
)
from camera_node.protocol.session import ServerWatch, guarded
from camera_node.sources.frame import Frame, Source

log = logging.getLogger("camera_node")

STATUS_S = 1.0
CLOSE_S = 5.0  # for a thread to end; one that is still in Zenoh when Python exits aborts the process
SNAPSHOTS_HZ = 10.0  # a snapshot costs as much as the detection of several frames
EXPLANATIONS_HZ = 2.0  # a search for everything that is ring-like, while the detector waits
CHANGES_HZ = 10.0  # of settings: one can build a new detector
LISTENER_S = 5.0  # longest time that a recording waits for a subscriber
ROUTES_S = 0.3  # Zenoh routers announce a subscriber about 0.1 s before the route to it is ready


@dataclass(frozen=True)
class NodeOptions:
    """What a node publishes, and for whom.

    Attributes:
        arena: the first part of all keys.
        keep_stamps: publish the source's times unchanged instead of converting them to the server's time.
        localizer: publish positions relative to the camera, too; None for detections only.
        is_alone: no server is expected; its absence is not reported.
    """

    arena: str = "arena"
    keep_stamps: bool = False
    localizer: DiscLocalizer | None = None
    is_alone: bool = False


class Node:
    """Publishes the detections and the status of one camera, and answers requests for snapshots and settings.

    `on_settings` is called with the settings that a request has changed, in Zenoh's thread.
    """

    def __init__(
        self,
        name: str,
        source: Source,
        detector: Detector,
        session: zenoh.Session,
        options: NodeOptions = NodeOptions(),
    ) -> None:
        """Publish nothing before `run`.

        Args:
            name: the camera's name.
            source: the frames; the node closes it.
            detector: the detector with its initial settings.
            session: a Zenoh session; the node leaves it open.
            options: what to publish.
        """
        self.name = name
        self._source, self._detector, self._session = source, detector, session
        self._options, self._keys = options, Keys(options.arena)
        self._clock = ClockSync(session, self._keys)
        self._publisher = secrets.randbits(63)
        self._statistics = NodeStatistics(name)
        self.on_settings: Callable[[Settings], object] = lambda wanted: None
        self._readout_us: float | None = None  # as set; None: as the source says
        self._changing = threading.Lock()  # of the settings, by requests
        self._snapshots = RateLimit(SNAPSHOTS_HZ, SNAPSHOTS_HZ)
        self._explanations = RateLimit(EXPLANATIONS_HZ, EXPLANATIONS_HZ)
        self._changes = RateLimit(CHANGES_HZ, CHANGES_HZ)
        self._closed = threading.Event()
        self._previews: PreviewPublisher | None = None
        self._relative: zenoh.Publisher | None = None
        self._rig_lens: RigLens | None = None

    def run(self) -> None:
        """Publish every frame until the source ends or `close` is called; each frame is progress of the service.

        Raises:
            CameraError: a frame of the source can't be read.
            ConfigError: the intrinsics of the localizer are for images of another size.
        """
        with contextlib.ExitStack() as stack:
            service = stack.enter_context(ServiceManager())
            publisher = self._open(stack, service)
            service.ready()
            for seq, frame in enumerate(self._source):
                self._process(seq, frame, publisher)
                service.progress()

    def close(self) -> None:
        """End `run`; called from another thread."""
        self._closed.set()
        self._source.close()

    def adjust(self, wanted: Settings) -> None:
        """Apply the settings that are not None, all of them or none; callable from any thread.

        Raises:
            ConfigError: the source or the detector does not have a setting or refuses its value.
        """
        with self._changing:
            self._apply(wanted)

    def _apply(self, wanted: Settings) -> None:
        self._detector = apply_settings(wanted, self._source, self._detector)
        if wanted.readout_us is not None:
            self._readout_us = wanted.readout_us

    def _process(self, seq: int, frame: Frame, publisher: zenoh.Publisher) -> None:
        """From a frame to its messages: detection, refinement by the lens, server's time, publication."""
        height, width = frame.image.shape
        begun_ns = time.perf_counter_ns()
        roundels = self._detector.detect(frame.image)
        refined = self._rig_lens.refine(roundels, (width, height)) if self._rig_lens else roundels
        detect_us = (time.perf_counter_ns() - begun_ns) / 1000
        t_ns, clock_error_us = self._stamp(frame)
        header = {
            "camera": self.name,
            "seq": seq,
            "t_ns": t_ns,
            "exposure_us": frame.exposure_us,
            "sent_ns": self._clock.now_ns(),
            "clock_error_us": clock_error_us,
        }
        message = Detections.pack(
            refined,
            publisher=self._publisher,
            readout_us=frame.readout_us if self._readout_us is None else self._readout_us,
            detect_us=detect_us,
            width=width,
            height=height,
            found_ratios=self._detector.found_ratios,
            **header,
        )
        publisher.put(encode(message))
        if self._relative is not None and (localizer := self._options.localizer) is not None:
            localizer.check_size(width, height)
            located = localizer.locate(roundels)
            positions = RelativePositions.pack(located, diameter_m=localizer.diameter_m, **header)
            self._relative.put(encode(positions))
        self._statistics.count(frame.image, roundels, detect_us)

    def _stamp(self, frame: Frame) -> tuple[int, float]:
        """The frame's capture time in the server's time, ns, and the bound of its error by clocks, us."""
        if self._options.keep_stamps:
            return frame.t_ns, frame.error_us
        estimate = self._clock.estimate(frame.t_ns)
        if estimate is None:
            return frame.t_ns, math.nan
        return frame.t_ns + estimate[0], estimate[1] / 1000 + frame.error_us

    def _open(self, stack: contextlib.ExitStack, service: ServiceManager) -> zenoh.Publisher:
        """Declare all publications, queryables and tokens, to be undeclared by `stack`."""
        keys, name, session = self._keys, self.name, self._session
        stack.callback(self.close)
        control = zenoh.CongestionControl
        publisher = session.declare_publisher(
            keys.detections(name),
            # Old frames of a camera are useless; those of a recording are not old at their recorded times.
            congestion_control=control.BLOCK if self._options.keep_stamps else control.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        stack.callback(publisher.undeclare)
        for key, answer in (
            (keys.snapshot(name), self._answer_snapshot),
            (keys.settings(name), self._answer_settings),
        ):
            queryable = session.declare_queryable(key, guarded(key, partial(self._answer, answer)))
            stack.callback(queryable.undeclare)
        stack.callback(session.liveliness().declare_token(keys.camera_alive(name)).undeclare)
        previews = self._previews = PreviewPublisher(
            session, keys.preview(name), name, self._latest, self._clock.now_ns
        )
        stack.callback(previews.close)
        self._rig_lens = RigLens(session, keys, name, self._statistics.count_refusal)
        stack.callback(self._rig_lens.close)
        if self._options.localizer is not None:
            self._relative = session.declare_publisher(
                keys.relative(name),
                congestion_control=control.DROP,  # old positions are useless
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            stack.callback(self._relative.undeclare)
        watch = ServerWatch(session, keys.fusion_alive)
        stack.callback(watch.close)
        self._clock.start()
        stack.callback(self._clock.close)
        reporter = threading.Thread(
            target=self._publish_status, args=(watch, service), name="status", daemon=True
        )
        reporter.start()
        stack.callback(reporter.join, CLOSE_S)
        stack.callback(self._closed.set)
        if self._source.is_recording:
            self._await_subscriber(publisher)
        return publisher

    def _latest(self) -> Content | None:
        """The latest frame, its roundels and the mask, for previews."""
        latest = self._statistics.latest
        return (*latest, self._detector.settings["mask"]) if latest else None

    def _await_subscriber(self, publisher: zenoh.Publisher) -> None:
        """Wait until there is a subscriber, so that it receives all frames of a recording."""
        matched = threading.Event()
        listener = publisher.declare_matching_listener(
            lambda status: matched.set() if status.matching else None
        )
        # a status, which is always true itself; zenoh's stub says bool
        matches = publisher.matching_status.matching  # pyright: ignore[reportAttributeAccessIssue]
        if not matches and not matched.wait(LISTENER_S):
            log.warning(
                "no subscriber of %s after %g s; starting the recording anyway", self.name, LISTENER_S
            )
        listener.undeclare()
        self._closed.wait(ROUTES_S)

    def _publish_status(self, watch: ServerWatch, service: ServiceManager) -> None:
        publisher = self._session.declare_publisher(self._keys.camera_status(self.name))
        n_full = 0  # statuses since the first frame
        while not self._closed.wait(STATUS_S):
            try:
                if not self._options.is_alone:
                    watch.report_absence()
                status = self._summarize()
                publisher.put(encode(status))
                n_full += status.fps > 0 or n_full > 0
                if n_full == 2:  # the first one counts the frames of a part of its second
                    self._announce(status)
                service.report(f"{status.fps:.1f} frames/s, {status.roundels:.1f} roundels in a frame")
            except Exception:  # the next status is another
                log.exception("the status could not be published")
        publisher.undeclare()

    def _announce(self, status: CameraStatus) -> None:
        """Log once that frames are published: success must not be silent."""
        text = "camera %s publishes %.1f frames/s of %d x %d pixels in arena '%s'"
        log.info(text, self.name, status.fps, status.width, status.height, self._keys.arena)

    def _summarize(self) -> CameraStatus:
        now_ns = self._clock.now_ns()
        return self._statistics.summarize(now_ns, self._clock.estimate(), self._source, self._detector)

    def _answer(self, answer: Callable[[zenoh.Query], bytes], query: zenoh.Query) -> None:
        if not respond(query, answer):
            self._statistics.count_refusal()

    def _answer_snapshot(self, query: zenoh.Query) -> bytes:
        latest = self._statistics.latest
        if not self._snapshots.passes():
            raise RequestError(f"more than {SNAPSHOTS_HZ:g} snapshots a second; ask again later")
        if latest is None:
            raise RequestError("no frame yet; ask again when the camera delivers")
        (image, roundels), why = latest, parse_flag(query.parameters, "why")
        if why and not self._explanations.passes():
            raise RequestError(f"more than {EXPLANATIONS_HZ:g} explanations a second; ask again later")
        if why or parse_flag(query.parameters, "draw"):
            canvas = draw_roundels(image, roundels)
            if why:
                draw_refused(canvas, explain(self._detector, image, roundels))
            image = canvas
        return encode_jpeg(image, parse_quality(query.parameters))

    def _answer_settings(self, query: zenoh.Query) -> bytes:
        payload = payload_of(query)
        with self._changing:
            if payload and not self._changes.passes():
                raise RequestError(f"more than {CHANGES_HZ:g} changes of settings a second; try again later")
            if payload:
                wanted = parse_request(payload, Settings)
                self._apply(wanted)
                log.info(
                    "settings changed by a session that claims to be %s: %s",
                    sender_of(query) or "unknown",
                    wanted,
                )
                self.on_settings(wanted)
            return encode_reply(payload, read_settings(self._source, self._detector, self._readout_us))


def read_settings(source: Source, detector: Detector, readout_us: float | None = None) -> Settings:
    """The settings in use."""
    return Settings(
        exposure_us=source.exposure_us,
        gain=source.gain,
        controls=dict(source.controls) or None,
        readout_us=readout_us,
        **detector.settings,
    )


def apply_settings(wanted: Settings, source: Source, detector: Detector) -> Detector:
    """Apply the settings that are not None, all of them or none.

    Returns:
        The detector for the next frame, which continues the tracks of `detector`.

    Raises:
        ConfigError: the source or the detector does not have a setting or refuses its value.
    """
    changes = {name: getattr(wanted, name) for name in detector.settings}
    changes = {name: value for name, value in changes.items() if value is not None}
    adjusted = detector.adjusted(**changes) if changes else detector
    if (wanted.exposure_us, wanted.gain, wanted.controls) != (None, None, None):
        source.adjust(wanted.exposure_us, wanted.gain, wanted.controls)
    return adjusted


class RegisteredNode:
    """Runs a node under its name and with its settings, and applies the changes of both."""

    def __init__(self, registration: Registration) -> None:
        self._registration = registration
        self._node: Node | None = None
        self._next: CameraAssignment | None = None
        registration.follow(self._change)

    def run(self, node: Node, assignment: CameraAssignment) -> CameraAssignment | None:
        """Run a node until it ends.

        Returns:
            The assignment with its new name if it was renamed; None if its source ended.
        """
        self._node, self._next = node, None
        node.on_settings = self._registration.store
        self._apply(node, assignment.settings)
        if (latest := self._registration.assigned) is not None and latest.name != node.name:
            return latest  # renamed before it ran
        node.run()
        return self._next

    def _change(self, assignment: CameraAssignment) -> None:
        node = self._node
        if node is None:
            return
        if assignment.name != node.name:
            log.warning("camera %s is now called %s", node.name, assignment.name)
            self._next = assignment
            node.close()
        else:
            self._apply(node, assignment.settings)

    def _apply(self, node: Node, settings: Settings) -> None:
        """Apply the stored settings one by one: those that the source does not have must not prevent the others."""
        for name, value in set_fields(settings).items():
            if name == "version":
                continue
            try:
                node.adjust(Settings(**{name: value}))
            except RoundelError as error:
                log.warning("the stored setting %s of %s is not used: %s", name, node.name, error)
