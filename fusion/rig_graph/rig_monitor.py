# SPDX-License-Identifier: BSD-3-Clause
"""Finds cameras that were moved, and their new poses, from the robots of the last seconds.

    frame sets            -> `Keyframes`: with the robots around them
    every second or so    -> `judge`: which hypothesis about the cameras explains the keyframes?
    twice a second        -> `watch`: do errors of cameras explain more than before? then they are judged at once
    a pose, decided       -> the camera is excluded until its pose is known, then used with it
    undecided             -> the cameras that contradict each other are reported, and all are used as they are

No pose changes unless one hypothesis beats every other one: robots that follow a camera at fault make innocent cameras
look wrong.
"""

import logging
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
from scipy.special import chdtri

from calib.rig.camera import Camera
from calib.rig.camera_errors import USUAL_PX, with_errors
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import Pose
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement
from fusion.model.frames import FrameSet
from fusion.model.observations import CameraArray, MarkerTable
from fusion.model.states import FrameSetFit, Snapshot
from fusion.protocol.pose_messages import Contradiction
from fusion.rig_graph.clock_walk import ClockWalk, Departure
from fusion.rig_graph.hypotheses import (
    CAUSES,
    CONFIRMED,
    FALSE_ALARM,
    LARGE,
    MIN_FOR_PAIRS,
    Fit,
    Hypothesis,
    Verdict,
    Window,
    fit,
    retract,
)
from fusion.rig_graph.judgements import (
    WINDOWS,
    Judgement,
    Measured,
    Unexplained,
    Watched,
    blames_one_of_three,
    confirm,
    judge_latest,
    seeing,
    watch,
)
from fusion.rig_graph.keyframes import GATES_PX, Keyframes
from fusion.rig_graph.recorded_judgements import start
from fusion.rig_graph.refinement import Refinement
from fusion.rig_graph.robot_shapes import RobotShapes

log = logging.getLogger("fusion")
CHECK_NS = 500_000_000  # between two checks
SUSPICIOUS_NS = 200_000_000  # the same, while cameras contradict each other
# Of the time, while nothing changes: judgements, and `watch` between them. Both are measured in whole
# frame sets, so that they take less of a core: together 8 to 11 %, of 4 and of 8 cameras.
USUAL_SHARE, WATCH_SHARE = 0.06, 0.2
GREW = 1.5  # ratio of what other errors explain, now and at the last judgement, to judge again
MAX_SIGMA_PX = 0.3  # of an accepted pose, at the markers that show it
MAX_SIGMA_M = 0.004  # of its position: what the markers do not show must not be far off either
# Of that factor in a window that contradicts nothing: it shows a part of the arena; one in which all cameras take part
# that contradicted each other shows that they agree again.
FALL, AGREED_FALL = 0.5**0.125, 0.5
REMEMBERED_NS = 4_000_000_000  # moments; a camera is judged within three seconds
MAX_KNOWN = 4  # poses of a camera, to which it may return
DOUBTED_NS = 3_000_000_000  # of robots in view, which no two cameras see: the rig is not doubted any more


