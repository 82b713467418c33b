# SPDX-License-Identifier: BSD-3-Clause
"""The live server: the arena's router and clock. Receives detections and publishes robot poses.

Zenoh's callbacks only enqueue. One thread, that of `Server.run`, decodes, tracks and publishes.
"""

import contextlib
import gc
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import msgspec

from calib.rig.rig_messages import RigMessage
from camera_node.foundation.background_process import BackgroundProcess
from camera_node.foundation.errors import ConfigError, RoundelError
from camera_node.foundation.folder_lock import locked_folder
from camera_node.foundation.logs import about
from camera_node.foundation.service import ServiceManager
from camera_node.protocol.messages import Keys, MessageError, decode, encode
from camera_node.protocol.session import listening_endpoints, read_config
from camera_node.protocol.tcp_sockets import close_excess, stop_lingering
from fusion.errors import FusionError
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement
from fusion.model.frames import FrameSet
from fusion.model.undistortion import prepare_lenses
from fusion.protocol.arena_health import describe_status
from fusion.protocol.pose_messages import (
    FusedFrames,
    FusionStatus,
    Latency,
    RobotPose,
    RobotPoses,
    Robots,
    TrackingState,
    frames_key,
    robots_digest,
    robots_key,
)
from fusion.server.arena_config import ArenaConfig
from fusion.server.arena_queries import ArenaQueries, CameraQueries
from fusion.server.fair_use import FrameQuotas
from fusion.server.frame_synchronizer import MAX_RATE_HZ
from fusion.server.ingest import Ingest
from fusion.server.pipeline import TrackingPipeline
from fusion.server.server_clock import clock_of
from fusion.server.server_statistics import ServerStatistics
from fusion.server.storage.audit import AuditLog
from fusion.server.storage.camera_registry import CameraRegistry
from fusion.server.transport import INTERNAL_ERROR, Transport, open_session
from fusion.server.zones.zone_exchange import ZoneExchange
from fusion.tracking.result import NO_SOLUTION, TOO_MANY_UNASSIGNED, latency_of
from fusion.tracking.tracker import Tracker

log = logging.getLogger("fusion")
TICK_S = 0.005  # resolution at which a wait for frames ends
MAX_OF_ADDRESS = (
    250  # connections: a quarter of Zenoh's sessions, and more than the cameras and programs of a machine
)
MAX_LAG_NS = 500_000_000  # of the server; it drops the frames that it can't process within this


