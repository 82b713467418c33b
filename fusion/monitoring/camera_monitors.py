# SPDX-License-Identifier: BSD-3-Clause
"""Decides which frames of which cameras are used: clocks, frozen images, frames that contradict, moved cameras."""

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Mask
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MarkerTable
from fusion.monitoring.clocks.camera_clocks import CameraClocks
from fusion.monitoring.clocks.time_search import Snapshot
from fusion.monitoring.extrinsics_monitor import ExtrinsicsCorrection, ExtrinsicsMonitor, TrackedScene
from fusion.monitoring.frame_consistency import FrameConsistency
from fusion.monitoring.frozen_images import FrozenImages


class CameraMonitors:
    """The monitors of all cameras of a rig.

    Args:
        cameras: cameras of the rig; `check` and `place` change their poses.
        markers: of all robots.
        single: (R,) robots with a single marker.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable, single: Mask) -> None:
        self._cameras = cameras
        self.clocks = CameraClocks(cameras, markers, single)
        self.frozen = FrozenImages(cameras, markers)
        self.consistency = FrameConsistency(cameras, markers)
        self.extrinsics = ExtrinsicsMonitor()

    @property
    def withheld(self) -> set[str]:
        """Cameras whose frames `admit` refuses: their clocks are unknown, or their images frozen."""
        return self.clocks.excluded | self.frozen.names

    def inherit(self, old: "CameraMonitors") -> None:
        """Continue with the same cameras and other robots."""
        self.clocks.inherit(old.clocks)
        self.frozen.inherit(old.frozen)
        self.consistency.inherit(old.consistency)
        self.extrinsics = old.extrinsics

    def admit(self, frame: CalibratedFrame, now: Snapshot | None) -> CalibratedFrame | None:
        """A frame in corrected time; None while its camera is withheld, or if that time is in the future.

        Args:
            frame: the next one of its camera.
            now: the robots at the last frame set; None before the first.
        """
        admitted = self.clocks.admit(frame)
        return None if admitted is None or self.frozen.is_frozen(admitted, now) else admitted

    def used(self, frame_set: FrameSet) -> FrameSet:
        """The frame set without the frames of moved cameras."""
        excluded = self.extrinsics.excluded
        if not excluded:
            return frame_set
        return FrameSet(frame_set.t_ns, tuple(f for f in frame_set.frames if f.camera not in excluded))

    def observe(self, now: Snapshot, detections: DetectionTable, assignments: Assignments) -> None:
        """Compare the clocks in a frame set; see `CameraClocks.observe`."""
        is_doubtful = bool(self.consistency.in_doubt(now.t_ns) or self.extrinsics.excluded)
        self.clocks.observe(now, detections, assignments, is_doubtful)

    def check_extrinsics(
        self, frame_set: FrameSet, scene: TrackedScene, recalibrates: bool
    ) -> tuple[ExtrinsicsCorrection, ...]:
        """Exclude moved cameras and apply recalibrated poses; see `ExtrinsicsMonitor.check`."""
        corrections = self.extrinsics.check(frame_set, scene, recalibrates, self.clocks.suspects)
        for correction in corrections:
            if correction.camera is not None:
                self._cameras.place(correction.name, correction.camera)
                self.consistency.forget(correction.name)
                self.clocks.rebase()
        return corrections

    def place(self, name: str, camera: Camera, pinned: bool) -> None:
        """Replace the pose of a camera and use its detections; a pinned camera is not excluded again."""
        if camera.clock != self._cameras[name].clock:
            self.clocks.reset(name)
        self._cameras.place(name, camera)
        (self.extrinsics.pin if pinned else self.extrinsics.readmit)(name)
