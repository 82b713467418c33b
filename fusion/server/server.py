# SPDX-License-Identifier: BSD-3-Clause
"""The live server: the arena's router and clock; detections in, robot poses out.

Zenoh's callbacks only enqueue; one thread, that of `Server.run`, decodes, fuses and publishes.
"""

import contextlib
import gc
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import zenoh

from calib.rig.camera import Camera
from calib.rig.messages import RigMessage
from calib.rig.rig import load_rig, save_rig
from camera_node.protocol.host_clock import clock_id
from camera_node.protocol.messages import ClockReply, Keys, MessageError, decode, encode
from camera_node.protocol.requests import encode_reply, parse_request, payload_of
from fusion.model.frames import FrameSet
from fusion.model.robots import changed, load_robots, load_saved_robots, save_robots
from fusion.monitoring.extrinsics_monitor import ExtrinsicsCorrection
from fusion.protocol.messages import (
    Latency,
    RobotPose,
    Robots,
    RobotsRequest,
    ShardPoses,
    TrackingState,
    robots_key,
    shard_key,
    undo_key,
)
from fusion.protocol.shards import Shard
from fusion.server.active_rig import ActiveRig
from fusion.server.config import ArenaConfig
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.server.ingest import FAR_NS, Ingest
from fusion.server.persistence import PersistedFile
from fusion.server.status import ServerStatistics
from fusion.server.transport import Transport, open_session
from fusion.tracking.result import latency_of
from fusion.tracking.tracker import AssociatedFrames, Tracker

log = logging.getLogger("fusion")
TICK_S = 0.005  # how finely the end of a wait is met
BEHIND_NS = 500_000_000  # by which the server may be behind before it drops what it can't do
BACK_NS = 1_000_000_000  # by which this machine's clock may be set back without anything being begun anew


