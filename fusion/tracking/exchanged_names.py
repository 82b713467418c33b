# SPDX-License-Identifier: BSD-3-Clause
"""Finds cameras that have each other's names: devices may be numbered in another order after a restart.

A rig belongs to the names of its cameras. If the images of some come under other names, each of these shows what
another one should. The hypotheses are the orders of the names. By the right one, markers are seen by three cameras at
one place; by a wrong one, the rays of the exchanged cameras meet two others at one point only by chance. So the cameras
most of whose detections no two others explain are suspected, and the order of theirs that explains most is accepted if
it explains clearly more of each camera that it renames than other images in its place, which show what chance does.
"""

import logging
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, permutations

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.likeness import MIN_MARKERS
from fusion.model.observations import CameraArray, DetectionTable
from fusion.protocol.arena_health import describe_contradiction
from fusion.protocol.pose_messages import Contradiction
from fusion.rig_graph.hypotheses import CONFIRMED
from fusion.rig_graph.recorded_judgements import start
from fusion.tracking.marker_search import find_markers

log = logging.getLogger("fusion")
Order = dict[str, str]  # by the name under which images come, that of the camera in the rig that took them
MIN_CAMERAS = 3  # that see a marker: the rays of two meet by many orders
# Detections of a camera that the right order explains: as many more than by any images that are not its own, for which
# chance explains some.
CLEARLY, RATIO = 2, 1.5
MAX_PERMUTED = 4  # suspected cameras of which all orders are tried; of more, exchanges of two
MAX_SUSPECTED = 8  # of more, none is tried: the cameras see no common markers
LOOK_NS = 500_000_000  # from one look to the next, while they show something else than what is known
# Each look that shows nothing else doubles the pause up to this, and up to that while somebody starts nodes again.
MAX_PAUSE_NS, EXCHANGED_PAUSE_NS = 16_000_000_000, 2_000_000_000


class ExchangedNames:
    """Looks for exchanged cameras, at first often.

    Args:
        cameras: cameras of the rig.
        diameters: of all robots' discs, metres.

    Attributes:
        order: the names that are exchanged, if several looks in a row agreed.
        executor: looks beside the thread that tracks; None looks in it.
    """

    def __init__(self, cameras: CameraArray, diameters: Array) -> None:
        self._cameras, self._diameters = cameras, np.unique(diameters)
        self.executor: Executor | None = None
        self.order: Order = {}
        self._job: Future[Order | None] | None = None
        self._last: Order = {}
        self._n_agreed = 0
        self._due_ns, self._pause_ns = 0, LOOK_NS

    def inherit(self, old: "ExchangedNames") -> None:
        """Continue with the same cameras and other robots."""
        self.executor, self.order = old.executor, old.order
        self._last, self._n_agreed = old._last, old._n_agreed

    def without(self, frame_set: FrameSet) -> FrameSet:
        """The frame set without the frames of exchanged cameras."""
        if not self.order:
            return frame_set
        return replace(frame_set, frames=tuple(f for f in frame_set.frames if f.camera not in self.order))

    def check(self, frame_set: FrameSet) -> bool:
        """Look at a frame set if it is time, with the frames of all cameras; whether other names are exchanged now."""
        before = self.order
        self._take_job()
        is_due = self._job is None and frame_set.t_ns >= self._due_ns
        if is_due and len(self._diameters) and _count_showing(frame_set) >= MIN_CAMERAS:
            self._due_ns = frame_set.t_ns + self._pause_ns
            scene = self._cameras.stated(self._cameras.error_scale), self._diameters
            self._job = start(partial(find_order, frame_set, *scene, frozenset(self.order)), self.executor)
        return self.order != before

    def _take_job(self) -> None:
        if self._job is None or not self._job.done():
            return
        job, self._job = self._job, None
        try:
            self._note(job.result())
        except Exception:  # of a process that ended: the next frame sets are others
            log.exception("the names of the cameras can't be checked")

    def _note(self, found: Order | None) -> None:
        is_known = found is None or found == self.order
        longest_ns = EXCHANGED_PAUSE_NS if self.order else MAX_PAUSE_NS
        self._pause_ns = min(2 * self._pause_ns, longest_ns) if is_known else LOOK_NS
        if found is None:
            return
        self._n_agreed = self._n_agreed + 1 if found == self._last else 1
        self._last = found
        if self._n_agreed < CONFIRMED or found == self.order:
            return
        self.order = found
        for contradiction in self.contradictions():
            log.warning(describe_contradiction(contradiction))
        if not found:
            log.info("each camera shows what it should: no names are exchanged any more")

    def contradictions(self) -> tuple[Contradiction, ...]:
        """Each round of exchanged names: a camera shows what the next one should, the last what the first should."""
        return tuple(
            Contradiction(kind="names", names=names, error_over_claim=0.0, size_mm=0.0)
            for names in _cycles(self.order)
        )


