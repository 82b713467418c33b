# SPDX-License-Identifier: BSD-3-Clause
"""Compares the places where each camera stops to detect roundels with the predicted edges of what it sees."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.plan.expected_error import RoundelSensor
from calib.plan.planner import PlannedArena
from calib.rig.camera import Camera
from camera_node.detector import Detector
from camera_node.foundation.arrays import Array
from camera_node.foundation.terminal import track
from camera_node.simulation.renderer import Renderer
from tests.benchmarks.plan.arena import DIAMETER_M, HALF_M, HEIGHTS_M, image_of, planned_arena, write_scene

REACH_M = 0.15  # half length of paths through edges of the image
FAR_M = 0.75  # half length of paths through limits of size and slant
STEPS = 31  # of a path
PERIOD_S = 1000.0  # of the motion along a path: so slow that no roundel blurs, as in the prediction


@dataclass(frozen=True)
class CoverageResult:
    """Signed distances (N,), metres, of measured from predicted edges: positive where the camera sees farther.

    They are infinite where detection does not end on the path. `by_image` (N,) marks edges of the image; the others are
    limits of size and slant.
    """

    distance_m: Array
    by_image: np.ndarray


@dataclass(frozen=True)
class EdgePath:
    """A path through a predicted edge at `middle` (3,) along `outward` (3,), and whether the image ends there."""

    middle: Array
    outward: Array
    by_image: bool

    @property
    def reach_m(self) -> float:
        """Half of the path's length: detection ends less sharply at limits of size."""
        return REACH_M if self.by_image else FAR_M


@dataclass(frozen=True)
class EdgeSteps:
    """What one camera detects at one step of K paths.

    Attributes:
        step_m: the step, relative to the predicted edge.
        inset: (K,) distances of the centres from the border of the image, in half extents.
        sigma_px: (K,) standard deviations that the detector reports, NaN where it detects nothing.
        expected_px: (K,) standard deviations of complete roundels of the same size.
    """

    step_m: float
    inset: Array
    sigma_px: Array
    expected_px: Array


def measure_coverage(edges: int, diameter_m: float = DIAMETER_M, seed: int = 2) -> CoverageResult:
    """Find where each camera stops to detect roundels on paths through its predicted edges."""
    arena, rng = planned_arena(diameter_m), np.random.default_rng(seed)
    rows = []
    for name in arena.cameras:
        for part in _groups(find_edges(arena, name, edges, rng)):
            steps = list(follow(arena, name, part))
            found = np.array([np.isfinite(one.sigma_px) for one in steps])
            at = np.array([one.step_m for one in steps])
            rows += [(_edge(at, found[:, j]), path.by_image) for j, path in enumerate(part)]
    return CoverageResult(np.array([d for d, _ in rows]), np.array([i for _, i in rows], bool))


def _groups(paths: Sequence["EdgePath"]) -> list[list["EdgePath"]]:
    """Paths of one kind, few together, so that their roundels overlap rarely."""
    kinds = ([path for path in paths if path.by_image == kind] for kind in (True, False))
    return [some[k : k + 8] for some in kinds for k in range(0, len(some), 8)]


def find_edges(arena: PlannedArena, name: str, count: int, rng: np.random.Generator) -> list[EdgePath]:
    """Predicted edges of what one camera sees, where random level paths of the volume cross them."""
    camera, sensor = arena.cameras[name], arena.sensors()[name]
    paths: list[EdgePath] = []
    for _ in range(50 * count):
        start = rng.uniform([-2 * HALF_M, -2 * HALF_M, HEIGHTS_M[0]], [2 * HALF_M, 2 * HALF_M, HEIGHTS_M[1]])
        angle = rng.uniform(0, 2 * np.pi)
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        s = np.arange(0, 4.0, 0.002)
        seen = np.zeros(len(s), bool)
        seen[sensor.view(camera, start + s[:, None] * outward).rows] = True
        ends = np.flatnonzero(seen[:-1] & ~seen[1:])
        if len(ends) and len(paths) < count:
            middle = start + s[ends[0]] * outward
            uv, radius = image_of(camera, middle[None], arena.plan.robots.diameter_m)
            border = np.min([uv[0], [camera.width, camera.height] - uv[0]])
            paths.append(EdgePath(middle, outward, bool(border < 2 * radius[0])))
    return paths