class Server:
    """One arena's server; a context manager. `run` serves until `stop` or an exception such as Ctrl-C.

    Raises, at entry:
        NetworkError: an endpoint is taken.
        ConfigError, FusionError, CalibrationError: a file is missing, broken, or declares what can't be tracked.
    """

    def __init__(self, config: ArenaConfig) -> None:
        self.config = config
        self.keys = Keys(config.arena)
        self.shard = Shard.parse(config.shard)
        self._own_key = shard_key(config.arena, self.shard.index)
        given = Path(config.robots)
        self._kept_robots = PersistedFile("robots", config.kept_robots, load_saved_robots, save_robots)
        kept = self._kept_robots.newer_than(given)
        self.robots = load_robots(given) if kept is None else kept
        self.health = ServerStatistics(config.limits.lateness_ms)
        self._intake = Ingest(self.keys, self.health)
        kept_rig = PersistedFile("rig", config.kept_rig, load_rig, save_rig)
        self.calibration = ActiveRig(Path(config.rig) if config.rig else None, kept_rig)
        self._tracker: Tracker | None = None
        self._early: AssociatedFrames | None = None  # of the frame set that is not complete yet
        self._now_ns = 0
        self._start()
        self._stopped = threading.Event()
        self._closing = contextlib.ExitStack()

    def __enter__(self) -> "Server":
        with self._closing as stack:
            self.session = stack.enter_context(open_session(self.config, self.shard))
            self.link = Transport(self.session, self.health.count, stack)
            self._declare()
            self._closing = stack.pop_all()
        verb = "listens on" if self.shard.leads else f"has its shard {self.config.shard} at"
        log.info("arena '%s' %s %s", self.config.arena, verb, " ".join(self.config.listen))
        if self._tracker is None:
            log.warning("no camera has a place yet: wave the wand, python -m calib wand --live --help")
        return self

    def __exit__(self, *exception: object) -> None:
        self._closing.close()

    def stop(self) -> None:
        """Let `run` return; callable from any thread."""
        self._stopped.set()

    def run(self) -> None:
        """Serve."""
        with collecting_between_instants() as collect:
            while not self._stopped.is_set():
                more = self.link.work(TICK_S)
                now_ns = self._tell_time()
                # What waits in the queue is not late, unless more is asked than this machine can do.
                heard_ns = max(self.link.reached_ns, now_ns - BEHIND_NS) if more else now_ns
                for instant in self._instants.take(heard_ns):
                    self._fuse(instant)
                if not more:
                    self._anticipate()
                if self._tell_status(now_ns):
                    collect()

    def _tell_time(self) -> int:
        """Now. Once the clock was set back, what was followed lies in the future: everything begins anew."""
        now_ns = time.time_ns()
        if now_ns < self._now_ns - BACK_NS:
            log.warning(
                "this machine's clock was set back by %.0f s; robots are found anew",
                (self._now_ns - now_ns) * 1e-9,
            )
            self._start()
        self._now_ns = now_ns
        return now_ns

    def _declare(self) -> None:
        keys, link = self.keys, self.link
        link.subscribe(keys.detections(), self._take_detections)
        link.subscribe(keys.rig, self._take_rig)
        link.answer_later(robots_key(keys.arena), self._change_robots)
        if self.shard.count > 1:
            link.subscribe(shard_key(keys.arena, "*"), self._take_shard)
        if self.shard.leads:
            link.answer(keys.clock, self._answer_clock)
            link.answer(keys.rig, self._answer_rig)
            link.answer_later(undo_key(keys.arena), self._undo)
            link.show_alive(keys.fusion_alive)

    # What arrives.

    def _take_detections(self, data: bytes, key: str, received_ns: int) -> None:
        frame = self._intake.receive(data, key, received_ns, self._cameras())
        if frame is not None:
            self.health.noted(frame.camera, self._instants.add(frame), (time.time_ns() - frame.t_ns) * 1e-6)

    def _take_rig(self, data: bytes, key: str, received_ns: int) -> None:
        try:
            rig = decode(data, RigMessage).rig()
        except MessageError as error:
            self.health.count("rig that is no rig")
            log.warning("a published rig is refused, the old one stays: %s", error)
            return
        if rig == self.calibration.rig:  # our own, or one that came twice
            return
        moved = self.calibration.replace(rig)
        if moved is not None and self._tracker is not None:
            self._tracker.place(moved, rig.cameras[moved])  # robots stay as they are
        else:
            self._start()

    def _take_shard(self, data: bytes, key: str, received_ns: int) -> None:
        """Another shard's robots."""
        if key == self._own_key:
            return
        try:
            told = decode(data, ShardPoses)
        except MessageError:
            self.health.count("poses that are no message")
            return
        if abs(told.t_ns - received_ns) > FAR_NS:
            self.health.count("implausible time")
        elif self._tracker is not None:
            self._tracker.table.receive(told)

    def _start(self) -> None:
        """Begin with the rig in force; robots are found anew."""
        placed = self._cameras()
        self._tracker = Tracker(placed, self.robots, self.config.limits, self.shard) if placed else None
        rate_hz, lateness_ms = self.config.rate_hz, self.config.limits.lateness_ms
        self._instants = FrameSynchronizer(
            round(1e9 / rate_hz) if rate_hz else None, round(lateness_ms * 1e6)
        )
        if placed:
            log.info("calibration in force: %s", ", ".join(placed))

    def _cameras(self) -> dict[str, Camera]:
        return self.calibration.rig.placed() if self.calibration.rig else {}

    # What is answered.

    def _answer_clock(self, query: zenoh.Query) -> None:
        query.reply(self.keys.clock, encode(ClockReply(t_ns=time.time_ns(), clock=clock_id())))

    def _answer_rig(self, query: zenoh.Query) -> None:
        if self.calibration.rig is not None:
            query.reply(self.keys.rig, encode(self.calibration.message()))

    def _undo(self, _: zenoh.Query) -> bytes:
        """Take the last correction back; that camera is not doubted again until another rig comes."""
        name, camera = self.calibration.undo()
        log.warning("camera %s is back where it stood, as was asked; it is not watched any more", name)
        if self._tracker is not None:
            self._tracker.place(name, camera, pinned=True)
        message = self.calibration.message()
        self.link.publish(self.keys.rig, message)
        return encode(message)

    def _change_robots(self, query: zenoh.Query) -> bytes:
        """Rename, remove and define robots, all or none; what they are then."""
        payload = payload_of(query)
        request = parse_request(payload, RobotsRequest) if payload else RobotsRequest()
        robots = changed(self.robots, request.rename, request.remove, request.define)
        if robots != self.robots:
            for name in self.robots.keys() - robots.keys():
                self.link.forget(self.keys.robot_pose(name))
            self.robots = robots
            self._kept_robots.keep(robots)
            log.info("robots: %s", ", ".join(robots) or "none")
            if self._tracker is not None:
                self._tracker = self._tracker.with_robots(robots, request.rename)
        return encode_reply(payload, Robots(robots=self.robots))

    # What is told.

    def _tell_status(self, now_ns: int) -> bool:
        tracker, late = self._tracker, self._instants.late
        aside, misfits = (tracker.extrinsics.excluded, tracker.geometry.misfits) if tracker else (set(), dict)
        status = self.health.status(now_ns, set(self._cameras()), late, aside, misfits)
        if status is not None:
            own = "" if self.shard.leads else f"/{self.shard.index}"
            self.link.publish(self.keys.fusion_status + own, status)
        return status is not None

    def _anticipate(self) -> None:
        """Use the wait for the last frames of an instant."""
        instant, owed = self._instants.open()
        if self._tracker is not None and instant is not None:
            self._early = self._tracker.associate_early(instant, owed, self._early)

    def _fuse(self, instant: FrameSet) -> None:
        if self._tracker is None:
            return
        try:
            self._follow(self._tracker, instant)
        except (np.linalg.LinAlgError, RuntimeError):  # NumPy's and GTSAM's, of a system that has no solution
            self.health.count("instant that could not be solved")
            log.exception("an instant could not be solved; robots are found anew")
            self._start()

    def _follow(self, tracker: Tracker, instant: FrameSet) -> None:
        begun_ns = time.time_ns()
        associated = tracker.associate(tracker.predict(instant.t_ns, self._early), instant)
        self._early = None
        update = tracker.update(associated, instant)
        latency = latency_of(instant, begun_ns, time.time_ns())
        self._tell_poses(update.poses.values(), latency)
        if self.shard.count > 1:
            self.link.publish(self._own_key, tracker.table.shard_poses())
        fused = tracker.finish(update)
        told = {pose.robot for pose in update.poses.values()}
        self._tell_poses([pose for pose in fused.poses if pose.robot not in told], latency)
        if self.shard.leads:
            self.link.publish(self.keys.markers, fused.markers)
        for correction in tracker.check_extrinsics(instant, fused):
            self._tell(correction)
        states: dict[str, TrackingState] = {pose.robot: pose.state for pose in fused.poses}
        self.health.fused(fused.cameras, states, latency.total_ms if latency else None)

    def _tell_poses(self, poses: Iterable[RobotPose], latency: Latency | None) -> None:
        for pose in poses:
            told = msgspec.structs.replace(pose, latency=latency)
            self.link.publish(self.keys.robot_pose(pose.robot), told)

    def _tell(self, move: ExtrinsicsCorrection) -> None:
        """Say that a camera was moved, or where it stands now."""
        if move.camera is None:
            log.warning(
                "camera %s was moved: its detections are set aside until robots show where it is", move.name
            )
            return
        self.calibration.correct(move.name, move.camera)  # only the leading shard gets here
        self.link.publish(self.keys.rig, self.calibration.message())
        log.warning(
            "camera %s is placed anew and used again; a query on %s takes that back",
            move.name,
            undo_key(self.keys.arena),
        )


@contextlib.contextmanager
def collecting_between_instants() -> Iterator[Callable[[], object]]:
    """No garbage is collected but when the function is called that this gives: between instants, once a second."""
    gc.collect()
    gc.freeze()  # what was imported is not looked through again and again
    gc.disable()
    try:
        yield gc.collect
    finally:
        gc.enable()
        gc.unfreeze()
