# SPDX-License-Identifier: BSD-3-Clause
"""Moves the world of a rig to landmarks: stationary roundels at known places, of an L-shaped frame, a standing wand, or
a survey.

Roundels need no numbers: landmarks are found by their mutual distances. Hypotheses are the motions that bring three
landmarks to three triangulated points with the same mutual distances (two, if the landmarks lie on a line). The
hypothesis under which two cameras or more see most landmarks wins.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import Camera, span_dimension, transform
from calib.rig.rig import Rig
from calib.rig.triangulation import triangulate_points
from calib.world.still_roundels import StillRoundel, disc_centres, find_still_roundels
from calib.world.world_frame import align_positions, align_standing_wand, check_above
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.geometry.codes import PLAIN
from camera_node.geometry.pose import invert, rigid_motions
from camera_node.protocol.messages import Detections

FIT_PX = 6.0  # reprojection distance of a match: rig, survey and detection all have errors
MERGE_M = 0.02  # distance within which triangulated points are one
MAX_LISTED = 4  # points whose distances an error lists
FRAME, WAND = "the roundels of the L-frame", "the roundels of the wand"
SURVEY = "the surveyed points"  # what has the landmarks, in errors, unless it is a frame or a wand
DISTANCE_SLACK = (0.02, 0.03)  # of a distance between landmarks: metres, and fraction of the distance


def read_positions(path: Path, key: str = "camera") -> dict[str, Array]:
    """Read positions (3,) by name, metres, from a CSV or a YAML file.

    A CSV has the columns `key` (or `name`), x, y, z. A YAML file maps names to [x, y, z].

    Raises:
        ConfigError: the file is missing, a column is missing, a name occurs twice, or a coordinate is not a number.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        entries = load_yaml(path, dict[str, tuple[float, float, float]])
        return {name: np.array(position) for name, position in entries.items()}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return _read_csv(path, csv.DictReader(file), key)
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"{path} can't be read; it needs the columns {key},x,y,z") from None


def _read_csv(path: Path, reader: csv.DictReader, key: str) -> dict[str, Array]:
    columns = set(reader.fieldnames or ())
    key = key if key in columns else "name"
    if missing := {key, "x", "y", "z"} - columns:
        raise ConfigError(f"{path} lacks the column {', '.join(sorted(missing))}; it needs {key},x,y,z")
    positions: dict[str, Array] = {}
    for row in reader:
        if row[key] in positions:
            raise ConfigError(f"{path} names '{row[key]}' twice; remove one row")
        positions[row[key]] = _parse_point(row, path, reader.line_num)
    return positions


def _parse_point(row: Mapping[str, str], path: Path, line: int) -> Array:
    try:
        point = np.array([float(row[axis]) for axis in "xyz"])
    except (TypeError, ValueError):
        point = np.full(3, np.nan)
    if not np.isfinite(point).all():
        raise ConfigError(f"{path}, line {line}: x, y and z must be numbers, in metres")
    return point


@dataclass(frozen=True)
class WorldChange:
    """A rig in its new world.

    Attributes:
        rig: the moved rig.
        distances: of roundels or cameras from their surveyed positions, metres, by name.
        missing: names of the roundels that fewer than two cameras see, which were not used.
    """

    rig: Rig
    distances: dict[str, float] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)

    def origin_in(self, before: Rig) -> Array:
        """T_old_new (4, 4): the new origin and axes in the world of the rig before the change, of the same scale."""
        new = self.rig.placed()
        name = next(iter(before.placed().keys() & new.keys()))
        return before.cameras[name].matrix() @ invert(new[name].matrix())


def name_markers(body: Body) -> dict[str, Array]:
    """The markers of a body as landmarks: their names, as in `StillRoundel`, and positions (3,), metres."""
    names = [f"code {code}" if code != PLAIN else str(k) for k, code in enumerate(body.codes)]
    return dict(zip(names, body.points, strict=True))


def align_to_roundels(
    rig: Rig,
    landmarks: Mapping[str, Array],
    messages: Sequence[Detections],
    foot_m: float | None = None,
    of: str = SURVEY,
) -> WorldChange:
    """Move the world to stationary roundels.

    Args:
        rig: with placed cameras.
        landmarks: positions (3,) of the roundels in the new world, metres, by name.
        messages: detections of the cameras while the roundels stand still.
        foot_m: for a wand that stands upright: the height of its lowest roundel above the floor; None for roundels
            whose positions fix the world.
        of: what has the roundels, in errors, such as "the roundels of the L-frame".

    Raises:
        CalibrationError: the roundels are not found, or do not fix a world.
    """
    located = locate_landmarks(rig.placed(), find_still_roundels(messages), landmarks, of)
    missing = [name for name in landmarks if name not in located]
    if foot_m is not None:
        moved = align_standing_wand(rig, np.array(list(located.values())), foot_m)
        return WorldChange(moved, missing=missing)
    if len(located) < 3:
        raise CalibrationError(
            f"two cameras together see only {len(located)} of {of}, and a world needs three: let two cameras see all"
        )
    moved, distances = align_positions(rig, located, landmarks, "roundel")
    check_above(moved, landmarks)
    return WorldChange(moved, distances, missing)


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """A motion of the landmarks with the roundels that match: number of landmarks that two cameras or more see, mean
    reprojection distance in pixels, and the roundels by landmark."""

    count: int
    distance_px: float
    matches: dict[str, list[StillRoundel]]

    def assignment(self) -> dict[str, frozenset[int]]:
        """Identities of the roundels, of the landmarks that two cameras or more see."""
        return {name: frozenset(map(id, found)) for name, found in self.matches.items() if len(found) >= 2}


