# SPDX-License-Identifier: BSD-3-Clause
"""The planner compared with the simulated arena: `python -m tests.benchmarks.plan [PART]`; parts are named below.

`precision` renders roundels all over an arena, detects and tracks them, and compares their errors with the prediction.
`coverage` moves roundels through the predicted edges of what each camera sees, and finds where detection ends.
`cut` compares the precision that the detector reports of roundels which the border cuts with that of complete ones.
`placement` compares a suggested placement of eight cameras with a ring of eight, on one core.
"""

import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from calib.plan.camera_kind import CameraKind
from calib.plan.description import ImageQuality, Plan, PlannedRobots
from calib.plan.placement import PlacementProblem, SuggestedPlaces, evaluate_placement, suggest_placement
from calib.plan.planner import PlannedArena, evaluate
from calib.plan.views import CUT_EXPONENT, RoundelSensor
from calib.rig.camera import Camera
from camera_node.arrays import Array
from camera_node.detector import Detector
from camera_node.simulation.renderer import BLACK, WHITE, Renderer
from camera_node.simulation.scene import Scene
from camera_node.terminal import progress_bar, track
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.tracking.tracker import Tracker

FPS, EXPOSURE_US, BLUR_PX, NOISE = 30.0, 500.0, 0.7, 2.5
KIND = CameraKind(model="ov9281", fps=FPS, exposure_us=EXPOSURE_US)
HALF_M, HEIGHTS_M, CEILING_M = 1.6, (0.1, 0.9), 2.8
RING_M = 2.0  # of the cameras around the arena
DIAMETER_M = 0.12
SMALL_M = 0.045  # of roundels whose size and slant limit the range before the image's border does
APART_M = 0.65  # of the robots: single markers are distinguished by their starts
CIRCLE_M, PERIOD_S = 0.004, 1.3  # motion of the robots, so that roundels lie differently on the pixels
WARM_UP = 30  # frame sets until all robots are tracked
START_NS = 1_000_000_000_000
REACH_M, FAR_M = (
    0.15,
    0.75,
)  # half lengths of paths through edges of the image, and through limits of size and slant
STEPS = 31  # of a path
WITHIN = 0.2  # goal: relative difference of measured and predicted errors, in 95 % of the volume
EDGE_M = 0.05  # goal: distance of measured and predicted edges


@dataclass(frozen=True)
class PrecisionResult:
    """Measured and predicted root mean square errors (N,), mm, of the tracked robots, and the number of robots."""

    measured_mm: Array
    predicted_mm: Array
    robots: int

    @property
    def within(self) -> float:
        """Share of the robots whose measured error is within 20 % of the prediction."""
        return float(np.sum(np.abs(self.measured_mm / self.predicted_mm - 1) <= WITHIN)) / self.robots


@dataclass(frozen=True)
class CoverageResult:
    """Signed distances (N,), metres, of measured from predicted edges: positive where the camera sees farther.

    They are infinite where detection does not end on the path. `by_image` (N,) marks edges of the image; the others are
    limits of size and slant.
    """

    distance_m: Array
    by_image: np.ndarray


def main(
    part: tyro.conf.Positional[Literal["precision", "coverage", "cut", "placement", "all"]] = "all",
    frames: int = 100,
    edges: int = 40,
) -> None:
    """Print the table.

    Args:
        part: what to measure.
        frames: frame sets for the precision.
        edges: paths for each camera for the coverage.
    """
    table = Table("what", "measured", "goal", title="roundel plan, compared with the simulated arena")
    if part in ("precision", "all"):
        _add_precision(table, measure_precision(frames))
    if part in ("coverage", "all"):
        for diameter_m in (DIAMETER_M, SMALL_M):
            table.add_row(f"roundels of {diameter_m:g} m", "", "")
            _add_coverage(table, measure_coverage(edges, diameter_m))
    if part in ("cut", "all"):
        _add_cut(table, measure_cut(edges))
    if part in ("placement", "all"):
        _add_placement(table)
    Console(width=150).print(table)


