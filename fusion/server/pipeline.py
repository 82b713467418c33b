# SPDX-License-Identifier: BSD-3-Clause
"""The active rig and robots, and the synchronizer and tracker that use them; no network."""

import logging
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

from calib.rig.camera import Camera
from calib.rig.file_history import Step
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.foundation.errors import RoundelError
from camera_node.protocol.requests import RequestSource
from fusion.errors import FusionError
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement, corrected_cameras, with_errors_of
from fusion.model.frames import CalibratedFrame
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import Robots, RobotsRequest, robots_digest
from fusion.server.arena_config import ArenaConfig
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.server.server_statistics import PipelineStatus
from fusion.server.storage.active_rig import ActiveRig, renamed
from fusion.server.storage.active_robots import ActiveRobots
from fusion.tracking.association import AssociatedFrames
from fusion.tracking.tracker import WORTH, Tracker

log = logging.getLogger("fusion")

NOT_CALIBRATED = "the cameras are not calibrated"


class TrackingPipeline:
    """The state of tracking: the active rig and robots, the frame synchronizer, and the tracker.

    `tracker` is None while no camera has a pose.

    Args:
        config: the arena's files, rate and limits.

    Raises:
        ConfigError, FusionError, CalibrationError: a file is missing or broken, or declares robots that can't be
            tracked.
    """

    def __init__(self, config: ArenaConfig) -> None:
        self._config = config
        files = (config.rig, config.saved_rig, config.robots, config.saved_robots)
        rig, saved_rig, robots, saved_robots = (
            Path(file) if file and config.leads else None for file in files
        )
        self.active_rig = ActiveRig(rig, saved_rig)
        self.active_robots = ActiveRobots(robots, saved_robots)
        self.tracker: Tracker | None
        self.synchronizer: FrameSynchronizer
        self.early: AssociatedFrames | None = None  # of the open frame set
        self._is_wand_recorded = False
        self._judging: Executor | None = None
        self._refines = config.refine
        self._start(self.cameras)
        self.active_rig.load(lambda rig: self._start(rig.placed()))
        if self.tracker is not None:
            self.tracker.monitors.rig.remember(rig.placed() for rig in self.active_rig.earlier())

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras that have a pose in the active rig."""
        return self.active_rig.rig.placed() if self.active_rig.rig else {}

    @property
    def robots(self) -> dict[str, Robot]:
        """The robots that are tracked."""
        return self.active_robots.robots

    def restart(self) -> None:
        """Drop all frames and tracks; the tracker acquires all robots again."""
        if self.tracker is not None:
            self.tracker = self.tracker.restarted()
            self.judge_cameras_in(self._judging)
        self.synchronizer = self._new_synchronizer()
        self.early = None

    def replace_rig(self, rig: Rig, now_ns: int, source: RequestSource | None = None) -> None:
        """Use a rig that was requested, then save it. Robots stay tracked if at most one camera differs.

        Raises:
            FusionError, ConfigError, CalibrationError: it can't be used or saved; the old one stays in force.
        """
        self._use(rig, lambda: self.active_rig.save(rig, now_ns, source))
        self.active_rig.use(rig, now_ns, source)
        self.refine(self._config.refine)

    def rename_camera(self, before: str, after: str, now_ns: int, source: RequestSource | None) -> None:
        """Give a camera another name in all versions of the rig; raises as `replace_rig`."""
        rig = self.active_rig.rig
        assert rig is not None
        rig = renamed(rig, before, after)
        self._use(rig, lambda: self.active_rig.rename(before, after))
        self.active_rig.use(rig, now_ns, source)

    def step_rig(self, step: Step, now_ns: int, source: RequestSource | None = None) -> None:
        """Restore the rig before the last change, or the one that was undone last.

        A camera is no longer monitored once the server's recalibration of it is undone, and the rig is no longer
        refined once a refinement is.

        Raises:
            FusionError, ConfigError, CalibrationError: there is none, or it can't be used.
        """
        before, rig = self.active_rig.rig, self.active_rig.neighbour(step)
        corrected = corrected_cameras(before, rig) if before and step == "undo" else []
        self._use(rig, lambda: self.active_rig.take(step), corrected[0] if len(corrected) == 1 else None)
        self.active_rig.use(rig, now_ns, source)
        if len(corrected) > 1:
            self.refine(False)

    def follow_rig(self, message: RigMessage) -> None:
        """Use the rig that the first zone's server published; raises FusionError if it can't be used."""
        if self.active_rig.message is None or self.active_rig.message.t_ns != message.t_ns:
            self._use(message.rig, lambda: None)
            self.active_rig.message = message

    def correct_rig(self, correction: ExtrinsicsCorrection | RigRefinement, now_ns: int) -> None:
        """Update the active rig by cameras with other poses."""
        old = self.cameras
        if any(camera != old.get(name) for name, camera in correction.placed.items()):
            self.active_rig.correct(correction, now_ns)
            self._recalibrate_frames(old, self.cameras)

    def _use(self, rig: Rig, save: Callable[[], object], pinned: str | None = None) -> None:
        """Track with another rig, then save it; on a fault of either, track with the old one again.

        Args:
            rig: the rig.
            save: saves the change.
            pinned: a camera whose pose a user confirms: it is no longer monitored.
        """
        old, synchronizer, tracker = self.cameras, self.synchronizer, self.tracker
        placed = rig.placed()
        stated = with_errors_of(old, placed)
        changed = [name for name in placed if placed[name] != stated.get(name)]
        in_place = tracker is not None and placed.keys() == old.keys() and len(changed) <= 1
        try:
            if not in_place:
                self._start(placed)
                self.synchronizer = synchronizer if self.tracker and tracker else self.synchronizer
            elif tracker is not None:
                for name in changed:
                    tracker.place(name, placed[name], pinned=name == pinned)
                tracker.cameras.state_errors(placed)
            save()
        except Exception as error:  # nothing that a rig contains may end the server
            self.tracker, self.synchronizer = tracker, synchronizer
            if in_place and tracker is not None:
                for name in changed:
                    tracker.place(name, old[name])
                tracker.cameras.state_errors(old)
            if isinstance(error, RoundelError):
                raise
            log.exception("a rig can't be used")
            raise FusionError(f"the rig can't be used: {type(error).__name__}: {error}") from None
        self._recalibrate_frames(old, placed)

    def _recalibrate_frames(self, old: dict[str, Camera], new: dict[str, Camera]) -> None:
        """Frames that wait for their set have the new calibration; the set is not lost, and its rhythm stays."""

        def recalibrated(frame: CalibratedFrame) -> CalibratedFrame | None:
            name = frame.camera
            if new.get(name) == old[name]:
                return frame
            return frame.recalibrated(old[name], new[name]) if name in new else None

        for name in old.keys() - new.keys():
            self.synchronizer.ignore(name)
        self.synchronizer.replace_frames(recalibrated)
        self.early = None

    def _start(self, cameras: dict[str, Camera]) -> None:
        """Restart tracking."""
        limits = self._config.limits
        self.tracker = Tracker(cameras, self.robots, limits, self._config.leads) if cameras else None
        if self.tracker is not None:
            self.tracker.monitors.rig.doubt()
        self.judge_cameras_in(self._judging)
        self.refine(self._refines)
        self.pause_acquisition(self._is_wand_recorded)
        self.synchronizer = self._new_synchronizer()
        if cameras:
            log.info("active calibration: %s", ", ".join(cameras))

    def _new_synchronizer(self) -> FrameSynchronizer:
        return FrameSynchronizer.at_rate(self._config.rate_hz, self._config.limits.lateness_ms)

    def follow_robots(self, message: Robots) -> None:
        """Use the robots that the first zone's server published; raises FusionError if they can't be tracked."""
        if message.robots != self.robots:
            self.active_robots.follow(message.robots)
            if self.tracker is not None:
                self.tracker = self.tracker.with_robots(self.robots, message.renamed)

    def change_robots(self, request: RobotsRequest) -> set[str]:
        """Rename, remove and define robots, all or none. Robots with unchanged markers stay tracked.

        Returns:
            The names that no longer exist.

        Raises:
            ConfigError, FusionError: the request is invalid.
        """
        before = self.robots
        if not self.active_robots.change(request):
            return set()
        if self.tracker is not None:
            self.tracker = self.tracker.with_robots(self.robots, request.rename)
        return before.keys() - self.robots.keys()

    def pause_acquisition(self, is_wand_recorded: bool) -> None:
        """Acquire no robots while a wand is recorded: its markers are none. Tracked robots continue."""
        if is_wand_recorded != self._is_wand_recorded:
            log.info(
                "a wand is recorded: no robots are acquired"
                if is_wand_recorded
                else "robots are acquired again"
            )
        self._is_wand_recorded = is_wand_recorded
        if self.tracker is not None:
            self.tracker.acquires_none = is_wand_recorded

    def refine(self, refines: bool) -> None:
        """Correct the rig by what robots show of it, or not any more."""
        self._refines = refines
        if self.tracker is not None:
            self.tracker.monitors.rig.refines = refines

    def judge_cameras_in(self, executor: Executor | None) -> None:
        """Judge the cameras beside the thread that tracks; in it with None, so that a run repeats exactly."""
        self._judging = executor
        if self.tracker is not None:
            self.tracker.judge_cameras_in(executor)

    def associate_early(self) -> None:
        """Associate the frames of the open frame set while the last ones are missing: of eight frames, after six."""
        if self.tracker is not None and (t_ns := self.synchronizer.open_ns) is not None:
            self.early = self.tracker.predict(t_ns, self.early)
            opened = self.synchronizer.opened(self.early.association.n_frames, WORTH)
            self.early = self.tracker.associate(self.early, opened) if opened else self.early

    def admit(self, frame: CalibratedFrame) -> CalibratedFrame | None:
        """A frame in corrected time; None while its camera is withheld, or if it is in the future."""
        return self.tracker.admit(frame) if self.tracker else frame

    def withheld_cameras(self) -> set[str]:
        """Cameras whose frames are not used: their images are frozen."""
        return self.tracker.monitors.withheld if self.tracker else set()

    def status(self) -> PipelineStatus:
        """The pipeline's part of the server's status."""
        message, tracker = self.active_rig.message, self.tracker
        general = PipelineStatus(
            limits=self._config.limits,
            rig_t_ns=message.t_ns if message else None,
            robots_digest=robots_digest(self.robots),
            not_acquired=dict.fromkeys(self.robots, NOT_CALIBRATED),
            unsaved_robots=self.active_robots.unsaved(),
        )
        if tracker is None:
            return general
        return replace(
            general,
            calibrated=frozenset(self.cameras),
            excluded=frozenset(tracker.monitors.rig.excluded),
            frozen=frozenset(tracker.monitors.frozen.names),
            clocks=tracker.monitors.clocks.health(),
            measured_diameters_m=tracker.sizes.misfits(),
            not_acquired=tracker.not_acquired(),
            contradictions=tracker.contradictions(),
        )