def locate_landmarks(
    cameras: Mapping[str, Camera],
    roundels: Sequence[StillRoundel],
    landmarks: Mapping[str, Array],
    of: str = SURVEY,
) -> dict[str, Array]:
    """Locate landmarks in the rig's world.

    Args:
        cameras: placed cameras.
        roundels: stationary roundels; one with the name of a landmark is that one.
        landmarks: surveyed positions (3,) by name, metres, in a frame of their own.
        of: what has the landmarks, in errors.

    Returns:
        (3,) metres in the rig's world, by name; landmarks that fewer than two cameras see are missing.

    Raises:
        CalibrationError: no arrangement of the roundels has these distances, or two different ones have.
    """
    roundels = [r for r in roundels if r.camera in cameras]
    named: dict[str, list[StillRoundel]] = {name: [] for name in landmarks}
    for roundel in roundels:
        named.get(roundel.name, []).append(roundel)
    if any(named.values()):
        return _triangulate(cameras, named)
    points = _triangulate_pairs(cameras, roundels)
    surveyed = np.array(list(landmarks.values()), float)
    hypotheses = [
        _match(cameras, roundels, dict(zip(landmarks, transform(T, surveyed), strict=True)))
        for T in _candidate_motions(points, surveyed)
    ]
    needed = min(3, len(landmarks))
    if max((h.count for h in hypotheses), default=0) < needed:
        counts = ", ".join(f"{name} {sum(r.camera == name for r in roundels)}" for name in sorted(cameras))
        found = _most_seen(cameras, roundels, points)
        if len(found) < needed:
            raise CalibrationError(
                f"two cameras together see only {len(found)} roundels that keep still, and {needed} of {of} are needed "
                f"(stationary roundels by camera: {counts}); lay all in the view of two cameras, and move nothing"
            )
        raise CalibrationError(
            f"no {needed} of the stationary roundels (by camera: {counts}) have the distances of {of}: "
            f"{_explain_distances(found, surveyed)}"
        )
    hypotheses.sort(key=lambda h: (h.count, -h.distance_px), reverse=True)
    _check_unique(hypotheses, of)
    return _triangulate(cameras, hypotheses[0].matches)


def _explain_distances(points: Array, surveyed: Array) -> str:
    """What is seen in place of the landmarks, and what to do."""
    expected = _list_distances(surveyed)
    if len(points) > MAX_LISTED:
        return f"these are {expected}; measure them again, and check the scale of the calibration"
    return (
        f"these are {expected}, the cameras see roundels at {_list_distances(points)}; lay the "
        "roundels as the file says and take others away, or correct the file"
    )


def _most_seen(cameras: Mapping[str, Camera], roundels: Sequence[StillRoundel], points: Array) -> Array:
    """The points that most cameras see: wrong pairs of roundels give points that two see."""
    seen = np.zeros(len(points))
    for name, camera in cameras.items():
        own = np.array([r.uv for r in roundels if r.camera == name]).reshape(-1, 2)
        if len(own) and len(points):
            away = np.linalg.norm(camera.project_world(points)[:, None] - own, axis=2)
            seen += (np.nan_to_num(away, nan=np.inf) < FIT_PX).any(axis=1)
    return points[seen == seen.max()] if len(points) else points


def _list_distances(points: Array) -> str:
    lengths = sorted(float(np.linalg.norm(a - b)) for a, b in combinations(points, 2))
    return ", ".join(f"{length:.2f}" for length in lengths) + " m"


def _triangulate_pairs(cameras: Mapping[str, Camera], roundels: Sequence[StillRoundel]) -> Array:
    """(N, 3) points where the rays of two cameras meet: most are wrong pairs, but all true points are included."""
    points = []
    own = {name: np.array([r.uv for r in roundels if r.camera == name]).reshape(-1, 2) for name in cameras}
    for a, b in combinations(cameras, 2):
        pair, count = [cameras[a], cameras[b]], (len(own[a]), len(own[b]))
        uv = np.array([np.repeat(own[a], count[1], axis=0), np.tile(own[b], (count[0], 1))])
        found = triangulate_points(pair, uv)
        off = [
            np.linalg.norm(c.project_world(found) - seen, axis=1) for c, seen in zip(pair, uv, strict=True)
        ]
        points += list(found[np.max(off, axis=0) < FIT_PX])  # False for NaN
    return _merge_points(points)