def planned_arena(diameter_m: float = DIAMETER_M) -> PlannedArena:
    """Four cameras around an arena, with the simulator's image quality and even floor, and roundels of this diameter.

    Limits of size and slant are those of half of the roundels: the others are found farther or less far away.
    """
    angles = np.radians([45, 135, 225, 315])
    places = [(RING_M * np.cos(a), RING_M * np.sin(a), CEILING_M) for a in angles]
    cameras = {f"c{k}": KIND.placed(place, (0.0, 0.0, 0.3)) for k, place in enumerate(places)}
    robots = PlannedRobots(diameter_m=diameter_m, heights_m=HEIGHTS_M, speed_m_s=0.0)
    image = ImageQuality(
        blur_px=BLUR_PX, noise=NOISE, contrast=mean_contrast(), sigma_px=0.0, ground="even", found_share=0.5
    )
    plan = Plan(area_m=(-HALF_M, -HALF_M, HALF_M, HALF_M), ceiling_m=CEILING_M, robots=robots, image=image)
    return PlannedArena.of_cameras(plan, cameras, KIND)


def mean_contrast() -> float:
    """Of print in the simulator's pictures, grey levels, in the mean over the picture."""
    return (WHITE - BLACK) * (1 - 0.3 / 3)  # the corners lose 30 %: `CLEAN_VIGNETTING`


def measure_precision(frames: int, seed: int = 1) -> PrecisionResult:
    """Track robots all over the volume, and compare the errors of each with the prediction at its place."""
    arena = planned_arena()
    places = spread_robots(arena, np.random.default_rng(seed))
    predicted = arena.errors_at(places).position_mm
    robots = {
        f"r{k}": Robot(diameter_m=DIAMETER_M, start_m=tuple(place)) for k, place in enumerate(places.tolist())
    }
    motions = [circle(place, k) for k, place in enumerate(places)]
    with tempfile.TemporaryDirectory() as folder:
        scene = write_scene(Path(folder), arena.cameras, dict(zip(robots, motions, strict=True)))
        errors = _track(scene, arena.cameras, robots, frames)
    squared = np.nanmean(np.sum(errors**2, axis=2), axis=0)
    tracked = np.isfinite(errors).all(axis=2).mean(axis=0) > 0.5
    measured = 1e3 * np.sqrt(squared[tracked])
    return PrecisionResult(measured, predicted[tracked], len(robots))


def spread_robots(arena: PlannedArena, rng: np.random.Generator) -> Array:
    """(N, 3) random places in the volume which two cameras see, and whose cards overlap in no image."""
    low, high = np.array([-HALF_M, -HALF_M, HEIGHTS_M[0]]), np.array([HALF_M, HALF_M, HEIGHTS_M[1]])
    places = np.empty((0, 3))
    for place in rng.uniform(low, high, (2000, 3)):
        near = np.linalg.norm(places[:, :2] - place[:2], axis=1) < APART_M
        if near.any() or arena.errors_at(place[None]).cameras[0] < 2:
            continue
        if not any(_overlap(camera, places, place) for camera in arena.cameras.values()):
            places = np.vstack([places, place])
    return places


def circle(place: Array, k: int) -> dict[str, Any]:
    """A small circle around a place, as a motion of a scene."""
    swing = {"amplitude": CIRCLE_M, "period_s": PERIOD_S}
    phase = 40.0 * k
    return {
        "x_m": {"mean": place[0], **swing, "phase_deg": phase},
        "y_m": {"mean": place[1], **swing, "phase_deg": phase + 90},
        "z_m": {"mean": place[2]},
    }


