# SPDX-License-Identifier: BSD-3-Clause
"""Suggests where to mount N cameras so that the expected error of robots is smallest.

The objective is Bayesian A-optimality (Chaloner and Verdinelli, 1995): the mean over the volume of the root mean square
error of a position whose prior has the standard deviation `BLIND_M` along each axis. A blind place has the prior's
error, so that precision and coverage are one figure. An exchange algorithm (Fedorov, 1972) chooses among candidates,
from several starts; Powell's method (SciPy) then moves and turns each camera in turn.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.plan.camera_kind import CameraKind
from calib.plan.description import Mount, Plan
from calib.plan.expected_error import RoundelSensor, Uncertainty, view_information
from calib.rig.camera import Camera
from camera_node.foundation.arrays import Array

BLIND_M = 0.05  # standard deviation of a position along an axis before any view
COARSE_POINTS, FINE_POINTS = 250, 700  # of the volume: for the exchange, and for Powell's method
PLACES, AIMS = 48, 5  # candidates: places on the mounts, and points along each side of the area to look at
STARTS = 4  # of the exchange: from nothing, and from random cameras
SWEEPS = 2  # of Powell's method over all cameras
EVALUATIONS = 60  # of the objective for one camera in one sweep
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
    sensor: RoundelSensor = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensor", RoundelSensor.of(self.plan, self.kind))

    def points(self, count: int) -> Array:
        """(P, 3) about so many points of the volume."""
        return self.plan.volume(count).points

    def information(self, position: Array, aim: Array, points: Array) -> Array:
        """(P, 6) information of one camera on positions at points (P, 3): xx, xy, xz, yy, yz, zz, per square metre."""
        if np.linalg.norm(aim - position) < MIN_GAP_M:
            return np.zeros((len(points), 6))
        uncertainty = Uncertainty(self.plan.image.sigma_px, self.plan.robots.speed_m_s)
        A = view_information(self.kind.placed(position, aim), self.sensor, points, uncertainty)
        return A[:, *np.triu_indices(3)]

    @property
    def mounts(self) -> list[Mount]:
        return self.plan.mounts()


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
    candidates = _Candidates.of(problem, lambda share: progress(0.3 * share))
    rng = np.random.default_rng(SEED)
    starts = [[], *(rng.choice(len(candidates), count).tolist() for _ in range(STARTS - 1))]
    choices = []
    for k, start in enumerate(starts):
        choices.append(_exchange(candidates, start, count))
        progress(0.3 + 0.2 * (k + 1) / STARTS)
    best = min(choices, key=candidates.cost)
    parameters = np.hstack([candidates.positions[best], candidates.aims[best]])
    return _refine(problem, parameters, lambda share: progress(0.5 + 0.5 * share))


def evaluate_placement(problem: PlacementProblem, positions_m: Array, aims_m: Array) -> SuggestedPlaces:
    """The placement of cameras at positions (N, 3) that look at `aims_m` (N, 3), with its cost."""
    points = problem.points(FINE_POINTS)
    pairs = zip(positions_m, aims_m, strict=True)
    total = sum((problem.information(*pair, points) for pair in pairs), np.zeros((len(points), 6)))
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
        points = problem.points(COARSE_POINTS)
        places, aims = _places(problem.mounts), _aims(problem.plan)
        pairs = np.array([(place, aim) for place in places for aim in aims])
        rows = []
        for k, (place, aim) in enumerate(pairs):
            rows.append(problem.information(place, aim, points))
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


def _refine(problem: PlacementProblem, parameters: Array, progress: Progress) -> SuggestedPlaces:
    """Move and turn each camera in turn by Powell's method; `parameters` (N, 6) are positions and aims."""
    points, n = problem.points(FINE_POINTS), len(parameters)
    views = np.array([problem.information(p[:3], p[3:], points) for p in parameters])
    for step in range(SWEEPS * n):
        k = step % n
        others = views.sum(axis=0) - views[k]
        parameters[k] = _improve(problem, parameters[k], points, others)
        views[k] = problem.information(parameters[k, :3], parameters[k, 3:], points)
        progress((step + 1) / (SWEEPS * n))
    return SuggestedPlaces(parameters[:, :3], parameters[:, 3:], float(mean_error(views.sum(axis=0))))


def _improve(problem: PlacementProblem, start: Array, points: Array, others: Array) -> Array:
    """(6,) position and aim of one camera beside the information (P, 6) of the others.

    The camera stays on its mount; its aim moves on the level of the middle of the volume.
    """
    from scipy.optimize import minimize

    low, high = _mount_of(problem.mounts, start[:3]).corners
    x0, y0, x1, y1 = problem.plan.area_m
    low, high = np.append(low, [x0, y0]), np.append(high, [x1, y1])
    free = high > low

    def camera_at(x: Array) -> Array:
        full = np.append(start[:3], start[3:5])
        full[free] = low[free] + np.clip(x, 0, 1) * (high - low)[free]
        return np.append(full, start[5])

    def cost(x: Array) -> float:
        p = camera_at(x)
        return float(mean_error(others + problem.information(p[:3], p[3:], points)))

    x0_ = np.clip((np.append(start[:3], start[3:5]) - low)[free] / (high - low)[free], 0, 1)
    result = minimize(
        cost, x0_, method="Powell", bounds=[(0, 1)] * len(x0_), options={"maxfev": EVALUATIONS, "xtol": 1e-2}
    )
    return camera_at(result.x) if result.fun < cost(x0_) else camera_at(x0_)


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
    """(25, 3) points on the middle level of the volume."""
    x0, y0, x1, y1 = plan.area_m
    x, y = np.meshgrid(np.linspace(x0, x1, AIMS), np.linspace(y0, y1, AIMS))
    z = np.full(x.size, sum(plan.robots.heights_m) / 2)
    return np.column_stack([x.ravel(), y.ravel(), z]).astype(np.float64)


def _mount_of(mounts: Sequence[Mount], position: Array) -> Mount:
    """The mount nearest to a position (3,)."""

    def gap(mount: Mount) -> float:
        low, high = mount.corners
        return float(np.linalg.norm(position - np.clip(position, low, high)))

    return min(mounts, key=gap)