class RigMonitor:
    """Judges the cameras of a rig.

    Args:
        cameras: cameras of the rig.
        markers: of all robots.

    Attributes:
        excluded: names of moved cameras whose poses are not known yet.
        pinned: names of cameras whose poses a user confirmed; these do not change.
        contradicting: names of the cameras of which some are at fault, but the data do not decide which.
        clock_doubts: by camera, the offset of its clock, s, that keyframes show, until judgements confirm or refute it.
        refines: whether poses, lenses and the places of markers are corrected by what robots show of them.
        is_doubted: whether the rig may have changed since it was calibrated: nothing was judged yet, see `doubt`.
        is_settled: whether the last `check` judged what contradicts the predictions: no clock is searched for.
        executor: judges beside the thread that tracks; None judges in it, so that a run repeats exactly.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable) -> None:
        self._cameras, self._markers = cameras, markers
        self._keyframes = Keyframes(cameras, markers, max(WINDOWS))
        self._job: Future[Judgement | Unexplained | Watched | None] | None = None
        self._judged = 0  # jobs that were taken since they were asked for
        self._checked_ns = self._revision = self._n_undecided = 0
        self._pause_ns = self._watched_ns = self._watch_pause_ns = 0
        self._gain = self._judged_gain = 0.0  # of the last `watch`, and the least since a judgement began
        self._is_contradicted = False
        self._walk = ClockWalk(len(cameras.names))
        self._departures: tuple[Departure, ...] = ()
        self._shapes = RobotShapes(markers)
        self._has_placed = False
        self._given_ns = self._measured_ns = 0  # of the last keyframes of the last job, and of the walk
        self._clocks: list[int] = []  # the cameras of the last verdicts in a row about a clock
        self._refinement: Refinement | None = None  # of the cameras in use; None before their first window
        self._was_doubtful, self._doubtful_ns = False, -CHECK_NS  # in the last frame set; when it was last
        self._moments: deque[tuple[FrameSet, Snapshot]] = deque()
        self._moved: set[str] = set()  # the excluded cameras that showed most markers elsewhere
        self._given = cameras, markers  # to the job
        self._is_confirmed = False  # whether the job confirms a judgement
        self._is_of_wand = False  # whether what contradicts is the size of the rig
        self._size_m = 0.0  # of what contradicts, at the robots
        self._scale = 1.0  # of the rig's errors, accepted
        self._claimed = 1.0  # the same, larger while nothing is decided
        self._doubted: set[str] = set()  # cameras that contradicted each other when claims grew
        self._held = False  # whether robots agreed with the rig in a window since the start
        self.is_settled, self.refines, self.is_doubted = False, True, False
        self._seen_ns: int | None = None  # when robots were first located
        self.executor: Executor | None = None
        self._known: dict[str, list[Pose]] = {}  # poses of each camera, that of the calibration first
        self.excluded: set[str] = set()
        self.pinned: set[str] = set()
        self.contradicting: tuple[str, ...] = ()
        self.clock_doubts = dict[str, float]()

    def inherit(self, old: "RigMonitor", same: Mapping[int, int]) -> None:
        """Continue with the same cameras and other robots; `same` has old rows by new row."""
        self.inherit_poses(old)
        self._shapes.inherit(old._shapes, same)
        self.excluded, self.executor, self._walk = old.excluded, old.executor, old._walk
        self._moved, self._held = old._moved, old._held
        self._scale, self._claimed, self._doubted = old._scale, old._claimed, old._doubted
        self._refinement = old._refinement
        self.is_doubted, self._seen_ns = old.is_doubted, old._seen_ns
        self._cameras.count_errors(old._cameras.error_scale, old._cameras.size_error)

    def inherit_poses(self, old: "RigMonitor") -> None:
        """The poses that another monitor of the same cameras knows, and those that a user confirmed."""
        self._known, self.pinned, self.refines = old._known, old.pinned, old.refines

    def doubt(self) -> None:
        """Let claims count that the rig may have changed since it was calibrated, until robots are judged the first
        time. One camera contradicts nothing."""
        self.is_doubted = len(self._cameras.names) > 1

    def remember(self, rigs: Iterable[Mapping[str, Camera]]) -> None:
        """Poses of cameras in earlier rigs, oldest first, to which these cameras may return."""
        for rig in rigs:
            for name, camera in rig.items():
                self._remember(name, camera)

    def readmit(self, name: str) -> None:
        """Use a camera that was calibrated again; its earlier poses are forgotten."""
        self._use(name)
        self._known.pop(name, None)

    def pin(self, name: str) -> None:
        """Use a camera whose pose a user confirmed; it does not change any more."""
        self.readmit(name)
        self.pinned.add(name)

    @property
    def is_doubtful(self) -> bool:
        """Whether a camera is at fault, by more or other than its clock, or may be."""
        return bool(self.excluded) or self._is_contradicted

    def contradictions(self) -> tuple[Contradiction, ...]:
        """The cameras of which some are at fault, if several judgements did not decide which."""
        if not self.contradicting:
            return ()
        return (
            Contradiction(
                kind="wand" if self._is_of_wand else "undecided" if len(self.contradicting) > 1 else "camera",
                names=self.contradicting,
                error_over_claim=self._cameras.error_scale**2,
                size_mm=1e3 * self._size_m,
            ),
        )

    def take_departures(self) -> tuple[Departure, ...]:
        """The clocks that depart from the others, which are corrected from now on."""
        found, self._departures = self._departures, ()
        for departure in found:
            self._keyframes.retime(self._cameras.names[departure.camera], departure.at)
        return found

    @property
    def displaced_m(self) -> dict[int, float]:
        """By row of each robot whose markers are not where they are declared, the largest distance."""
        return self._shapes.displaced_m

    def take_placed(self) -> bool:
        """Whether markers are used at other places on their robots since the last call."""
        has_placed, self._has_placed = self._has_placed, False
        return has_placed

    def take_judged(self) -> int:
        """How many judgements were taken since the last call, for `RecordedJudgements`."""
        judged, self._judged = self._judged, 0
        return judged

    def jump(self, name: str, sigma_s: float, rate_sigma: float) -> None:
        """The stamps of a camera jumped, or may have; see `ClockWalk.jump`."""
        self._walk.jump(self._cameras.index[name], sigma_s, rate_sigma)
        self._forget()

    def add_rate(self, name: str, t_ns: int, rate: float, sigma: float) -> None:
        """The rate of a camera's corrected stamps by arrivals; see `ClockWalk.add_rate`."""
        self._walk.add_rate(t_ns, self._cameras.index[name], rate, sigma)

    def check(
        self,
        frame_set: FrameSet,
        now: Snapshot,
        fit: FrameSetFit,
        recalibrates: bool,
    ) -> tuple[ExtrinsicsCorrection | RigRefinement, ...]:
        """Judge the cameras if it is time; the cameras to exclude, and those to use with another pose.

        Args:
            frame_set: with the frames of excluded cameras.
            now: the robots after the update with this frame set.
            fit: of the robots to the frame set. When it begins to be doubtful, something changed: the keyframes before
                do not show what is now. Later, single frame sets may be, while robots follow the change in turns. If
                one camera alone is displaced several times, it moved, once the rig has held: the others show the
                robots where they are predicted.
            recalibrates: False for the server of a zone that takes the rig from another.
        """
        self.is_settled = False
        if self.is_doubted and now.tracked.any():
            self._seen_ns = now.t_ns if self._seen_ns is None else self._seen_ns
            self.is_doubted = now.t_ns < self._seen_ns + DOUBTED_NS
        if (excluded := self._exclude_displaced(fit.displaced)) is not None:
            return (excluded,)
        is_doubtful = fit.is_doubtful or bool(fit.displaced)
        if is_doubtful and now.t_ns > self._doubtful_ns + CHECK_NS:
            self._forget()
        self._doubtful_ns = now.t_ns if is_doubtful else self._doubtful_ns
        self._was_doubtful = is_doubtful
        self._remember_moment(frame_set, now)
        if self._keyframes.add(frame_set, now):
            self._judge(now.t_ns)
        return self._act_on_judgements(now.t_ns, recalibrates)

    def _act_on_judgements(
        self, now_ns: int, recalibrates: bool
    ) -> tuple[ExtrinsicsCorrection | RigRefinement, ...]:
        while self._job is not None and self._job.done():
            job, self._job = self._job, None
            self._judged += 1
            if self._revision != self._cameras.revision:
                return ()
            try:
                judged = job.result()
            except (
                Exception
            ):  # of a process that ended, or of a singular system: the next keyframes are others
                log.exception("the cameras can't be judged")
                return ()
            if isinstance(judged, Watched):
                self._watch_pause_ns = round((now_ns - self._watched_ns) / WATCH_SHARE)
                self._note_watched(judged)
                return ()
            self._pause_ns = round((now_ns - self._checked_ns) / USUAL_SHARE)
            self.is_doubted &= judged is None
            if isinstance(judged, Unexplained):
                self._note_unexplained(judged)
            elif judged is None:
                self._is_contradicted = True
            elif self._is_confirmed or self._moved or not blames_one_of_three(*judged[:2]):
                return self._act(*judged, recalibrates)
            else:  # moments are several MB, which no other judgement needs
                self._is_confirmed = True
                self._start(partial(confirm, judged, *self._given, tuple(self._moments)))
        return ()

    def _judge(self, now_ns: int) -> None:
        """Judge the newest keyframes, or only watch them, if it is time."""
        kept = tuple(self._keyframes.kept)
        if self._job is not None or len(kept) < min(WINDOWS):
            return
        if not any(len(keyframe.views) > 1 for keyframe in kept[-min(WINDOWS) :]):
            return  # one camera contradicts no other
        scene = self._cameras.stated(self._scale), self._markers
        self._revision = self._cameras.revision
        if now_ns >= self._checked_ns + self._wait_ns:
            self._checked_ns = self._watched_ns = now_ns
            self._judged_gain, self._is_confirmed = self._gain, False
            self._given, self._given_ns = scene, kept[-1].t_ns
            given = self._shapes, self._measured_ns, sorted(self._moved)
            self._start(partial(judge_latest, kept, *scene, *given))
        elif now_ns >= self._watched_ns + max(CHECK_NS, self._watch_pause_ns):
            self._watched_ns = now_ns
            self._start(partial(watch, kept[-min(WINDOWS) :], *scene))

    @property
    def _wait_ns(self) -> int:
        """From one judgement to the next."""
        if self.is_doubtful:
            return SUSPICIOUS_NS
        is_urgent = (
            self._was_doubtful
            or bool(self._walk.departed)
            or self._walk.is_suspicious
            or self._cameras.error_scale > self._scale  # claims grew, and nothing explains why
            or self._gain > max(1.0, GREW * self._judged_gain)
        )
        return CHECK_NS if is_urgent else max(CHECK_NS, self._pause_ns)

    def _exclude_displaced(self, displaced: Mapping[int, int]) -> ExtrinsicsCorrection | None:
        """While cameras contradict each other, or did so from the start, robots may be predicted by the one that
        moved. Judgements find it then, but not of three cameras, where the two that agree predict most robots."""
        is_judged = not self._held and len(self._cameras.names) > MIN_FOR_PAIRS
        if len(displaced) != 1 or len(self.contradicting) > 1 or is_judged:
            return None
        ((k, n_sets),) = displaced.items()
        name = self._cameras.names[k]
        if n_sets < CONFIRMED or name in self.excluded | self.pinned:
            return None
        self.excluded.add(name)
        self._moved.add(name)
        self._forget()
        return ExtrinsicsCorrection(name, None)

    def _start(self, job: Callable[[], Judgement | Unexplained | Watched | None]) -> None:
        self._job = start(job, self.executor)

    def _act(
        self, window: Window, verdict: Verdict, measured: Measured | None, recalibrates: bool
    ) -> tuple[ExtrinsicsCorrection | RigRefinement, ...]:
        if recalibrates and self.refines and (refined := self._refine(window, verdict, measured)):
            return (refined,)
        names = self._blamed(window, verdict)
        self.is_settled = verdict.cause != "clock"
        self._note_clocks(verdict, measured)
        self._note_shapes(verdict, measured)
        is_known = verdict.cause in ("pose", "clock")  # what is corrected
        is_open = verdict.is_of_rig or (bool(names) and not is_known)
        self._n_undecided = self._n_undecided + 1 if is_open else 0
        # Keyframes from before the change may make any hypothesis look right.
        if self._n_undecided == 1 and not self._was_doubtful:
            self._keyframes.clear()
        self._is_contradicted = bool(names) or self._n_undecided == 1
        self._held |= not self._is_contradicted
        if not is_known:
            self._scale_claims(window, verdict, names)
        if names:
            self._size_m = _claim_m(window) * verdict.misfit**0.5
        self._is_of_wand = verdict.is_of_size
        self._note_undecided(names if self._n_undecided >= CONFIRMED else self._underrated())
        if not self._is_contradicted:
            return self._returned(window)
        if verdict.cause != "pose" or names[0] in self.pinned:
            return ()
        moved = [name for name in names if name not in self.pinned]
        changes = tuple(ExtrinsicsCorrection(name, None) for name in moved if name not in self.excluded)
        self.excluded.update(moved)
        known = recalibrates and verdict.is_pose_known
        placed = self._place(window, verdict.fit, verdict.cameras[0]) if known else None
        if placed is None:
            return changes
        self._use(names[0])
        return (*changes, placed)

    def _refine(self, window: Window, verdict: Verdict, measured: Measured | None) -> RigRefinement | None:
        """Add a window that contradicts no pose to what is known of all errors; the rig with other poses and lenses if
        they are larger than it states."""
        is_explained = verdict.cause in ("focal", "shape") or (verdict.cause is None and not verdict.cameras)
        is_accepted = self._scale > 1.0 or not verdict.is_of_rig
        if measured is None or self.excluded or not (is_explained and is_accepted):
            return None
        refinement = self._refinement or Refinement(self._cameras.as_dict(), window.since)
        self._refinement = refinement
        refinement.widen(self._scale)
        if verdict.cause == "focal":
            refinement.free_lenses(verdict.cameras)
        self._walk.predict(measured.clocks[0][0])
        refinement.update(*measured.errors, *self._walk.offsets_at(measured.errors[0]))
        self._measured_ns = self._given_ns
        if not refinement.is_significant:
            return None
        refined = refinement.correct(self.pinned)
        self._remember_all()
        self._use_all()
        self._refinement = refinement
        return refined

    def _blamed(self, window: Window, verdict: Verdict) -> tuple[str, ...]:
        """The cameras that are at fault, or contradict each other: of three that see robots no single one, unless it is
        known why; all, by errors that are larger than stated, only if they are stated; all, if the rig has another
        size than the robots."""
        if verdict.cause is None and len(verdict.cameras) == 1 and len(seeing(window)) <= MIN_FOR_PAIRS:
            return tuple(seeing(window))
        if verdict.is_of_size:
            return window.names
        if verdict.fit.hypothesis.cause == "shape":  # which is corrected once several windows agree on it
            return ()
        if verdict.cause is None and verdict.fit.hypothesis.scale != 1.0 and not self._states_errors():
            return ()
        return tuple(window.names[k] for k in verdict.cameras)

    def _scale_claims(self, window: Window, verdict: Verdict, names: tuple[str, ...]) -> None:
        """Let claims count the errors of the rig as large as the window shows them, or as all windows do that can't
        correct them yet."""
        self._doubted |= set(names if names or not verdict.is_of_rig else window.names)
        fall = AGREED_FALL if self._doubted <= set(seeing(window)) else FALL
        is_confirmed = self._n_undecided > 1
        self._scale, self._claimed = next_scales(self._scale, self._claimed, verdict, is_confirmed, fall)
        if self._scale == self._claimed:
            self._doubted.clear()
        may_be = self._refinement.excess if self._refinement is not None else 1.0
        size_error = abs(verdict.size) or self._cameras.size_error * fall
        self._cameras.count_errors(max(self._claimed, may_be), size_error)

    def _note_unexplained(self, found: Unexplained) -> None:
        """Let claims count errors as large as the newest keyframes show them."""
        self._is_contradicted = True
        self._doubted.update(self._cameras.names)
        self._claimed = max(self._scale, self._scale * found.scale, AGREED_FALL * self._claimed)
        self._cameras.count_errors(self._claimed, self._cameras.size_error)

    def _states_errors(self) -> bool:
        return any(c.errors or c.covariance for c in self._cameras.as_dict().values())

    def _underrated(self) -> tuple[str, ...]:
        """The cameras, if their errors are larger than the rig states, or, where it states none, so large that markers
        may be mistaken."""
        least = LARGE if self._states_errors() else GATES_PX[-1] / USUAL_PX
        return self._cameras.names if self._claimed >= least else ()

    def _returned(self, window: Window) -> tuple[ExtrinsicsCorrection, ...]:
        """The excluded cameras that agree with the others, as they were: nothing is at fault in the window."""
        names = [name for name in seeing(window) if name in self.excluded]
        for name in names:
            self._use(name)
        return tuple(ExtrinsicsCorrection(name, self._cameras[name], has_returned=True) for name in names)

    def _note_watched(self, watched: Watched) -> None:
        self._gain, self._judged_gain = watched.gain, min(watched.gain, self._judged_gain)
        if watched.clock_gain > chdtri(1, FALSE_ALARM):
            offsets_s = watched.offsets_s.items()
            self.clock_doubts |= {self._cameras.names[k]: offset_s for k, offset_s in offsets_s}

    def _note_clocks(self, verdict: Verdict, measured: Measured | None) -> None:
        """Add a window that contradicts no pose and no lens to what is known of the clocks.

        While cameras contradict each other, a window contradicts nothing because their errors count as large: poses
        that drift would look like clocks. A jump of a clock is accepted once several verdicts in a row agree on it: a
        robot's own motion may look like one. Until then the camera's clock is as uncertain as the jump is large.
        """
        self._clocks = [*self._clocks, *verdict.cameras] if verdict.cause == "clock" else []
        if len(set(self._clocks)) > 1:
            self._clocks = self._clocks[-1:]
        k = verdict.cameras[0] if verdict.cause == "clock" else -1
        offset_s = abs(float(verdict.fit.errors[k, CAUSES["clock"]][0]))
        if k >= 0 and len(self._clocks) < CONFIRMED:
            self.clock_doubts[self._cameras.names[k]] = offset_s
            return
        if k >= 0:
            self._walk.jump(k, offset_s, 0.0)
        elif verdict.cameras or self.excluded or self.contradicting:
            return
        if measured is None:
            return
        self._measured_ns = self._given_ns
        is_used = False
        for equations in measured.clocks:
            is_used = self._walk.update(*equations)
        if is_used:
            self._departures = self._walk.take_departures()
            self.clock_doubts.clear()

    def _note_shapes(self, verdict: Verdict, measured: Measured | None) -> None:
        """Use the markers of robots where windows show them, if no camera may be at fault."""
        best = verdict.fit.hypothesis
        is_of_robots = best.cause in (None, "shape") and not best.cameras and not verdict.size
        if measured is None or not self.refines or self.excluded or not is_of_robots:
            return
        self._measured_ns = self._given_ns
        if self._shapes.use(measured.shapes):
            self._has_placed = True
            self._forget()

    def _note_undecided(self, names: tuple[str, ...]) -> None:
        """Log cameras that contradict each other when that begins, and when it ends."""
        if len(names) == 1 and names != self.contradicting:
            log.warning(
                "camera %s contradicts the other cameras: its lens changed, or it was moved; it is used as it is, "
                "and poses claim less; calibrate it again",
                *names,
            )
        elif names and not self.contradicting and self._is_of_wand:
            log.warning(
                "the rig is %.1f %% larger or smaller than the robots: the wand's lengths are wrong, or the markers of "
                "all robots; poses claim less; measure them, and calibrate again",
                100 * self._cameras.size_error,
            )
        elif names and not self.contradicting:
            log.warning(
                "cameras %s contradict each other, and the robots do not show which of them is at fault; all are used "
                "as they are, and poses claim less; move robots through all views, or calibrate again",
                ", ".join(names),
            )
        elif self.contradicting and not names:
            log.info("cameras %s agree again", ", ".join(self.contradicting))
        self.contradicting = names

    def _place(self, window: Window, best: Fit, k: int) -> ExtrinsicsCorrection | None:
        """The camera with the first of its known poses that explains the window, or else with that of the fit."""
        name = window.names[k]
        self._remember_all()
        for pose in self._known[name]:
            if pose == self._cameras[name].T_world_cam:
                continue
            T = window.T.copy()
            T[k] = pose.matrix()
            known = fit(replace(window, T=T), Hypothesis.of(None, (), len(window.names)))
            if known.cost - best.cost < best.variance * chdtri(6, FALSE_ALARM):
                camera = msgspec.structs.replace(self._cameras[name], T_world_cam=pose)
                return ExtrinsicsCorrection(name, camera, has_returned=True)
        covariance = best.covariance(k)[:6, :6]
        if (
            np.sqrt(np.diag(covariance)[3:].max()) > MAX_SIGMA_M
            or _sigma_px(window, best, covariance, k) > MAX_SIGMA_PX
        ):
            return None
        pose = Pose.from_matrix(retract(window.T, best.errors)[k])
        stated = tuple(map(tuple, covariance.tolist()))
        camera = msgspec.structs.replace(self._cameras[name], T_world_cam=pose, covariance=stated)
        joint = best.joint_covariance(window.prior, k)
        rig = with_errors(self._cameras.as_dict() | {name: camera}, joint)
        return ExtrinsicsCorrection(name, rig[name], rig=rig)

    def _remember_all(self) -> None:
        for name, camera in self._cameras.as_dict().items():
            self._remember(name, camera)

    def _remember(self, name: str, camera: Camera) -> None:
        known = self._known.setdefault(name, [])
        if camera.T_world_cam is not None and camera.T_world_cam not in known:
            known.append(camera.T_world_cam)
            del known[1 : 1 - MAX_KNOWN]  # never the calibration's: the others are less accurate

    def _remember_moment(self, frame_set: FrameSet, now: Snapshot) -> None:
        if len(self._cameras.names) > MIN_FOR_PAIRS + 1:  # of four cameras, one may see nothing
            return
        self._moments.append((frame_set, now))
        while self._moments[0][1].t_ns < now.t_ns - REMEMBERED_NS:
            self._moments.popleft()

    def _forget(self) -> None:
        """Drop the keyframes and what is judged by them."""
        self._keyframes.clear()
        self._job = None

    def _use(self, name: str) -> None:
        self.excluded.discard(name)
        self._moved.discard(name)
        self._use_all()

    def _use_all(self) -> None:
        """The poses of cameras are others: forget what was judged by the old ones."""
        self._forget()
        self._walk.forget_poses()
        self._refinement = None
        self._shapes.forget()
        self._is_contradicted, self._n_undecided = False, 0
        self._scale = self._claimed = 1.0
        self._cameras.count_errors(1.0, 0.0)
        self._doubted.clear()
        self._clocks.clear()
        self.clock_doubts.clear()
        self._moments.clear()
        self._note_undecided(())


