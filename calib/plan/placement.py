# SPDX-License-Identifier: BSD-3-Clause
"""Suggests where to mount N cameras so that the expected error of robots is smallest.

The objective is Bayesian A-optimality (Chaloner and Verdinelli, 1995): the mean over the volume of the root mean square
error of a position whose prior has the standard deviation `BLIND_M` along each axis. A blind place has the prior's
error, so that precision and coverage are one figure. An exchange algorithm (Fedorov, 1972) chooses among candidates,
from several starts. To move and turn these by Powell's method afterwards gained 1 % with half as many candidates, and
nothing with these.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.plan.camera_kind import CameraKind
from calib.plan.description import Mount, Plan
from calib.plan.expected_error import RoundelSensor, Uncertainty, view_information
from calib.rig.camera import Camera
from camera_node.foundation.arrays import Array

BLIND_M = 0.05  # standard deviation of a position along an axis before any view
POINTS = 250  # of the volume, about
PLACES, AIMS = 64, 6  # candidates: places on the mounts, and points along each side of the area to look at
STARTS = 4  # of the exchange: from nothing, and from random cameras
MIN_GAP_M = 0.05  # between a camera and the point that it looks at
SEED = 1

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class SuggestedPlaces:
    """Suggested cameras.

    Attributes:
        positions_m, aims_m: (N, 3) positions, and the points in the middle of the images.
        cost_m: mean expected error, metres, where a blind place counts with the prior's error.
    """

    positions_m: Array
    aims_m: Array
    cost_m: float

    def cameras(self, kind: CameraKind) -> dict[str, Camera]:
        """The cameras by name."""
        pairs = zip(self.positions_m, self.aims_m, strict=True)
        return {f"camera-{k}": kind.placed(*pair) for k, pair in enumerate(pairs, 1)}


@dataclass(frozen=True)
class PlacementProblem:
    """What a placement is judged by.

    Attributes:
        plan: the arena.
        kind: of all cameras.
    """

    plan: Plan
    kind: CameraKind

    @cached_property
    def sensor(self) -> RoundelSensor:
        """How the cameras see roundels."""
        return RoundelSensor.of(self.plan, self.kind)

    @cached_property
    def points(self) -> Array:
        """(P, 3) points of the volume."""
        return self.plan.volume(POINTS).points

    def information(self, position: Array, aim: Array) -> Array:
        """(P, 6) information of one camera on positions at the points: xx, xy, xz, yy, yz, zz, per square metre."""
        if np.linalg.norm(aim - position) < MIN_GAP_M:
            return np.zeros((len(self.points), 6))
        uncertainty = Uncertainty(self.plan.image.sigma_px, self.plan.robots.speed_m_s)
        A = view_information(self.kind.placed(position, aim), self.sensor, self.points, uncertainty)
        return A[:, *np.triu_indices(3)]


def mean_error(information: Array) -> Array:
    """(...) mean over P points of the root mean square error, metres, by information (..., P, 6) and the prior."""
    a, b, c, d, e, f = np.moveaxis(information, -1, 0)
    prior = BLIND_M**-2
    a, d, f = a + prior, d + prior, f + prior
    minors = d * f - e * e, a * f - c * c, a * d - b * b
    determinant = a * minors[0] - b * (b * f - c * e) + c * (b * e - c * d)
    return np.sqrt(sum(minors) / determinant).mean(axis=-1)


def suggest_placement(
    problem: PlacementProblem, count: int, progress: Progress = lambda share: None
) -> SuggestedPlaces:
    """Place `count` cameras.

    Args:
        problem: the arena and the kind of camera.
        count: number of cameras, at least 1.
        progress: called with the share of the work that is done, 0 to 1.
    """
    candidates = _Candidates.of(problem, lambda share: progress(0.5 * share))
    rng = np.random.default_rng(SEED)
    starts = [[], *(rng.choice(len(candidates), count).tolist() for _ in range(STARTS - 1))]
    choices = []
    for k, start in enumerate(starts):
        choices.append(_exchange(candidates, start, count))
        progress(0.5 + 0.5 * (k + 1) / STARTS)
    best = min(choices, key=candidates.cost)
    return SuggestedPlaces(candidates.positions[best], candidates.aims[best], candidates.cost(best))


def evaluate_placement(problem: PlacementProblem, positions_m: Array, aims_m: Array) -> SuggestedPlaces:
    """The placement of cameras at positions (N, 3) that look at `aims_m` (N, 3), with its cost."""
    pairs = zip(positions_m, aims_m, strict=True)
    total = sum((problem.information(*pair) for pair in pairs), np.zeros((len(problem.points), 6)))
    return SuggestedPlaces(np.asarray(positions_m), np.asarray(aims_m), float(mean_error(total)))


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """C candidates: positions and aims (C, 3), and their information (C, P, 6) at the coarse points."""

    positions: Array
    aims: Array
    information: Array

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def of(cls, problem: PlacementProblem, progress: Progress) -> "_Candidates":
        """Every place with every aim; those that see nothing are left out."""
        places, aims = _places(problem.plan.mounts()), _aims(problem.plan)
        pairs = np.array([(place, aim) for place in places for aim in aims])
        rows = []
        for k, (place, aim) in enumerate(pairs):
            rows.append(problem.information(place, aim))
            progress((k + 1) / len(pairs))
        information = np.array(rows)
        useful = information.any(axis=(1, 2))
        useful = useful if useful.any() else np.ones(len(pairs), bool)
        return cls(pairs[useful, 0], pairs[useful, 1], information[useful])

    def cost(self, chosen: Sequence[int]) -> float:
        """The cost of some candidates."""
        return float(mean_error(self.information[list(chosen)].sum(axis=0)))


def _exchange(candidates: _Candidates, chosen: list[int], count: int) -> list[int]:
    """Add candidates up to `count`, then replace each by the best one for its place until none improves the cost."""
    while len(chosen) < count:
        chosen.append(_best_addition(candidates, chosen)[0])
    improved, cost = True, candidates.cost(chosen)
    while improved:
        improved = False
        for k in range(count):
            others = chosen[:k] + chosen[k + 1 :]
            best, best_cost = _best_addition(candidates, others)
            if best_cost < cost * (1 - 1e-6):
                chosen, cost, improved = [*others[:k], best, *others[k:]], best_cost, True
    return chosen


def _best_addition(candidates: _Candidates, chosen: Sequence[int]) -> tuple[int, float]:
    """The candidate with the smallest cost beside the chosen ones, and that cost."""
    base = candidates.information[list(chosen)].sum(axis=0)
    costs = mean_error(candidates.information + base)
    best = int(np.argmin(costs))
    return best, float(costs[best])


def _places(mounts: Sequence[Mount]) -> Array:
    """(C, 3) about `PLACES` places, evenly over the mounts; each mount has its corners."""
    sizes = [max(float(np.max(np.subtract(*reversed(m.corners)))), 1e-3) for m in mounts]
    rows = []
    for mount, size in zip(mounts, sizes, strict=True):
        low, high = mount.corners
        wide = max(2, round(PLACES * size / sum(sizes)))
        counts = [
            1 if b <= a else max(2, round(wide * (b - a) / size)) for a, b in zip(low, high, strict=True)
        ]
        while np.prod(counts) > max(wide, 4):
            counts[int(np.argmax(counts))] -= 1
        axes = [np.linspace(a, b, c) for a, b, c in zip(low, high, counts, strict=True)]
        rows.append(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3))
    places = np.unique(np.round(np.concatenate(rows), 6), axis=0).astype(np.float64)
    return places


def _aims(plan: Plan) -> Array:
    """(N, 3) points on the middle level of the volume."""
    x0, y0, x1, y1 = plan.area_m
    x, y = np.meshgrid(np.linspace(x0, x1, AIMS), np.linspace(y0, y1, AIMS))
    z = np.full(x.size, sum(plan.robots.heights_m) / 2)
    return np.column_stack([x.ravel(), y.ravel(), z]).astype(np.float64)