def _merge_points(points: Sequence[Array]) -> Array:
    """(N, 3) the means of groups of points within 2 cm of the first point of the group."""
    groups: list[list[Array]] = []
    for p in points:
        near = next((group for group in groups if np.linalg.norm(group[0] - p) < MERGE_M), None)
        if near is None:
            groups.append([p])
        else:
            near.append(p)
    return np.array([np.mean(group, axis=0) for group in groups]).reshape(-1, 3)


def _candidate_motions(points: Array, surveyed: Array) -> Iterator[Array]:
    """Motions (4, 4) that bring three landmarks (two, on a line) to points with the same mutual distances."""
    count = 2 if span_dimension(surveyed) < 2 else 3
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    for rows in combinations(range(len(surveyed)), count):
        chosen = surveyed[list(rows)]
        if count == 3 and span_dimension(chosen) < 2:
            continue
        for found in _rows_with_distances(distances, chosen):
            yield rigid_motions(chosen, points[list(found)])


def _rows_with_distances(distances: Array, chosen: Array) -> Iterator[tuple[int, ...]]:
    """Rows of the matrix of `distances` whose mutual distances are those of the chosen landmarks, in their order."""
    absolute, relative = DISTANCE_SLACK
    wanted = np.linalg.norm(chosen[:, None] - chosen[None], axis=2)
    near = [
        [np.abs(distances - wanted[i, j]) < absolute + relative * wanted[i, j] for j in range(len(chosen))]
        for i in range(len(chosen))
    ]
    for a, b in np.argwhere(near[0][1]):
        if len(chosen) == 2:
            yield int(a), int(b)
        else:
            yield from ((int(a), int(b), int(c)) for c in np.flatnonzero(near[0][2][a] & near[1][2][b]))


def _match(
    cameras: Mapping[str, Camera], roundels: Sequence[StillRoundel], landmarks: Mapping[str, Array]
) -> _Hypothesis:
    """Match each landmark (3,), in the rig's world, with the nearest roundel of every camera, if it is near enough.

    Two cameras see a point wherever the rays of different roundels meet. So where a camera sees a roundel that is none
    of the landmarks in place of one, more than two must see that landmark.
    """
    matches: dict[str, list[StillRoundel]] = {name: [] for name in landmarks}
    matched_px: dict[str, list[float]] = {name: [] for name in landmarks}
    against = dict.fromkeys(landmarks, 0)
    for camera_name, camera in cameras.items():
        own = [r for r in roundels if r.camera == camera_name]
        if not own:
            continue
        uv = camera.project_world(np.array(list(landmarks.values())))
        distances = np.linalg.norm(uv[:, None] - np.array([r.uv for r in own])[None], axis=2)
        distances = np.nan_to_num(distances, nan=np.inf)
        free = ~(distances < FIT_PX).any(axis=0)
        extent = float(np.nan_to_num(np.linalg.norm(uv[:, None] - uv, axis=2)).max())
        for name, row, inside in zip(landmarks, distances, camera.sees(uv), strict=True):
            if row.min() < FIT_PX:
                matches[name].append(own[int(row.argmin())])
                matched_px[name].append(float(row.min()))
            elif inside and (row[free] < extent).any():
                against[name] += 1
    counted = [px for name, px in matched_px.items() if len(px) >= max(2, 2 * against[name] + 1)]
    distance_px = float(np.mean(np.concatenate(counted))) if counted else np.inf
    return _Hypothesis(len(counted), distance_px, matches)


def _check_unique(hypotheses: Sequence[_Hypothesis], of: str) -> None:
    """Raise CalibrationError if another assignment is as good as that of the first hypothesis; the best come first."""
    best = hypotheses[0]
    for other in hypotheses[1:]:
        if other.count < best.count or other.distance_px > 2 * best.distance_px + 0.5:
            return
        if other.assignment() != best.assignment():
            raise CalibrationError(
                f"{of} match the roundels in two ways (they are symmetric); use unequal distances, such as an L with "
                "legs of 0.3 m and 0.5 m"
            )


def _triangulate(
    cameras: Mapping[str, Camera], matches: Mapping[str, Sequence[StillRoundel]]
) -> dict[str, Array]:
    number = {name: k for k, name in enumerate(cameras)}
    uv = np.full((len(cameras), len(matches), 2), np.nan)
    for column, found in enumerate(matches.values()):
        rows = [number[r.camera] for r in found]
        uv[rows, column] = disc_centres([cameras[r.camera] for r in found], found)
    seen = np.isfinite(uv).all(axis=2).sum(axis=0) >= 2
    names = [name for name, enough in zip(matches, seen, strict=True) if enough]
    points = triangulate_points(list(cameras.values()), uv[:, seen])
    if np.isnan(points).any():
        lost = names[int(np.isnan(points[:, 0]).argmax())]
        raise CalibrationError(
            f"the viewing rays of '{lost}' are nearly parallel, or meet behind the cameras"
        )
    return dict(zip(names, points, strict=True))
