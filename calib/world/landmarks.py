# SPDX-License-Identifier: BSD-3-Clause
"""Roundels that lie still at known places: found in a recording by their geometry, they fix the world.

Nobody needs to say which roundel is which: hypotheses come from three places whose distances three triangulated points
have (two, where the places lie on a line), and the one under which most places are seen by two cameras or more wins.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibrationError
from calib.rig.camera import Camera, transform
from calib.rig.triangulation import triangulate_point
from camera_node.arrays import Array, Mask
from camera_node.geometry.pose import rigid_motions
from camera_node.protocol.messages import Detections

STILL_PX = 2.0  # a roundel that lies still stays within
PRESENT = 0.3  # of a camera's frames, that a roundel must be in
FIT_PX = 6.0  # from where a place projects to, a roundel may be seen: rig, survey and camera all have errors
SLACK = (0.02, 0.03)  # of a distance between places: metres, and of the distance
LINE = 0.02  # second over first extent: below, places lie on a line


@dataclass(frozen=True, slots=True)
class Sighting:
    """A roundel that stayed where it is before one camera: its mean pixel (2,), and its number or -1."""

    camera: str
    uv: Array
    id: int


def still_roundels(messages: Sequence[Detections]) -> list[Sighting]:
    """The roundels of each camera that are in the same place in 30 % of its frames or more."""
    frames: dict[str, list[tuple[Array, NDArray[np.int32]]]] = {}
    for message in messages:
        columns = message.unpack()
        frames.setdefault(message.camera, []).append((columns.uv, columns.id))
    found = []
    for camera, seen in frames.items():
        uv, ids = (np.concatenate(part) for part in zip(*seen, strict=True))
        left = np.ones(len(uv), bool)
        while left.any():
            mine = _around(uv, left)
            left &= ~mine
            if mine.sum() >= max(PRESENT * len(seen), 1):
                found.append(Sighting(camera, uv[mine].mean(axis=0), int(np.median(ids[mine]))))
    return found


def _around(uv: Array, left: Mask) -> Mask:
    """Which of the pixels (N, 2) that are left stay with the first of them, which is always among them."""
    first = int(left.argmax())
    mine = left & (np.linalg.norm(uv - uv[first], axis=1) < STILL_PX)
    centre = np.median(uv[mine], axis=0)
    mine = left & (np.linalg.norm(uv - centre, axis=1) < STILL_PX)
    mine[first] = True
    return mine


def is_line(places: Array) -> bool:
    """Whether places (K, 3) lie on a line, or nearly."""
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(spread[1] < LINE * spread[0])


def locate_places(
    cameras: Mapping[str, Camera], sightings: Sequence[Sighting], places: Mapping[str, Array]
) -> dict[str, Array]:
    """Where roundels at known places are, in the world of the rig.

    Args:
        cameras: placed cameras.
        sightings: roundels that lie still; numbers are used where they are the names of places.
        places: (3,) metres by name, in a world of their own.

    Returns:
        (3,) metres in the rig's world, by name; places that fewer than two cameras see are missing.

    Raises:
        CalibrationError: no arrangement of the roundels has these distances, or two different ones have.
    """
    seen = [s for s in sightings if s.camera in cameras]
    if numbered := [s for s in seen if str(s.id) in places]:
        return _triangulate_all(cameras, {n: [s for s in numbered if str(s.id) == n] for n in places})
    points = _pair_points(cameras, seen)
    target = np.array(list(places.values()), float)
    best: list[tuple[tuple[int, float], dict[str, list[Sighting]]]] = []
    for T in _hypotheses(points, target):
        matched = _match(cameras, seen, dict(zip(places, transform(T, target), strict=True)))
        best.append((_score(cameras, matched, T, places), matched))
    if not best or max(score for score, _ in best)[0] < min(3, len(places)):
        raise CalibrationError(
            f"no {min(3, len(places))} of the roundels that lie still (by camera: {_tell(cameras, seen)}) have the "
            "distances of the places; do two cameras see each, is the file in metres, and is the rig's scale right?"
        )
    best.sort(key=lambda entry: entry[0], reverse=True)
    _require_unique(cameras, best)
    return _triangulate_all(cameras, best[0][1])


def _tell(cameras: Mapping[str, Camera], seen: Sequence[Sighting]) -> str:
    return ", ".join(f"{name} {sum(s.camera == name for s in seen)}" for name in sorted(cameras))


def _pair_points(cameras: Mapping[str, Camera], seen: Sequence[Sighting]) -> Array:
    """(N, 3) points at which two cameras' sightings may meet: most are nobody's, but the true ones are among them."""
    points = []
    for a, b in combinations(seen, 2):
        if a.camera == b.camera:
            continue
        pair = [cameras[a.camera], cameras[b.camera]]
        try:
            p = triangulate_point(pair, [a.uv, b.uv])
        except CalibrationError:
            continue
        off = [np.linalg.norm(c.project_world(p)[0] - s.uv) for c, s in zip(pair, (a, b), strict=True)]
        if max(off) < FIT_PX:
            points.append(p)
    return _merge(points)


def _merge(points: Sequence[Array]) -> Array:
    """(N, 3) the means of groups of points that lie within 2 cm of their first."""
    groups: list[list[Array]] = []
    for p in points:
        near = next((group for group in groups if np.linalg.norm(group[0] - p) < SLACK[0]), None)
        if near is None:
            groups.append([p])
        else:
            near.append(p)
    return np.array([np.mean(group, axis=0) for group in groups]).reshape(-1, 3)


def _hypotheses(points: Array, target: Array) -> Iterator[Array]:
    """Motions (4, 4) that bring three places (two, on a line) to points with the same distances."""
    count = 2 if is_line(target) else 3
    between = np.linalg.norm(points[:, None] - points[None], axis=2)
    for some in combinations(range(len(target)), count):
        chosen = target[list(some)]
        if count == 3 and is_line(chosen):
            continue
        for found in _with_distances(between, chosen):
            yield rigid_motions(chosen, points[list(found)])


def _with_distances(between: Array, places: Array) -> Iterator[tuple[int, ...]]:
    """Rows of points whose mutual distances are those of the places, in their order."""
    wanted = np.linalg.norm(places[:, None] - places[None], axis=2)
    near = [
        [np.abs(between - wanted[i, j]) < SLACK[0] + SLACK[1] * wanted[i, j] for j in range(len(places))]
        for i in range(len(places))
    ]
    for a, b in np.argwhere(near[0][1]):
        if len(places) == 2:
            yield int(a), int(b)
        else:
            yield from ((int(a), int(b), int(c)) for c in np.flatnonzero(near[0][2][a] & near[1][2][b]))


def _match(
    cameras: Mapping[str, Camera], seen: Sequence[Sighting], places: Mapping[str, Array]
) -> dict[str, list[Sighting]]:
    """For each place the nearest sighting of every camera, where it is near enough."""
    matched: dict[str, list[Sighting]] = {name: [] for name in places}
    for camera_name, camera in cameras.items():
        mine = [s for s in seen if s.camera == camera_name]
        if not mine:
            continue
        uv = camera.project_world(np.array(list(places.values())))
        gaps = np.linalg.norm(uv[:, None] - np.array([s.uv for s in mine])[None], axis=2)
        for row, name in enumerate(places):
            k = int(np.nanargmin(gaps[row])) if np.isfinite(gaps[row]).any() else -1
            if k >= 0 and gaps[row, k] < FIT_PX:
                matched[name].append(mine[k])
    return matched


def _score(
    cameras: Mapping[str, Camera], matched: dict[str, list[Sighting]], T: Array, places: Mapping[str, Array]
) -> tuple[int, float]:
    """Places that two cameras see, and less the mean distance of sightings from where places project to."""
    good = {name: s for name, s in matched.items() if len(s) >= 2}
    off = [
        np.linalg.norm(cameras[s.camera].project_world(transform(T, places[name]))[0] - s.uv)
        for name, mine in good.items()
        for s in mine
    ]
    return len(good), -float(np.mean(off)) if off else -np.inf


def _require_unique(
    cameras: Mapping[str, Camera], best: list[tuple[tuple[int, float], dict[str, list[Sighting]]]]
) -> None:
    """Raise where another assignment is as good as the best: then a turn of the places is anybody's guess."""
    (count, off), first = best[0]
    labels = _labels(first)
    for (other, other_off), matched in best[1:]:
        if other < count or other_off < 2 * off - 0.5:
            return
        if _labels(matched) != labels:
            raise CalibrationError(
                "the places can be seen in two ways (they look the same after a turn); use unequal distances, such "
                "as an L with legs of 0.3 m and 0.5 m, or number the roundels in the recording"
            )


def _labels(matched: dict[str, list[Sighting]]) -> dict[str, frozenset[int]]:
    return {name: frozenset(map(id, mine)) for name, mine in matched.items() if len(mine) >= 2}


def _triangulate_all(
    cameras: Mapping[str, Camera], matched: Mapping[str, Sequence[Sighting]]
) -> dict[str, Array]:
    found = {}
    for name, mine in matched.items():
        if len({s.camera for s in mine}) >= 2:
            found[name] = triangulate_point([cameras[s.camera] for s in mine], [s.uv for s in mine])
    return found