class Server:
    """One arena's server; a context manager. `run` serves until `stop`, or until the Zenoh configuration changes.

    Args:
        config: its settings.
        stopped: ends `run` once it is set, as `stop` does.

    Attributes:
        endpoints: those at which it is reached; after entry a port in `listen` that was 0 is the real one.

    Raises, at entry:
        NetworkError: an endpoint is taken.
        ConfigError, FusionError, CalibrationError: a file is missing or broken, or declares robots that can't be
            tracked; another server saves in one of the folders; the arena has zones, and `config` names none.
    """

    def __init__(self, config: ArenaConfig, stopped: threading.Event | None = None) -> None:
        self.config = config
        self.keys = Keys(config.arena)
        self.endpoints = config.listen
        self.statistics = ServerStatistics()
        with contextlib.ExitStack() as stack:
            for folder in config.saving_folders() if config.leads else ():
                stack.enter_context(locked_folder(folder, "server"))
            self.pipeline = TrackingPipeline(config)
            self._closing = stack.pop_all()
        self._ingest = Ingest(self.keys, self.statistics)
        self._quotas = FrameQuotas(config.limits.lateness_ms, MAX_RATE_HZ)
        self._max_lag_ns = max(MAX_LAG_NS, round(config.limits.lateness_ms * 1e6))
        self._stopped = stopped or threading.Event()
        self._zenoh = self._read_zenoh()

    def __enter__(self) -> "Server":
        with self._closing as stack:
            stack.callback(self.pipeline.active_rig.close)
            self.session = stack.enter_context(open_session(self.config))
            self.endpoints = listening_endpoints(self.session, self.config.listen)
            self.clock = clock_of(self.config.leads, self.session, self.keys)
            stack.callback(self.clock.close)
            self.transport = Transport(self.session, self.clock, self._count_fault, stack)
            self.zones = (
                ZoneExchange(self.config, self.keys, self.pipeline, self.transport, self.statistics)
                if self.config.zone
                else None
            )
            self._declare()
            self._closing = stack.pop_all()
        zone = f"zone {self.config.zone} of " if self.config.zone else ""
        log.info("%sarena '%s' listens on %s", zone, self.config.arena, " ".join(self.endpoints))
        if self.pipeline.tracker is None and self.config.leads:
            log.warning("no camera has a pose yet; calibrate with roundel calibrate wand --live, see --help")
        return self

    def __exit__(self, *exception: object) -> None:
        self._closing.close()

    def stop(self) -> None:
        """Let `run` return; callable from any thread."""
        self._stopped.set()

    def run(self) -> None:
        """Serve: receive, synchronize, track and publish, report the status.

        Zenoh reads rules only when a session opens. Where the file of `config.zenoh` changes, `run` returns, so that a
        server that is opened anew withdraws the rights of revoked certificates.
        """
        with (
            ServiceManager() as service,
            collecting_between_frame_sets() as collect_garbage,
            BackgroundProcess() as judge,
        ):
            self.pipeline.judge_cameras_in(judge)
            service.ready()
            while not self._stopped.is_set():
                is_backlogged = self.transport.receive(TICK_S, self._max_lag_ns)
                now_ns = self.clock.now_ns()
                with self._guarded("tracking"):
                    self._fuse(now_ns, is_backlogged)
                    self._exchange(now_ns)
                with self._guarded("the status"):
                    if status := self._report_status(now_ns):
                        service.report(describe_status(status))
                        stop_lingering()  # of connections that are new since the last status
                        self._limit_connections()
                        collect_garbage()
                        if self._has_new_rules():
                            return
                service.progress()

    def _declare(self) -> None:
        keys, transport = self.keys, self.transport
        self._update_quotas()
        self._subscribe_frames()
        transport.watch_tokens(keys.wand, lambda _, is_there: self.pipeline.pause_acquisition(is_there))
        if self.config.leads:
            audit = AuditLog(self.config.audit, self.session)
            queries = ArenaQueries(keys, self.pipeline, transport, self.clock, self._update_quotas)
            queries.declare(audit)
            registry = CameraRegistry(
                Path(self.config.cameras) if self.config.cameras else None, self._is_used
            )
            retire = self.statistics.retire
            CameraQueries(keys, registry, self.pipeline, transport, self.clock, retire).declare(audit)
            transport.declare_alive(keys.fusion_alive)
        else:
            transport.subscribe(keys.rig, self._follow_rig, _prepare_lenses)
            transport.subscribe(keys.fusion_status, self._request_changes)
            transport.subscribe(robots_key(keys.arena), self._follow_robots)
            transport.watch_tokens(keys.fusion_alive, self._note_first_zone)
        if self.zones is not None:
            self.zones.declare(self._subscribe_frames)

    def _subscribe_frames(self) -> None:
        """Subscribe to all cameras, or to those that this zone uses."""
        names = ("*",) if self.zones is None else self.zones.member.used_cameras
        frames = [self.keys.detections(name) for name in names]
        self.transport.subscribe_frames(frames, self._receive_detections, self._quotas)

    def _exchange(self, now_ns: int) -> None:
        """Publish for the other zones, once the arena's time is known."""
        if self.zones is not None and self.clock.is_known:
            self.zones.publish(now_ns)

    def _limit_connections(self) -> None:
        """End connections of an address that has too many: Zenoh limits all sessions together."""
        for address, count in close_excess(MAX_OF_ADDRESS).items():
            for _ in range(count):
                self.statistics.count_fault("connections beyond the limit of one address")
            log.warning(
                "ended %d connections of %s: more than %d",
                count,
                address,
                MAX_OF_ADDRESS,
                extra=about(address),
            )

    def _read_zenoh(self) -> bytes | None:
        with contextlib.suppress(OSError):
            return Path(self.config.zenoh).read_bytes() if self.config.zenoh else None

    def _has_new_rules(self) -> bool:
        """Whether the file of the Zenoh configuration has changed and is valid; each version is judged once."""
        before, self._zenoh = self._zenoh, self._read_zenoh()
        if self._zenoh in (before, None):
            return False
        try:
            read_config(Path(self.config.zenoh or ""))
        except ConfigError as error:
            log.error("%s; the rules before it stay in force", error)
            return False
        log.warning("%s has changed: all connections are opened anew, by its rules", self.config.zenoh)
        return True

    def _is_used(self, camera: str) -> bool:
        rig = self.pipeline.active_rig.rig
        return self.statistics.sends_frames(camera) or (rig is not None and camera in rig.cameras)

    @contextlib.contextmanager
    def _guarded(self, stage: str) -> Iterator[None]:
        """Count and log an exception of a stage. The server continues: the next frames are not those that failed."""
        try:
            yield
        except Exception:
            self.statistics.count_fault(INTERNAL_ERROR)
            log.exception("%s failed; the server continues", stage)

    def _count_fault(self, reason: str, key: str) -> None:
        """Count what was skipped of the sender on a key."""
        self.statistics.count_fault(reason, self.keys.camera_in(key))

    # The steps of the loop.

    def _fuse(self, now_ns: int, is_backlogged: bool) -> None:
        """Track the frame sets that are due; while frames of the next one are missing, associate the others.

        After a pause many are due at once. Those without frames are skipped: they would cost the time in which the next
        frames become too old.
        """
        due = self._synchronize(now_ns, is_backlogged)
        for frame_set in due:
            if frame_set.frames or frame_set is due[-1]:
                self._track(frame_set)
        if not is_backlogged:
            self.pipeline.associate_early()

    def _synchronize(self, now_ns: int, is_backlogged: bool) -> list[FrameSet]:
        """The frame sets that are due. Queued frames count as on time unless the server lags by more than 0.5 s."""
        if is_backlogged:
            now_ns = max(self.transport.received_ns, now_ns - MAX_LAG_NS)
        return self.pipeline.synchronizer.take(now_ns)

    def _track(self, frame_set: FrameSet) -> None:
        """Track and publish. A frame set without a solution costs the tracks, not the server."""
        if self.pipeline.tracker is None:
            return
        try:
            self._track_and_publish(self.pipeline.tracker, frame_set)
        except Exception:  # NumPy's and GTSAM's of a singular system, or a bug that some input shows
            self.statistics.count_fault(NO_SOLUTION)
            log.exception("a frame set has no solution; all robots are acquired again")
            self.pipeline.restart()

    def _track_and_publish(self, tracker: Tracker, frame_set: FrameSet) -> None:
        """Publish the poses that acquisition can't change first, then everything else."""
        start_ns = self.clock.now_ns()
        if self.zones is not None:
            self.zones.member.begin(tracker.table, frame_set.t_ns)
        predicted = tracker.predict(frame_set.t_ns, self.pipeline.early)
        update = tracker.update(tracker.associate(predicted, frame_set), frame_set)
        latency = latency_of(frame_set, start_ns, self.clock.now_ns())
        publish_poses(self.transport, self.keys, update.poses.values(), latency)
        result = tracker.finish(update)
        published = {pose.robot for pose in update.poses.values()}
        others = [pose for pose in result.poses if pose.robot not in published]
        publish_poses(self.transport, self.keys, others, latency)
        if self.zones is not None:
            self.zones.finish(tracker.table, result.markers)
            self._exchange(self.clock.now_ns())
        else:
            self.transport.publish(self.keys.markers, result.markers)
        corrections, judged = tracker.check_extrinsics(frame_set), tracker.monitors.rig.take_judged()
        if self.zones is None:
            self.transport.publish(frames_key(self.keys.arena), FusedFrames.of(frame_set, judged))
        for correction in corrections:
            self._report_correction(correction)
        for name in result.crowded:
            self.statistics.count_fault(TOO_MANY_UNASSIGNED, name)
        states: dict[str, TrackingState] = {pose.robot: pose.state for pose in result.poses}
        self.statistics.count_frame_set(result.cameras, states, latency.total_ms if latency else None)

    def _report_correction(self, correction: ExtrinsicsCorrection | RigRefinement) -> None:
        """Log a change of the cameras; publish the rig if they have other poses, by the server that has the rig."""
        if correction.placed:
            self.pipeline.correct_rig(correction, self.clock.now_ns())
            if self.pipeline.active_rig.message is not None:
                self.transport.publish(self.keys.rig, self.pipeline.active_rig.message)
        if isinstance(correction, RigRefinement):
            log.warning("%s; roundel undo reverts that", correction)
            return
        name = correction.name
        if correction.camera is None:
            self.statistics.note_moved(name)
        elif correction.has_returned:
            log.warning("camera %s is at a known pose, and used again", name, extra=about(name))
        else:
            change = "camera %s is recalibrated and used again; roundel undo reverts that"
            log.warning(change, name, extra=about(name))

    def _report_status(self, now_ns: int) -> FusionStatus | None:
        """Publish the status once a second; return it if it was due."""
        if not self.statistics.is_due(now_ns):
            return None
        status = self.statistics.report(now_ns, self.pipeline.status())
        if self.zones is not None:
            self.zones.publish_status(status)
        else:
            self.transport.publish(self.keys.fusion_status, status)
        self._update_quotas()
        return status

    def _update_quotas(self) -> None:
        keys = [self.keys.detections(name) for name in self.pipeline.cameras]
        self._quotas.update(keys, self.pipeline.synchronizer.rate_hz or MAX_RATE_HZ)

    # Received messages.

    def _receive_detections(self, data: bytes, key: str, received_ns: int) -> None:
        frame = self._ingest.receive(data, key, received_ns, self.pipeline.cameras)
        if frame is None:
            return
        frame, name = self.pipeline.admit(frame), frame.camera
        if frame is None:
            self.pipeline.synchronizer.ignore(name)
            if name not in self.pipeline.withheld_cameras():
                self.statistics.count_refusal("implausible time", name)
            return
        age_ns = received_ns - frame.t_ns  # of all cameras on a slow link, which none outruns
        synchronizer = self.pipeline.synchronizer
        if age_ns <= self._max_lag_ns and synchronizer.add(frame):
            self.statistics.note_on_time(name)
        else:
            limit_ns = min(self._max_lag_ns, synchronizer.limit_ns)
            self.statistics.note_late(name, age_ns * 1e-6, limit_ns * 1e-6)

    def _follow_rig(self, data: bytes, key: str, received_ns: int) -> None:
        """Use the rig of the first zone's server."""
        try:
            self.pipeline.follow_rig(decode(data, RigMessage))
        except (MessageError, FusionError) as error:
            self.statistics.count_fault("unusable rig")
            log.warning("the rig of the first zone is not used: %s", error)

    def _request_changes(self, data: bytes, key: str, received_ns: int) -> None:
        """Request the rig and the robots of the first zone's server if its status tells that they are others."""
        with contextlib.suppress(MessageError):
            active, status = self.pipeline.active_rig.message, decode(data, FusionStatus)
            if status.rig_t_ns is not None and (active is None or active.t_ns != status.rig_t_ns):
                self._request_rig()
            if status.robots_digest not in (None, robots_digest(self.pipeline.robots)):
                self._request_robots()

    def _request_rig(self) -> None:
        self.transport.request(self.keys.rig, self._follow_rig, _prepare_lenses)

    def _request_robots(self) -> None:
        self.transport.request(robots_key(self.keys.arena), self._follow_robots)

    def _follow_robots(self, data: bytes, key: str, received_ns: int) -> None:
        """Use the robots of the first zone's server."""
        assert self.zones is not None
        try:
            robots = decode(data, Robots)
            self.pipeline.follow_robots(robots)
        except (MessageError, RoundelError) as error:
            self.statistics.count_fault("unusable robots")
            log.warning("the robots of the first zone are not used: %s", error)
        else:
            self.zones.member.ownership.rename(robots.renamed)

    def _note_first_zone(self, key: str, is_alive: bool) -> None:
        """Request the robots and the rig of the first zone's server once it is there."""
        if is_alive:
            self._request_robots()
            self._request_rig()


def publish_poses(
    transport: Transport, keys: Keys, poses: Iterable[RobotPose], latency: Latency | None
) -> None:
    """Publish poses, each with the latency of its frame set: all in one message, and each on its robot's key."""
    encoded = {pose.robot: encode(msgspec.structs.replace(pose, latency=latency)) for pose in poses}
    if encoded:
        transport.put(keys.poses, RobotPoses.join(tuple(encoded.values())))
    for robot, data in encoded.items():
        transport.put(keys.robot_pose(robot), data)


def _prepare_lenses(data: bytes) -> None:
    with contextlib.suppress(MessageError):  # which the server's thread counts
        prepare_lenses(decode(data, RigMessage).rig.placed().values())


@contextlib.contextmanager
def collecting_between_frame_sets() -> Iterator[Callable[[], object]]:
    """Collect garbage only when the yielded function is called: between frame sets, once a second."""
    gc.freeze()  # imported modules are never searched: among them is no garbage
    gc.disable()
    try:
        yield gc.collect
    finally:
        gc.enable()
        gc.unfreeze()