def write_scene(
    folder: Path, cameras: Mapping[str, Camera], motions: Mapping[str, Any], diameter_m: float = DIAMETER_M
) -> Scene:
    """A scene with single roundels that move, seen by cameras; JSON is YAML too."""
    body = {"diameter_m": diameter_m}
    entries = {}
    for name, camera in cameras.items():
        T = camera.matrix()
        entries[name] = {
            **{field: getattr(camera, field) for field in ("width", "height", "fx", "fy", "cx", "cy")},
            "position_m": T[:3, 3].tolist(),
            "look_at_m": (T[:3, 3] + T[:3, 2]).tolist(),
            "fps": FPS,
            "exposure_us": EXPOSURE_US,
            "blur_px": BLUR_PX,
            "noise": NOISE,
        }
    wand = {**body, "markers": [[0, 0, 0], [0.3, 0, 0]]}
    scene = {
        "wand": "wand.yaml",
        "robots": "robots.yaml",
        "wave_s": 1e-3,
        "cameras": entries,
        "wand_motion": {"z_m": {"mean": -5.0}},
        "robot_motions": motions,
        "clutter": False,
    }
    files = {"wand": wand, "robots": {"robots": dict.fromkeys(motions, body)}, "scene": scene}
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(json.dumps(content, default=float))
    return Scene.load(folder / "scene.yaml")


def _overlap(camera: Camera, places: Array, place: Array) -> bool:
    """Whether the card at a place (3,) overlaps one of those at places (N, 3) in the image, or nearly."""
    if not len(places):
        return False
    uv, radius = _image(camera, places)
    own, own_radius = _image(camera, place[None])
    return bool((np.linalg.norm(uv - own, axis=1) < 1.6 * (radius + own_radius)).any())


def _image(camera: Camera, places: Array, diameter_m: float = DIAMETER_M) -> tuple[Array, Array]:
    """Pixels (N, 2) and radii (N,) of the discs at places (N, 3)."""
    depth = (places - camera.matrix()[:3, 3]) @ camera.matrix()[:3, 2]
    return camera.project_world(places), camera.fx * diameter_m / 2 / depth


def _track(scene: Scene, cameras: Mapping[str, Camera], robots: Mapping[str, Robot], frames: int) -> Array:
    """(frames, N, 3) errors of the tracked robots, metres; NaN for those that are not tracked."""
    tracker = Tracker(dict(cameras), dict(robots), Limits())
    renderers = {name: Renderer(scene, name) for name in cameras}
    detectors = {name: Detector(inner_ratios=(0.6,)) for name in cameras}
    errors = np.full((frames, len(robots), 3), np.nan)
    for k in track(range(1, frames + WARM_UP + 1), "tracking"):
        t_s = k / FPS
        t_ns = START_NS + round(t_s * 1e9)
        sets = tuple(
            CalibratedFrame.measure(
                name, t_ns, detectors[name].detect(renderer.render(t_s, k)), cameras[name]
            )
            for name, renderer in renderers.items()
        )
        tracker.track(FrameSet(t_ns, sets))
        if k > WARM_UP:
            truth = np.array([T[:3, 3] for _, T in scene.bodies_at(t_s).values()])
            alive = tracker.table.tracked
            errors[k - WARM_UP - 1, alive] = (tracker.table.states.p - truth)[alive]
    return errors


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
            uv, radius = _image(camera, middle[None], arena.plan.robots.diameter_m)
            border = np.min([uv[0], [camera.width, camera.height] - uv[0]])
            paths.append(EdgePath(middle, outward, bool(border < 2 * radius[0])))
    return paths


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
            t_s = 1.0 + float(np.arcsin(s / (2 * reach_m))) / (2 * np.pi)
            roundels = Detector().detect(renderer.render(t_s, frame))
            places = np.array([path.middle + s * path.outward for path in paths])
            uv, radius = _image(camera, places, sensor.pattern.d_o)
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
    """A motion through the edge: middle + 2 reach sin(2 pi t) outward."""
    return {
        f"{axis}_m": {
            "mean": path.middle[k],
            "amplitude": 2 * path.reach_m * path.outward[k],
            "period_s": 1.0,
        }
        for k, axis in enumerate("xyz")
    }


