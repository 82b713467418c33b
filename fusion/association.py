# SPDX-License-Identifier: BSD-3-Clause
"""Which detection is of which marker, while robots are tracked.

Each marker is predicted into each frame at the frame's own time; within a gate of its covariance and apparent size,
detections are assigned globally, frame by frame: no detection is of two markers.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from fusion.estimator import Observations
from fusion.instants import Instant
from fusion.optics import Discs, Optics, Views
from fusion.robots import Robot
from fusion.state import States

Array = NDArray[np.float64]
Index = NDArray[np.intp]
GATE = 13.8  # chi-square with 2 degrees: one detection in a thousand is lost to it
SLACK_PX = 0.7  # what a calibration may be off, added to the gate
SIZE_RATIO = 1.35  # between the measured and the predicted major axis
GRAZING = 0.1  # cosine between the line of sight and the normal under which a print is not read
MARGIN_PX = 20.0  # how far outside an image a marker's centre is still looked for


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """All N detections of an instant: frame and camera index, tau (s), uv, cov, axes_px and angle_rad."""

    frame: Index
    camera: Index
    tau: Array
    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, rows: NDArray) -> "Sightings":
        """The rows that a mask or an index array names."""
        return Sightings(*(getattr(self, name)[rows] for name in self.__slots__))

    @classmethod
    def of(cls, instant: Instant, optics: Optics, floor_px: float) -> "Sightings":
        """The detections of an instant; `floor_px` is added to what detectors say of their noise."""
        frames = instant.frames
        counts = [len(frame.roundels) for frame in frames]
        row = np.repeat(np.arange(len(frames)), counts)
        camera = np.array([optics.index[frame.camera] for frame in frames], np.intp)
        tau = np.array([(frame.t_ns - instant.t_ns) * 1e-9 for frame in frames])
        empty = {"uv": (0, 2), "cov": (0, 2, 2), "axes_px": (0, 2), "angle_rad": (0,)}
        columns = {
            name: np.concatenate([np.zeros(shape), *(getattr(f.roundels, name) for f in frames)])
            for name, shape in empty.items()
        }
        columns["cov"] = columns["cov"] + floor_px**2 * np.eye(2)
        return cls(row, camera[row], tau[row], **columns)


@dataclass(frozen=True, slots=True, eq=False)
class Catalogue:
    """All K markers of all robots: the robot's index, the number in the robot, centre (K, 3) and radius (K,)."""

    robot: Index
    number: Index
    marker: Array
    radius: Array

    @classmethod
    def of(cls, robots: list[Robot]) -> "Catalogue":
        counts = [len(robot.markers) for robot in robots]
        return cls(
            np.repeat(np.arange(len(robots)), counts),
            np.concatenate([np.arange(n) for n in counts]).astype(np.intp),
            np.concatenate([robot.points for robot in robots]),
            np.repeat([robot.diameter_m / 2 for robot in robots], counts),
        )

    def discs(self, rows: Index, camera: Index, tau: Array) -> Discs:
        """Markers `rows` as cameras see them `tau` seconds from the instant."""
        return Discs(camera, self.robot[rows], self.marker[rows], self.radius[rows], tau)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Rows of the sightings, and the rows of the catalogue that they are of."""

    sighting: Index
    disc: Index

    def observations(self, sightings: Sightings, catalogue: Catalogue) -> Observations:
        """The matched detections for the estimator."""
        seen = sightings.select(self.sighting)
        discs = catalogue.discs(self.disc, seen.camera, seen.tau)
        return Observations(discs, seen.uv, seen.cov, seen.axes_px, seen.angle_rad)


def match(
    optics: Optics, states: States, catalogue: Catalogue, active: NDArray[np.bool_], sightings: Sightings
) -> Matches:
    """Match the detections of an instant to the markers of the robots that are `active` (N,)."""
    frames, first = np.unique(sightings.frame, return_index=True)
    markers = np.flatnonzero(active[catalogue.robot])
    if not len(frames) or not len(markers):
        return Matches(np.empty(0, np.intp), np.empty(0, np.intp))
    rows = np.tile(markers, len(frames))
    camera = np.repeat(sightings.camera[first], len(markers))
    tau = np.repeat(sightings.tau[first], len(markers))
    views = optics.view(states, catalogue.discs(rows, camera, tau))
    spread = views.jacobian @ states.P[catalogue.robot[rows]] @ views.jacobian.transpose(0, 2, 1)
    visible = _is_visible(views, camera, optics)
    found: list[tuple[Index, Index]] = []
    for k, frame in enumerate(frames):
        here = np.arange(k * len(markers), (k + 1) * len(markers))
        here = here[visible[here]]
        seen = np.flatnonzero(sightings.frame == frame)
        a, b = _assign(_costs(views, spread, here, sightings.select(seen)))
        found.append((seen[b], rows[here[a]]))
    return Matches(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _is_visible(views: Views, camera: Index, optics: Optics) -> NDArray[np.bool_]:
    inside = (views.uv > -MARGIN_PX) & (views.uv < optics.sizes[camera] + MARGIN_PX)
    return inside.all(1) & (views.facing > GRAZING)  # NaN, behind the camera, is not inside


def _costs(views: Views, spread: Array, here: Index, seen: Sightings) -> Array:
    """(M, N) squared Mahalanobis distances; infinite outside the gate."""
    error = seen.uv[None] - views.uv[here, None]
    S = spread[here, None] + seen.cov[None] + SLACK_PX**2 * np.eye(2)
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2
    u, v = error[..., 0], error[..., 1]
    d2 = (S[..., 1, 1] * u * u - 2 * S[..., 0, 1] * u * v + S[..., 0, 0] * v * v) / det
    with np.errstate(invalid="ignore"):
        size = np.abs(np.log(seen.axes_px[None, :, 0] / views.major_px[here, None]))
        outside = (d2 > GATE) | (size > np.log(SIZE_RATIO))  # an unknown size, NaN, excludes nothing
    return np.where(outside, np.inf, d2)


def _assign(costs: Array) -> tuple[Index, Index]:
    """The rows and columns of the cheapest assignment with as many pairs as there can be."""
    open_ = np.isfinite(costs)
    if (open_.sum(0) <= 1).all() and (open_.sum(1) <= 1).all():
        a, b = np.nonzero(open_)
        return a, b
    a, b = linear_sum_assignment(np.where(open_, costs, 1e6))
    kept = open_[a, b]
    return a[kept], b[kept]
