# SPDX-License-Identifier: BSD-3-Clause
"""Verifies a calibration by an object of known size that was not used for it.

The scale is the weighted mean of measured over declared lengths. Lengths in one place share the errors of the rig, so
they do not average there: the places are random effects (DerSimonian and Laird 1986), with a Student interval. To its
variance are added that by the rig's covariance, where the rig has one, and that of the object's declared lengths.

The claims are the published covariances of the markers. A rigid fit of the object to its markers in one frame set has a
squared error over claim of chi-square. Frame sets of one visit to a place share errors as well: the degrees of freedom
are those of one frame set for each visit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import msgspec
import numpy as np
from scipy.special import chdtri, stdtrit

from calib.rig.camera import Camera
from calib.rig.precision_map import SIGMA_PX, FloorGrid, error_rows
from calib.rig.triangulation import JointCovariance, point_derivatives
from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.pose import rigid_motions, rotation_from_vector, skew
from fusion.diagnosis.known_object import ObjectFinder, Sighting
from fusion.errors import FusionError
from fusion.model.likeness import distances
from fusion.protocol.pose_messages import Markers

LENGTH_SIGMA_M = 0.0002  # of a length that is measured with a steel ruler
CONFIDENCE = 0.99  # of the intervals: one false warning in a hundred verifications
MIN_PLACES = 3  # of which the spread is known
VISIT_S = 1.0  # a longer gap ends a visit to a place
ITERATIONS = 4  # of the rigid fit
MAX_DERIVATIVES = 1000  # sightings from which the rig's part is computed
RANK = 1e-6  # relative: the rotation about the line of two markers has no effect


class Place(msgspec.Struct, frozen=True):
    """Lengths in one cell of the arena.

    Attributes:
        centre_m: of the cell, world.
        frame_sets: number of the frame sets.
        rms_mm: of the differences of measured and declared lengths.
        scale: mean of measured over declared lengths.
    """

    centre_m: tuple[float, float, float]
    frame_sets: int
    rms_mm: float
    scale: float


class Verification(msgspec.Struct, frozen=True, kw_only=True):
    """What an object of known size says about a calibration.

    Attributes:
        frame_sets, used: all, and those that show two markers of the object or more.
        scale: measured over declared lengths.
        scale_sigma: its standard deviation.
        scale_margin: half of the interval for `CONFIDENCE`.
        rig_sigma: the part of `scale_sigma` by the rig's covariance; None if the rig has none.
        rms_mm: of the differences of measured and declared lengths.
        error_over_claim: mean squared error of the markers over its claim, at the measured scale.
        degrees: its degrees of freedom.
        claim_bounds: the chi-square bounds of `error_over_claim` for `CONFIDENCE`.
        places: by cell of the arena, which has sides of `cell_m`.
        unused: what was not used, by the reason.
    """

    frame_sets: int
    used: int
    scale: float
    scale_sigma: float
    scale_margin: float
    rig_sigma: float | None
    rms_mm: float
    error_over_claim: float
    degrees: int
    claim_bounds: tuple[float, float]
    cell_m: float
    places: list[Place]
    unused: dict[str, int]

    @property
    def scale_holds(self) -> bool:
        return abs(self.scale - 1) <= self.scale_margin

    @property
    def claims_hold(self) -> bool:
        """Whether the errors are not larger than claimed; smaller ones are safe."""
        return self.error_over_claim <= self.claim_bounds[1]

    @property
    def holds(self) -> bool:
        return self.scale_holds and self.claims_hold

    def lines(self, file: str) -> list[str]:
        """The report, one line a subject; `file` is the object's."""
        return [
            f"{self.used} of {self.frame_sets} frame sets show {file}, "
            f"at {len(self.places)} places of {self.cell_m:g} m",
            *self._scale_lines(file),
            f"lengths differ by {self.rms_mm:.2f} mm (RMS)",
            *self._claim_lines(),
            *self.map_lines(),
            *(f"not used: {count} {reason}" for reason, count in sorted(self.unused.items())),
        ]

    def _scale_lines(self, file: str) -> list[str]:
        percent = 100 * (self.scale - 1)
        line = f"scale: lengths measure {percent:+.3f} % +- {100 * self.scale_sigma:.3f} % against {file}"
        if self.rig_sigma is None:
            line += "; the rig states no covariances, so its own uncertainty is not included"
        if self.scale_holds:
            return [f"{line}; no significant difference"]
        wand, own = ("long", "short") if percent > 0 else ("short", "long")
        return [
            line,
            f"warning: the difference is significant. Either the lengths that the calibration used (wand.yaml or "
            f"--distance) are {abs(percent):.2f} % too {wand}, or those in {file} are {abs(percent):.2f} % too {own}: "
            "measure both with one ruler and correct the file that is wrong; a corrected wand needs a new calibration",
        ]

    def _claim_lines(self) -> list[str]:
        low, high = self.claim_bounds
        line = (
            f"claims: mean squared error over claim {self.error_over_claim:.2f}, {self.degrees} degrees of freedom "
            f"({100 * CONFIDENCE:.0f} % bounds {low:.2f} to {high:.2f})"
        )
        if not self.claims_hold:
            times = self.error_over_claim**0.5
            return [
                line,
                f"warning: the claims do not hold: errors are {times:.1f} times the claimed standard deviations. "
                "Lenses, clocks or poses of cameras are off, or the object is bent; the map shows where",
            ]
        is_wide = self.error_over_claim < low
        return [f"{line}; {'errors are smaller than claimed' if is_wide else 'the claims hold'}"]

    def map_lines(self) -> list[str]:
        """The precision by place as text."""
        grid, errors_mm = self.floor_map()
        return ["RMS error of lengths in mm, all heights together:", *error_rows(grid, errors_mm)]

    def floor_map(self) -> tuple[FloorGrid, Array]:
        """The cells seen from above, and (Y, X) RMS errors of lengths, mm; infinite where there are none."""
        centres = np.array([place.centre_m for place in self.places])
        low, high = centres[:, :2].min(axis=0), centres[:, :2].max(axis=0)
        x, y = (
            a + self.cell_m * np.arange(round((b - a) / self.cell_m) + 1)
            for a, b in zip(low, high, strict=True)
        )
        grid = FloorGrid(x, y, float(centres[:, 2].mean()))
        squares, counts = np.zeros((2, len(y), len(x)))
        column, row = np.round((centres[:, :2] - low) / self.cell_m).astype(int).T
        n = np.array([place.frame_sets for place in self.places])
        np.add.at(squares, (row, column), n * np.array([place.rms_mm for place in self.places]) ** 2)
        np.add.at(counts, (row, column), n)
        errors_mm = np.full(counts.shape, np.inf)
        errors_mm[counts > 0] = np.sqrt(squares[counts > 0] / counts[counts > 0])
        return grid, errors_mm

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        verdict = {"holds": self.holds, "scale_holds": self.scale_holds, "claims_hold": self.claims_hold}
        return {**verdict, **msgspec.to_builtins(self)}