def _count_showing(frame_set: FrameSet) -> int:
    return sum(frame.columns.shape[1] >= MIN_MARKERS for frame in frame_set.frames)


def _cycles(order: Mapping[str, str]) -> Iterator[tuple[str, ...]]:
    left = dict(order)
    while left:
        names = [next(iter(left))]
        while (following := left.pop(names[-1])) != names[0]:
            names.append(following)
        yield tuple(names)


@dataclass(frozen=True, slots=True)
class _Explained:
    """By camera: its detections, and how many of them two other cameras explain."""

    seen: dict[str, int]
    explained: dict[str, int]

    def is_most(self, name: str) -> bool:
        """Whether most of a camera's detections are explained."""
        return 2 * self.explained[name] > self.seen[name]

    @property
    def total(self) -> int:
        """Explained detections of all cameras."""
        return sum(self.explained.values())


def find_order(
    frame_set: FrameSet, cameras: CameraArray, diameters: Array, exchanged: Collection[str] = ()
) -> Order | None:
    """The names that are exchanged, by one frame set; empty if none are, None if that is not clear.

    Args:
        frame_set: the newest frame of each camera counts.
        cameras: cameras of the rig.
        diameters: (K,) of the discs, metres.
        exchanged: cameras that were until now: each must show what it should, so that none are.
    """
    frames = {frame.camera: frame for frame in frame_set.frames}
    as_named = _explain(frame_set.t_ns, frames, cameras, diameters)
    showing = [name for name, seen in as_named.seen.items() if seen >= MIN_MARKERS]
    suspected = [name for name in showing if not as_named.is_most(name)]
    if len(suspected) < 2:
        return {} if set(exchanged) <= set(showing) - set(suspected) else None
    if len(suspected) > MAX_SUSPECTED:
        return None
    tried = [(Order(), as_named)]
    for order in _orders(suspected):
        renamed = frames | {to: _renamed(frames[name], to, cameras) for name, to in order.items()}
        tried.append((order, _explain(frame_set.t_ns, renamed, cameras, diameters)))
    # A ring of cameras looks the same by orders that turn it: of these the one counts that renames fewest.
    best, by_best = max(tried, key=lambda t: (t[1].total, -len(t[0])))
    rivals = [(order, by_order) for order, by_order in tried if len(order) <= len(best)]

    def is_clear(name: str, of: str) -> bool:
        others = (by.explained[of] for order, by in rivals if order.get(name, name) != of)
        return by_best.explained[of] >= RATIO * max(others) + CLEARLY

    return best if best and all(is_clear(name, of) for name, of in best.items()) else None


def _orders(names: list[str]) -> Iterator[Order]:
    """Other orders of these names, of each those that it changes."""
    if len(names) > MAX_PERMUTED:
        yield from ({a: b, b: a} for a, b in combinations(names, 2))
        return
    for others in permutations(names):
        if order := {a: b for a, b in zip(names, others, strict=True) if a != b}:
            yield order


def _renamed(frame: CalibratedFrame, name: str, cameras: CameraArray) -> CalibratedFrame:
    """The frame as one of another camera, with its lens and its clock."""
    return replace(frame.recalibrated(cameras[frame.camera], cameras[name]), camera=name)


def _explain(
    t_ns: int, frames: Mapping[str, CalibratedFrame], cameras: CameraArray, diameters: Array
) -> _Explained:
    detections = DetectionTable.of(FrameSet(t_ns, tuple(frames.values())), cameras)
    markers = find_markers(cameras, detections, np.arange(len(detections)), diameters)
    rows = [m.detections for m in markers if len(np.unique(m.cameras)) >= MIN_CAMERAS]
    seen = _count(detections.frame, len(frames))
    explained = _count(detections.frame[np.concatenate([np.empty(0, np.intp), *rows])], len(frames))
    return _Explained(dict(zip(frames, seen, strict=True)), dict(zip(frames, explained, strict=True)))


def _count(frame: Index, n: int) -> list[int]:
    return [int(count) for count in np.bincount(frame, minlength=n)]