def _edge(steps: Array, found: np.ndarray) -> float:
    """The step that separates found from missed with the fewest exceptions; infinite if all are of one kind."""
    if found.all() or not found.any():
        return np.inf if found.all() else -np.inf
    wrong = [np.sum(~found[:k]) + np.sum(found[k:]) for k in range(len(steps) + 1)]
    k = int(np.argmin(wrong))
    return float(steps[min(k, len(steps) - 1)] - (steps[1] - steps[0]) / 2)


def _add_precision(table: Table, got: PrecisionResult) -> None:
    ratio = got.measured_mm / got.predicted_mm
    table.add_row(
        f"{got.robots} roundels in {2 * HALF_M:g} x {2 * HALF_M:g} m, z = {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m: "
        "error within 20 % of the prediction",
        f"{got.within:.0%} ({len(ratio)} tracked)",
        "95%",
    )
    table.add_row(
        "measured by predicted error: median, 5 and 95 % quantile", _quantiles(ratio, "{:.2f}"), "1.00"
    )
    table.add_row("predicted error, mm", _quantiles(got.predicted_mm, "{:.3f}"), "")


def _add_coverage(table: Table, got: CoverageResult) -> None:
    image, size = got.distance_m[got.by_image], got.distance_m[~got.by_image]
    if len(image):
        table.add_row(
            f"{len(image)} edges by the image: within 5 cm; 95 % quantile of the distance, cm",
            f"{np.mean(np.abs(image) <= EDGE_M):.0%}; {100 * np.quantile(np.abs(image), 0.95):.1f}",
            "100%; 5",
        )
    if len(size):
        table.add_row(
            f"{len(size)} edges by size or slant: median distance, cm; 10 and 90 % quantile",
            _quantiles(100 * size, "{:+.0f}", (0.5, 0.1, 0.9)),
            "within 5",
        )


def _add_cut(table: Table, rows: Sequence[tuple[float, float, int]]) -> None:
    for low, ratio, n in rows:
        goal = f"{min(low + 0.1, 1.0) ** -CUT_EXPONENT:.2f}"
        what = f"inset {low:.1f} to {low + 0.2:.1f}: sigma relative to a complete roundel ({n} detections)"
        table.add_row(what, f"{ratio:.2f}", goal)


def _add_placement(table: Table) -> None:
    """Eight cameras in 6 x 6 x 3 m, of the kind whose field of view suits the room."""
    kind = CameraKind(model="ov9281")
    robots = PlannedRobots(diameter_m=0.12, heights_m=(0.1, 1.5))
    plan = Plan(area_m=(-3.0, -3.0, 3.0, 3.0), ceiling_m=3.0, robots=robots)
    problem, aims = PlacementProblem(plan, kind), np.tile([0.0, 0.0, 0.8], (8, 1))
    corners = np.array([(x, y, 3.0) for x in (-3, 0, 3) for y in (-3, 0, 3) if (x, y) != (0, 0)], float)
    ring, start = evaluate_placement(problem, corners, aims), time.process_time()
    with progress_bar("placing") as progress:
        best = suggest_placement(problem, 8, progress)
    seconds = time.process_time() - start
    table.add_row("8 cameras in 6 x 6 x 3 m: processor time", f"{seconds:.0f} s", "60 s")
    for name, places in (("ring", ring), ("suggested", best)):
        table.add_row(f"8 cameras, {name}", _describe_places(plan, kind, places), "less than the ring")


def _describe_places(plan: Plan, kind: CameraKind, places: SuggestedPlaces) -> str:
    got = evaluate(PlannedArena.of_cameras(plan, places.cameras(kind), kind))
    return (
        f"expected error {1e3 * places.cost_m:.1f} mm with blind places as {1e3 * 0.05 * 3**0.5:.0f} mm; "
        f"{got.covered.mean():.0%} covered, median {got.median_mm:.2f} mm there"
    )


def _quantiles(values: Array, form: str, at: Sequence[float] = (0.5, 0.05, 0.95)) -> str:
    return ", ".join(form.format(x) for x in np.quantile(values, at, method="nearest"))


if __name__ == "__main__":
    tyro.cli(main)