@dataclass(frozen=True, slots=True, eq=False)
class _Lengths:
    """What the S sightings say about the scale.

    Attributes:
        scale, variance: (S,) of each, the variance by the claims of its markers.
        by_position: of each, (K, 3) derivatives of the scale by the positions of its markers.
        by_length: (S, M, M) derivatives by the declared lengths.
        middle: (S, 3) mean positions.
        squared_mm2: (S,) mean squared differences of measured and declared lengths.
    """

    scale: Array
    variance: Array
    by_position: list[Array]
    by_length: Array
    middle: Array
    squared_mm2: Array


class Verifier:
    """Is fed the markers of frame sets, and reports.

    Args:
        body: the object.
        cameras: the placed cameras by which the markers were located.
        length_sigma_m: standard deviation of the object's declared lengths, metres.

    Raises:
        ConfigError: the object has too few or too many markers.
    """

    def __init__(
        self, body: WandBody, cameras: Mapping[str, Camera], length_sigma_m: float = LENGTH_SIGMA_M
    ) -> None:
        self._body, self._cameras, self._length_sigma_m = body, cameras, length_sigma_m
        self._finder = ObjectFinder(body, list(cameras))

    def add(self, markers: Markers) -> None:
        """Take the markers of a frame set."""
        self._finder.add(markers)

    def report(self) -> Verification:
        """What the frame sets say together.

        Raises:
            FusionError: the object was not seen in enough places.
        """
        sightings = self._finder.sightings()
        if not sightings:
            raise FusionError(self._why_not_seen())
        lengths = self._measure(sightings)
        cell_m = self._cell_m(lengths.middle[:, :2])
        cell = np.round(lengths.middle / cell_m).astype(int)
        cells, place = np.unique(cell, axis=0, return_inverse=True)
        if len(cells) < MIN_PLACES:
            raise FusionError(
                f"the object was seen at {len(cells)} places of {cell_m:g} m, in {len(sightings)} frame sets; errors "
                f"of the rig are common to a place: carry it through the whole arena, {MIN_PLACES} places or more"
            )
        scale, variance, share = _combine_places(lengths, place)
        rig_sigma = self._rig_sigma(sightings, lengths, share)
        object_sigma = self._length_sigma_m * np.sqrt(
            np.triu(np.einsum("s,sij->ij", share, lengths.by_length) ** 2).sum()
        )
        sigma = float(np.sqrt(variance + (rig_sigma or 0.0) ** 2 + object_sigma**2))
        ratio, degrees = self._compare_claims(sightings, scale, place)
        tail = np.array([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
        low, high = (chdtri(degrees, 1 - tail) / degrees).tolist()
        return Verification(
            frame_sets=self._finder.frame_sets,
            used=len(sightings),
            scale=scale,
            scale_sigma=sigma,
            scale_margin=sigma * float(stdtrit(len(cells) - 1, tail[1])),
            rig_sigma=rig_sigma,
            rms_mm=float(np.sqrt(lengths.squared_mm2.mean())),
            error_over_claim=ratio,
            degrees=degrees,
            claim_bounds=(low, high),
            cell_m=cell_m,
            places=_describe_places(lengths, cells * cell_m, place),
            unused={reason: count for reason, count in self._finder.unused.items() if count},
        )

    def _why_not_seen(self) -> str:
        unused = ", ".join(f"{n} {reason}" for reason, n in self._finder.unused.items() if n)
        return (
            f"no frame set of {self._finder.frame_sets} shows two markers of the object in motion"
            f"{f' ({unused})' if unused else ''}; carry it with its roundels towards the cameras, with ten "
            "frame sets a second or more, and check its lengths and its diameter_m; if it is declared as a robot, "
            "remove that robot"
        )

    def _cell_m(self, middle: Array) -> float:
        """The side of a place: not shorter than the object, because neighbours would measure the same space."""
        step = FloorGrid.covering(middle.min(axis=0), middle.max(axis=0), 0.0).step
        return max(step, float(distances(self._body.points).max()))

    def _measure(self, sightings: Sequence[Sighting]) -> _Lengths:
        declared = distances(self._body.points)
        rows = [_measure_one(sighting, declared) for sighting in sightings]
        scale, variance, by_position, by_length, squared = zip(*rows, strict=True)
        middle = np.array([sighting.position.mean(axis=0) for sighting in sightings])
        columns = np.array(scale), np.array(variance), list(by_position), np.array(by_length)
        return _Lengths(*columns, middle, np.array(squared))

    def _rig_sigma(self, sightings: Sequence[Sighting], lengths: _Lengths, share: Array) -> float | None:
        """The standard deviation of the scale by the rig's covariance; None if it has none."""
        cameras = list(self._cameras.values())
        if all(camera.covariance is None for camera in cameras):
            return None
        rows = np.unique(np.linspace(0, len(sightings) - 1, MAX_DERIVATIVES).round().astype(int))
        weight = share[rows] / share[rows].sum()
        joint = JointCovariance.stated(cameras)
        points = np.concatenate([sightings[k].position for k in rows])
        seen = np.concatenate([sightings[k].cameras for k in rows]).T
        known, _, by_camera = point_derivatives(cameras, points, SIGMA_PX, joint.parameters, seen)
        gradient = np.concatenate([w * lengths.by_position[k] for w, k in zip(weight, rows, strict=True)])
        total = np.einsum("ni,nic->c", gradient[known], by_camera)
        return float(np.sqrt(total @ joint.covariance @ total))

    def _compare_claims(self, sightings: Sequence[Sighting], scale: float, place: Index) -> tuple[float, int]:
        """The mean squared error over claim at this scale, and its degrees of freedom: of one frame set a visit."""
        points = scale * self._body.points
        costs = np.array([fit_rigidly(s.position, s.covariance, points[s.marker]) for s in sightings])
        later = [b.t_ns - a.t_ns > VISIT_S * 1e9 for a, b in pairwise(sightings)]
        visits = 1 + int((np.array(later, bool) | (np.diff(place) != 0)).sum())
        degrees = max(1, round(visits * costs[:, 1].mean()))
        return float(costs[:, 0].sum() / costs[:, 1].sum()), degrees


def fit_rigidly(position: Array, covariance: Array, points: Array) -> tuple[float, int]:
    """Fit a rigid body to its markers, weighted by their covariances.

    Args:
        position, covariance: (K, 3) and (K, 3, 3) of the markers.
        points: (K, 3) in the body's frame.

    Returns:
        the sum of squared residuals in standard deviations, and its degrees of freedom.
    """
    whiten: Array = np.linalg.inv(np.linalg.cholesky(covariance)).astype(float)
    T, rank = rigid_motions(points, position), 0
    R, t = T[:3, :3], T[:3, 3]
    for _ in range(ITERATIONS):
        residual, J = _whitened(whiten, position, points, R, t)
        step, _, rank, _ = np.linalg.lstsq(J, residual, rcond=RANK)
        R, t = rotation_from_vector(step[:3]) @ R, t + step[3:]
    residual, _ = _whitened(whiten, position, points, R, t)
    return float(residual @ residual), residual.size - int(rank)


def _whitened(whiten: Array, position: Array, points: Array, R: Array, t: Array) -> tuple[Array, Array]:
    """Residuals (3K,), and their Jacobian (3K, 6) by a rotation in the world about the body's origin and by t."""
    turned = points @ R.T
    residual = np.einsum("kij,kj->ki", whiten, position - turned - t)
    J = np.concatenate([-skew(turned), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
    return residual.ravel(), (whiten @ J).reshape(-1, 6)


def _measure_one(sighting: Sighting, declared: Array) -> tuple[float, float, Array, Array, float]:
    """The scale of one sighting by least squares of its lengths, with its variance and derivatives; see `_Lengths`."""
    i, j = np.array(list(combinations(range(len(sighting.marker)), 2))).T
    a, b = sighting.marker[i], sighting.marker[j]
    length = declared[a, b]
    away = sighting.position[j] - sighting.position[i]
    distance = np.linalg.norm(away, axis=1)
    along = away / distance[:, None]
    P = sighting.covariance[i] + sighting.covariance[j]
    weight = length / np.einsum("pi,pij,pj->p", along, P, along)
    weight /= (weight * length).sum()
    by_position = np.zeros_like(sighting.position)
    np.add.at(by_position, j, weight[:, None] * along)
    np.add.at(by_position, i, -weight[:, None] * along)
    variance = np.einsum("ki,kij,kj->", by_position, sighting.covariance, by_position)
    by_length = np.zeros_like(declared)
    by_length[np.minimum(a, b), np.maximum(a, b)] = weight
    squared_mm2 = 1e6 * float(((distance - length) ** 2).mean())
    return float(weight @ distance), float(variance), by_position, by_length, squared_mm2


def _combine_places(lengths: _Lengths, place: Index) -> tuple[float, float, Array]:
    """The scale over all places, its variance, and (S,) the share of each sighting.

    Within a place, a spread that is larger than claimed enlarges the variance of the mean.
    """
    n = place.max() + 1
    weight = 1 / lengths.variance
    total = np.bincount(place, weight, n)
    mean = np.bincount(place, weight * lengths.scale, n) / total
    inside = (weight * (lengths.scale - mean[place]) ** 2).sum() / max(len(place) - n, 1)
    variance = max(1.0, inside) / total
    fixed = 1 / variance
    excess = (fixed * (mean - (fixed * mean).sum() / fixed.sum()) ** 2).sum() - (n - 1)
    between = max(0.0, excess / (fixed.sum() - (fixed**2).sum() / fixed.sum()))
    of_place = 1 / (variance + between)
    scale = float((of_place * mean).sum() / of_place.sum())
    share = weight / total[place] * of_place[place] / of_place.sum()
    return scale, float(1 / of_place.sum()), share


def _describe_places(lengths: _Lengths, centres: Array, place: Index) -> list[Place]:
    places = []
    for k, (x, y, z) in enumerate(centres.tolist()):
        here = place == k
        rms_mm = float(np.sqrt(lengths.squared_mm2[here].mean()))
        places.append(Place((x, y, z), int(here.sum()), rms_mm, float(lengths.scale[here].mean())))
    return places
