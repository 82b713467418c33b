# SPDX-License-Identifier: BSD-3-Clause
"""Decides which frames of which cameras are used: clocks, frozen images, moved cameras."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from calib.rig.camera import Camera
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray, MarkerTable
from fusion.model.states import FrameSetFit, Snapshot
from fusion.monitoring.arrival_rates import ArrivalRates
from fusion.monitoring.camera_clocks import CameraClocks, uncertain
from fusion.monitoring.frozen_images import FrozenImages
from fusion.rig_graph.rig_monitor import RigMonitor


class CameraMonitors:
    """The monitors of all cameras of a rig.

    Args:
        cameras: cameras of the rig; `check` and `place` change their poses.
        markers: of all robots.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable) -> None:
        self._cameras = cameras
        self.clocks = CameraClocks(cameras.names)
        self._arrivals = ArrivalRates()
        self.frozen = FrozenImages(cameras, markers)
        self.rig = RigMonitor(cameras, markers)

    @property
    def withheld(self) -> set[str]:
        """Cameras whose frames `admit` refuses: their images are frozen."""
        return self.frozen.names

    def inherit(self, old: "CameraMonitors", same: Mapping[int, int]) -> None:
        """Continue with the same cameras and other robots; `same` has old rows by new row."""
        self.clocks.inherit(old.clocks)
        self._arrivals = old._arrivals
        self.frozen.inherit(old.frozen)
        self.rig.inherit(old.rig, same)

    def admit(
        self, frame: CalibratedFrame, robots_now: Callable[[], Snapshot | None]
    ) -> CalibratedFrame | None:
        """A frame in corrected time; None while its camera is withheld, or if that time is in the future.

        Args:
            frame: the next one of its camera.
            robots_now: the robots at the last frame set; None before the first.
        """
        sigmas = self.clocks.observe(frame)
        if any(sigmas):
            self.rig.jump(frame.camera, *sigmas)
            self._arrivals.forget(frame.camera)
        admitted = self.clocks.admit(frame)
        return None if admitted is None or self.frozen.is_frozen(admitted, robots_now) else admitted

    def used(self, frame_set: FrameSet, speed_m_s: float) -> FrameSet:
        """The frame set without the frames of moved cameras, and of those whose time is not known at this speed."""
        excluded = self.rig.excluded | uncertain(frame_set, speed_m_s)
        if not excluded:
            return frame_set
        return replace(frame_set, frames=tuple(f for f in frame_set.frames if f.camera not in excluded))

    def check_extrinsics(
        self,
        frame_set: FrameSet,
        now: Snapshot,
        fit: FrameSetFit,
        recalibrates: bool,
    ) -> tuple[ExtrinsicsCorrection | RigRefinement, ...]:
        """Exclude moved cameras, apply recalibrated poses and correct clocks; see `RigMonitor.check`."""
        for frame in frame_set.frames:
            if (shown := self._arrivals.add(frame)) is not None:
                rate = shown.rate - self.clocks.rate(frame.camera)
                self.rig.add_rate(frame.camera, frame.t_ns, rate, shown.sigma)
        corrections = self.rig.check(frame_set, now, fit, recalibrates)
        for departure in self.rig.take_departures():
            self.clocks.correct(departure)
        self.clocks.doubt(self.rig.clock_doubts)
        self.clocks.hold_common(frame_set.t_ns)
        for correction in corrections:
            if correction.placed:
                self._cameras.place(correction.placed)
                self._cameras.state_errors(correction.rig)
        return corrections

    def place(self, name: str, camera: Camera, pinned: bool) -> None:
        """Replace the pose of a camera and use its detections; a pinned camera is not excluded again."""
        if camera.clock != self._cameras[name].clock:
            self.clocks.reset(name)
        self._cameras.place({name: camera})
        (self.rig.pin if pinned else self.rig.readmit)(name)
