# SPDX-License-Identifier: BSD-3-Clause
"""Monitors the camera poses: finds moved cameras, excludes their detections, and recalibrates them.

While two other cameras track a robot, the positions at which a camera should see its markers do not depend on that
camera. A camera that detects roundels, but hardly any of them at these positions, was moved. Its detections are
excluded until `recalibrate` finds its pose.

Each camera is compared in turn, just often enough to find a move within a second; an excluded one in every frame set.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Mask
from camera_node.geometry.pose import Pose
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray, MarkerTable
from fusion.model.states import States
from fusion.monitoring.expected_views import ExpectedViews
from fusion.monitoring.recalibration import ExpectedFrame, recalibrate, residual_px

AGREEMENT_PX = 2.0  # between an expected and a detected roundel of a camera that was not moved
MEMORY_NS = 700_000_000  # of the comparisons that decide about a camera
MIN_EXPECTED = 12  # markers in that time
MOVED_SHARE, CORRECT_SHARE = (
    0.3,
    0.6,
)  # of expected markers that agree: below, the camera moved; above, it did not
MIN_OTHERS = 2  # other cameras that must see a robot, and that must be correct
RECALIBRATION_MARKERS = 300  # expected markers from which a recalibration is tried
FRESH_NS = 4_000_000_000  # older frames of a moved camera are discarded
RETRY_NS = 300_000_000  # between recalibrations
MAX_KNOWN = 4  # poses of a camera, to which it may return
# By which the median residual of a known pose may be larger than that of the recalibration, if the other cameras are
# calibrated, and if one of them is recalibrated itself: to 1 to 3 mm.
EQUAL_PX, ROUGHLY_EQUAL_PX = 0.1, 0.5
MAX_COMPARED = 20  # markers of a frame
INTERVAL_NS = 250_000_000  # between comparisons with so many markers; shorter with fewer


@dataclass(frozen=True, slots=True, eq=False)
class TrackedScene:
    """Tracked robots and the cameras that observe them.

    Attributes:
        cameras: cameras of the rig.
        marker_table: markers of all robots.
        states: of the robots at the time of the frame set.
        tracked: (R,) robots with status `tracked`.
        robot_cameras: (R, C) which camera observed which robot.
    """

    cameras: CameraArray
    marker_table: MarkerTable
    states: States
    tracked: Mask
    robot_cameras: Mask


@dataclass(frozen=True, slots=True, eq=False)
class ExtrinsicsCorrection:
    """A camera was moved.

    Attributes:
        name: of the camera.
        camera: with the pose with which it is used again; None when it is excluded.
        has_returned: whether that pose is the one in use, or one before.
    """

    name: str
    camera: Camera | None
    has_returned: bool = False


@dataclass(slots=True)
class _MonitoredCamera:
    """Comparisons of one camera, and the frames for its recalibration.

    Attributes:
        comparisons: time, markers expected, those that agree, and roundels detected, at most as many as expected: what
            else a frame shows does not stand for the markers of a frame that shows nothing.
        views: frames after its exclusion.
        tried_ns: time of the last recalibration.
    """

    comparisons: deque[tuple[int, int, int, int]] = field(default_factory=deque)
    views: deque[ExpectedFrame] = field(default_factory=deque)
    tried_ns: int = 0

    def agreement(self) -> float | None:
        """The share of expected roundels that were detected; None if too few were expected or detected."""
        if not self.comparisons:
            return None
        _, expected, agreeing, detected = np.sum(self.comparisons, axis=0)
        return agreeing / expected if expected >= MIN_EXPECTED and detected >= expected / 2 else None


class ExtrinsicsMonitor:
    """Compares frames with tracked robots.

    Attributes:
        excluded: names of moved cameras that are not recalibrated yet.
        pinned: names of cameras whose poses a user confirmed; these are not excluded.
    """

    def __init__(self) -> None:
        self.excluded: set[str] = set()
        self.pinned: set[str] = set()
        self._cameras: dict[str, _MonitoredCamera] = {}
        self._known: dict[str, list[Pose]] = {}  # poses of each camera, that of the calibration first
        self._offset = 0  # rotates through more than MAX_COMPARED markers
        self._turns: dict[str, int] = {}  # of each camera at its last comparison

    def check(
        self,
        frame_set: FrameSet,
        scene: TrackedScene,
        recalibrates: bool,
        is_clock: Callable[[str], bool] = lambda name: False,
    ) -> tuple[ExtrinsicsCorrection, ...]:
        """Compare the frames that are due; returns the cameras to exclude, and those to recalibrate.

        Args:
            frame_set: including the frames of excluded cameras.
            scene: after the update with this frame set.
            recalibrates: False for a shard that waits for the poses from another.
            is_clock: whether a wrong clock explains the disagreement of a camera.
        """
        n_markers = int(scene.tracked[scene.marker_table.robot].sum())
        for frame in frame_set.frames:
            if self._is_due(frame, scene.cameras, n_markers):
                self._compare(frame, frame_set.t_ns, scene)
        corrections = []
        if (name := self._find_moved()) is not None and is_clock(name):
            self._use(name)
        elif name is not None:
            self.excluded.add(name)
            corrections.append(ExtrinsicsCorrection(name, None))
        for name in sorted(self.excluded) if recalibrates else ():
            if (correction := self._recalibrate(name, scene.cameras)) is not None:
                corrections.append(correction)
        return tuple(corrections)

    def remember(self, rigs: Iterable[Mapping[str, Camera]]) -> None:
        """Poses of cameras in earlier rigs, oldest first, to which these cameras may return."""
        for rig in rigs:
            for name, camera in rig.items():
                self._remember(name, camera)

    def inherit_poses(self, old: "ExtrinsicsMonitor") -> None:
        """The poses that another monitor of the same cameras knows, and those that a user confirmed."""
        self._known, self.pinned = old._known, old.pinned

    def _remember(self, name: str, camera: Camera) -> None:
        known = self._known.setdefault(name, [])
        if camera.T_world_cam is not None and camera.T_world_cam not in known:
            known.append(camera.T_world_cam)
            del known[1 : 1 - MAX_KNOWN]  # never the calibration's: the others are less accurate

    def readmit(self, name: str) -> None:
        """Use the detections of a camera that was calibrated again; its earlier poses are forgotten."""
        self._use(name)
        self._known.pop(name, None)

    def pin(self, name: str) -> None:
        """Readmit a camera whose pose a user confirmed; it is not excluded again."""
        self.readmit(name)
        self.pinned.add(name)

    def _use(self, name: str) -> None:
        """Use the detections of a camera again, and forget its comparisons."""
        self.excluded.discard(name)
        self._cameras.pop(name, None)

    def _is_due(self, frame: CalibratedFrame, cameras: CameraArray, n_markers: int) -> bool:
        """Whether it is the turn of the camera; the turns of the cameras are staggered."""
        interval_ns = INTERVAL_NS * min(n_markers, MAX_COMPARED) / MAX_COMPARED
        if frame.camera in self.excluded or not interval_ns:
            return True
        turn = int(frame.t_ns / interval_ns + cameras.index[frame.camera] / len(cameras.names))
        last, self._turns[frame.camera] = self._turns.get(frame.camera), turn
        return turn != last

    def _compare(self, frame: CalibratedFrame, t_ns: int, scene: TrackedScene) -> None:
        camera = scene.cameras.index[frame.camera]
        n_others = scene.robot_cameras.sum(1) - scene.robot_cameras[:, camera]
        markers = np.flatnonzero((scene.tracked & (n_others >= MIN_OTHERS))[scene.marker_table.robot])
        markers = np.roll(markers, -self._offset)[:MAX_COMPARED]
        self._offset += MAX_COMPARED + 1
        tau, rows = (frame.t_ns - t_ns) * 1e-9, (scene.marker_table, markers)
        expected = ExpectedViews.of(scene.cameras, frame.camera, scene.states, tau, rows, frame.readout_s)
        if len(expected.rows):
            self._note(scene.cameras[frame.camera], ExpectedFrame(frame, expected.points))

    def _note(self, camera: Camera, expected: ExpectedFrame) -> None:
        """Add the comparison of a frame; discard old ones."""
        frame = expected.frame
        monitored = self._cameras.setdefault(frame.camera, _MonitoredCamera())
        uv = camera.project_world(expected.points.T)
        off = np.linalg.norm(uv[:, None] - frame.roundels.uv[None], axis=2)
        agreeing = int((off.min(1, initial=np.inf) < AGREEMENT_PX).sum())
        detected = min(len(frame.roundels), len(uv))
        monitored.comparisons.append((frame.t_ns, len(uv), agreeing, detected))
        while monitored.comparisons[0][0] < frame.t_ns - MEMORY_NS:
            monitored.comparisons.popleft()
        if frame.camera in self.excluded:
            monitored.views.append(expected)
            while monitored.views[0].frame.t_ns < frame.t_ns - FRESH_NS:
                monitored.views.popleft()

    def _find_moved(self) -> str | None:
        """The one camera that disagrees while two or more others agree."""
        shares = {name: share for name, c in self._cameras.items() if (share := c.agreement()) is not None}
        correct = [
            name for name, share in shares.items() if share > CORRECT_SHARE and name not in self.excluded
        ]
        ignored = self.excluded | self.pinned
        moved = [name for name, share in shares.items() if share < MOVED_SHARE and name not in ignored]
        return moved[0] if len(moved) == 1 and len(correct) >= MIN_OTHERS else None

    def _recalibrate(self, name: str, cameras: CameraArray) -> ExtrinsicsCorrection | None:
        """The camera with its present pose, or None while its frames do not determine it."""
        monitored = self._cameras.get(name)
        if monitored is None or not monitored.views:
            return None
        views, now_ns = monitored.views, monitored.views[-1].frame.t_ns
        n_markers = sum(view.points.shape[1] for view in views)
        if now_ns - monitored.tried_ns < RETRY_NS or n_markers < RECALIBRATION_MARKERS:
            return None
        monitored.tried_ns = now_ns
        recalibrated = recalibrate(cameras[name], list(views))
        if recalibrated is not None:
            known = self._known_pose(recalibrated, name, cameras, list(views))
            self._use(name)
            return ExtrinsicsCorrection(name, known or recalibrated, known is not None)
        for _ in range(len(views) // 2):  # the camera may have been moving in the older ones
            views.popleft()
        return None

    def _known_pose(
        self, recalibrated: Camera, name: str, cameras: CameraArray, views: list[ExpectedFrame]
    ) -> Camera | None:
        """The camera with the first of its known poses that explains the views as well as the recalibration.

        Recalibration from some hundred markers is less accurate than a calibration, and its errors would add up.
        """
        for other in cameras.names:
            self._remember(other, cameras[other])
        is_rough = any(
            cameras[other].T_world_cam != self._known[other][0] for other in cameras.names if other != name
        )
        allowed_px = residual_px(recalibrated, views) + (ROUGHLY_EQUAL_PX if is_rough else EQUAL_PX)
        for pose in self._known[name]:
            known = msgspec.structs.replace(recalibrated, T_world_cam=pose)
            if residual_px(known, views) < allowed_px:
                return known
        return None