def next_scales(
    accepted: float, claimed: float, verdict: Verdict, is_confirmed: bool, fall: float
) -> tuple[float, float]:
    """The factors of the rig's errors that is accepted and that claims have, after a verdict that finds no single
    camera at fault. Claims grow at once, and fall by `fall`."""
    found, holds = accepted * verdict.scale, bool(verdict.cameras) or verdict.is_of_rig
    accepted = found if verdict.is_of_rig and is_confirmed else max(1.0, accepted * (1.0 if holds else FALL))
    return accepted, max(accepted, found, claimed * (1.0 if holds else fall))


def _claim_m(window: Window) -> float:
    """RMS of the claimed errors of detections at the distance of their robots, metres."""
    seen, body = window.observations.detections, window.observations.discs.body
    range_m = np.linalg.norm(window.states.p[body] - window.T[window.camera, :3, 3], axis=1)
    pixel = np.sqrt(np.abs(seen.scale[0, 0] * seen.scale[1, 1] - seen.scale[0, 1] * seen.scale[1, 0]))
    return float(np.sqrt(np.mean(seen.variance_px2 * (range_m / pixel) ** 2)))


def _sigma_px(window: Window, best: Fit, covariance: Array, k: int) -> float:
    """RMS standard deviation, pixels, of the images of a camera's markers by the covariance (6, 6) of its pose."""
    mine = np.flatnonzero(window.camera == k)
    B, claimed_px2 = best.by_camera[mine, :, :6], window.observations.detections.variance_px2[mine]
    variance = np.einsum("nai,ij,naj->n", B, covariance, B) / 2 * claimed_px2
    return float(np.sqrt(variance.mean()))