def follow(arena: PlannedArena, name: str, paths: Sequence[EdgePath]) -> Iterator[EdgeSteps]:
    """Render each step of all paths in one picture, and detect the roundels in it as in a first frame."""
    camera, sensor = arena.cameras[name], arena.sensors()[name]
    reach_m = paths[0].reach_m
    steps = np.linspace(-reach_m, reach_m, STEPS)
    with tempfile.TemporaryDirectory() as folder:
        motions = {f"r{k}": _line(path) for k, path in enumerate(paths)}
        scene = write_scene(Path(folder), {name: camera}, motions, sensor.pattern.d_o)
        renderer = Renderer(scene, name)
        for frame, s in enumerate(track(steps, f"edges of {name}")):
            t_s = PERIOD_S * (1.0 + float(np.arcsin(s / (2 * reach_m))) / (2 * np.pi))
            roundels = Detector().detect(renderer.render(t_s, frame))
            places = np.array([path.middle + s * path.outward for path in paths])
            uv, radius = image_of(camera, places, sensor.pattern.d_o)
            inset, expected = _expected(sensor, camera, places)
            sigma = np.full(len(paths), np.nan)
            if len(roundels):
                gaps = np.linalg.norm(roundels.uv[:, None] - uv[None], axis=2)
                nearest = gaps.argmin(axis=0)
                found = gaps.min(axis=0) < radius
                sigma[found] = np.sqrt(np.trace(roundels.cov[nearest[found]], axis1=1, axis2=2))
            yield EdgeSteps(float(s), inset, sigma, expected)


def _expected(sensor: RoundelSensor, camera: Camera, places: Array) -> tuple[Array, Array]:
    """Insets (K,) of roundels at places (K, 3), and standard deviations (K,), pixels, if they were complete."""
    T = camera.matrix()
    uv, J = camera.project_with_jacobian((places - T[:3, 3]) @ T[:3, :3])
    affine = sensor.pattern.d_o / 2 * (J @ T[:3, :3].T)[:, :, :2]
    size = np.array([camera.width, camera.height])
    inset = (np.minimum(uv + 0.5, size - 0.5 - uv) / np.linalg.norm(affine, axis=2)).min(axis=1)
    axes = 2 * np.linalg.svd(affine)[1]
    return inset, np.sqrt(sensor.centre_variances(axes).sum(axis=1))


def measure_cut(edges: int, seed: int = 3) -> list[tuple[float, float, int]]:
    """Of insets in steps of 0.2: the lower limit, the median reported sigma over that of complete roundels, and the
    number of detections. Complete ones are those with an inset of 1 to 1.3 on the same paths."""
    arena, rng = planned_arena(), np.random.default_rng(seed)
    rows = []
    for name in arena.cameras:
        for part in _groups(find_edges(arena, name, edges, rng)):
            for one in follow(arena, name, part):
                rows += zip(one.inset, one.sigma_px / one.expected_px, strict=True)
    inset, ratio = np.array([row for row in rows if np.isfinite(row[1])]).T
    complete = np.median(ratio[(inset >= 1) & (inset < 1.3)])
    bins = [(low, (inset >= low) & (inset < low + 0.2)) for low in (0.1, 0.3, 0.5, 0.7, 0.9)]
    return [(low, float(np.median(ratio[b]) / complete), int(b.sum())) for low, b in bins if b.any()]


def _line(path: EdgePath) -> dict[str, Any]:
    """A motion through the edge: middle + 2 reach sin(2 pi t / period) outward."""
    return {
        f"{axis}_m": {
            "mean": path.middle[k],
            "amplitude": 2 * path.reach_m * path.outward[k],
            "period_s": PERIOD_S,
        }
        for k, axis in enumerate("xyz")
    }


def _edge(steps: Array, found: np.ndarray) -> float:
    """Where found and missed are separated with the fewest exceptions; infinite if all are of one kind.

    It is the middle of all such places: the first one is nearer to the camera than the transition.
    """
    if found.all() or not found.any():
        return np.inf if found.all() else -np.inf
    wrong = np.array([np.sum(~found[:k]) + np.sum(found[k:]) for k in range(len(steps) + 1)])
    half = (steps[1] - steps[0]) / 2
    between = np.append(steps - half, steps[-1] + half)
    return float(np.mean(between[wrong == wrong.min()]))
