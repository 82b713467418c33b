# SPDX-License-Identifier: BSD-3-Clause
"""Grouping without history: identical markers in many views. `python -m tests.benchmarks.fusion_grouping [--thorough]`.

`cold_grouping` renders discs of one size; `Scene` has points without a size in front of cameras around the arena or
side by side, and cameras whose poses are wrong.
"""

import sys
import time
from collections import Counter
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import Pose, look_at, rotation_from_vector
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray, DetectionTable
from fusion.model.robots import Robot
from fusion.tracking.marker_search import find_markers
from fusion.tracking.rays import Marker
from tests.benchmarks.fusion_load import DIAMETER_M, DISTORTION, LENS, Load
from tests.fusion.synthetic import START_NS, Arena, line, ring

DISC_M, SMALLER = 0.06, 0.88  # of discs that move, and of those that are smaller than declared
FREE_RUNNING = (0.0, 0.27, -0.41, 0.38, 0.1, -0.2, 0.45, -0.33)  # phases, in periods of 33 ms
APART_M = 0.12  # between the centres of discs of 0.08 m with their white margins


def cold_grouping(seed: int, points: int = 130, cameras: int = 10, sigma_px: float = 0.3, sized: bool = True):
    """Precision and recall of the points that two or more cameras see, and processor seconds.

    A marker is correct if all its detections belong to one point; a point is found if a correct marker has it.
    """
    load = Load(
        points, 1, cameras, speed_m_s=0, missing=0, false=0, synchronised=True, sigma_px=sigma_px, seed=seed
    )
    load.paths.place(scattered(points, np.random.default_rng(seed)))
    frames = tuple(load.frames(1 / load.hz))
    seen = Counter(int(k) for frame in frames for k in frame.roundels.id)
    camera_array = CameraArray(load.rig)
    detections = DetectionTable.of(FrameSet(frames[0].t_ns, frames), camera_array)
    if not sized:
        detections.axes_px[:] = np.nan
    rows, sizes = np.arange(len(detections)), np.array([DIAMETER_M])
    find_markers(camera_array, detections, rows, sizes)
    start = time.process_time()
    markers = find_markers(camera_array, detections, rows, sizes)
    cost_s = time.process_time() - start
    number = np.concatenate([frame.roundels.id for frame in frames])
    kinds = [set(number[marker.detections].tolist()) for marker in markers]
    right = [kind for kind in kinds if len(kind) == 1]
    many = {k for k, count in seen.items() if count >= 2}
    return len(right) / max(len(kinds), 1), len(set().union(*right) & many) / len(many), cost_s


def scattered(n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) points in the arena, no closer to each other than discs can be."""
    places = np.empty((0, 3))
    while len(places) < n:
        p = rng.uniform([-2.3, -1.4, 0.05], [2.3, 1.4, 0.8])
        if not len(places) or np.linalg.norm(places - p, axis=1).min() > APART_M:
            places = np.vstack([places, p])
    return places


@dataclass(frozen=True)
class Scene:
    """Points of unknown size at one moment.

    Attributes:
        baseline_m: between cameras side by side; 0 for cameras around the arena.
        missing, false: share of missing detections, and false ones of each camera.
        turned_rad, moved_m: standard deviations of the errors of the camera poses.
    """

    points: int = 34
    cameras: int = 2
    baseline_m: float = 0.0
    sigma_px: float = 0.1
    missing: float = 0.1
    false: float = 1.0
    turned_rad: float = 0.0
    moved_m: float = 0.0

    def rig(self) -> dict[str, Camera]:
        n = self.cameras
        if self.baseline_m:
            x = self.baseline_m * (np.arange(n) - (n - 1) / 2)
            poses = [look_at([at, -3.5, 2.5], [at / 2, 0.0, 0.2]) for at in x]
        else:
            a = 0.3 + 2 * np.pi * np.arange(n) / n
            at = np.column_stack([4 * np.cos(a), 3 * np.sin(a), 3 + 0.3 * np.cos(3 * a)])
            poses = [look_at(p, [0.0, 0.0, 0.2]) for p in at]
        return {
            f"cam{k}": Camera(**LENS, distortion=DISTORTION, T_world_cam=Pose.from_matrix(T))
            for k, T in enumerate(poses)
        }

    def detect(self, seed: int) -> tuple[CameraArray, DetectionTable, np.ndarray]:
        """The cameras as calibrated, the detections, and the number of the point of each; -1 for false ones."""
        rng, frames, numbers = np.random.default_rng(seed), [], []
        true = self.rig()
        used = {name: self._calibrated(camera, rng) for name, camera in true.items()}
        points = scattered(self.points, rng)
        for name, camera in true.items():
            uv = camera.project_world(points)
            seen = np.flatnonzero(camera.sees(uv) & (rng.random(len(uv)) >= self.missing))
            false = rng.uniform(0, [camera.width - 1, camera.height - 1], (rng.poisson(self.false), 2))
            uv = np.vstack([uv[seen] + self.sigma_px * rng.normal(size=(len(seen), 2)), false])
            order = rng.permutation(len(uv))
            roundels = Roundels.from_points(uv[order], self.sigma_px)
            frames.append(CalibratedFrame.measure(name, 0, roundels, used[name]))
            numbers.append(np.append(seen, np.full(len(false), -1))[order])
        cameras = CameraArray(used)
        return cameras, DetectionTable.of(FrameSet(0, tuple(frames)), cameras), np.concatenate(numbers)

    def _calibrated(self, camera: Camera, rng: np.random.Generator) -> Camera:
        error = np.eye(4)
        error[:3, :3] = rotation_from_vector(self.turned_rad * rng.normal(size=3))
        error[:3, 3] = self.moved_m * rng.normal(size=3)
        return Camera(**LENS, distortion=DISTORTION, T_world_cam=Pose.from_matrix(camera.matrix() @ error))


@dataclass(frozen=True)
class Score:
    """Counts over all seeds: markers and correct ones; points that two or more, or exactly two, cameras detect."""

    markers: int
    correct: int
    points: int
    found: int
    of_two: int
    found_of_two: int
    cost_s: float

    @property
    def precision(self) -> float:
        return self.correct / max(self.markers, 1)

    @property
    def recall(self) -> float:
        return self.found / max(self.points, 1)

    @property
    def recall_of_two(self) -> float:
        """Of the points that exactly two cameras detect."""
        return self.found_of_two / max(self.of_two, 1)


def score(scene: Scene, seeds: range) -> Score:
    """Group the detections of a scene, once for each seed."""
    counts = np.array([_counts(scene, seed) for seed in seeds])
    a, b, c, d, e, f = counts[:, :-1].sum(0).astype(int).tolist()
    return Score(a, b, c, d, e, f, float(np.median(counts[:, -1])))


def _counts(scene: Scene, seed: int) -> tuple[float, ...]:
    cameras, detections, number = scene.detect(seed)
    start = time.process_time()
    markers = find_markers(cameras, detections, np.arange(len(detections)), np.array([DIAMETER_M]))
    cost_s = time.process_time() - start
    kinds = [set(number[marker.detections].tolist()) for marker in markers]
    right = [min(kind) for kind in kinds if len(kind) == 1 and -1 not in kind]
    seen = Counter(number[number >= 0].tolist())
    many, two = (
        {k for k, count in seen.items() if least <= count <= most} for least, most in ((2, 99), (2, 2))
    )
    found = set(right)
    return len(kinds), len(right), len(many), len(found & many), len(two), len(found & two), cost_s


def moving_markers(
    velocities: np.ndarray,
    phases: tuple[float, ...],
    apart_m: float = 0.15,
    readout_s: float = 0.0,
    off: int = 0,
) -> tuple[list[Marker], np.ndarray, np.ndarray]:
    """Markers that are found in one frame of each camera, on a grid of discs, each with its velocity (3,).

    The first `off` discs are smaller than declared by 12 %. Also the
    number of the disc of each detection, and the true positions (K, 3).
    """
    n = len(velocities)
    x, y = np.divmod(np.arange(n), 6)
    places = np.column_stack([apart_m * (x - 2.5), apart_m * (y - 2.5), 0.1 + 0.02 * (np.arange(n) % 5)])
    motions = {f"r{k}": line(tuple(places[k]), tuple(velocities[k])) for k in range(n)}
    discs = [Robot(diameter_m=DISC_M * (SMALLER if k < off else 1)) for k in range(n)]
    arena = Arena(
        dict(zip(motions, discs, strict=True)),
        motions,
        ring(len(phases)),
        phases,
        sigma_px=0.15,
        readout_s=readout_s,
    )
    frames = tuple(arena.frames(1))
    cameras = CameraArray(arena.cameras)
    table = DetectionTable.of(FrameSet(START_NS, frames), cameras)
    found = find_markers(cameras, table, np.arange(len(table)), np.array([DISC_M]))
    return found, np.concatenate([frame.roundels.id for frame in frames]), places


def in_direction(speed_m_s: float, n: int = 36, seed: int = 2) -> np.ndarray:
    """(n, 3) velocities in all directions."""
    drawn = np.random.default_rng(seed).normal(size=(n, 3))
    return speed_m_s * drawn / np.linalg.norm(drawn, axis=1)[:, None]


def moving_score(
    speed_m_s: float, cameras: int, apart_m: float, seeds: range, off: int = 0
) -> tuple[Score, int]:
    """Of discs that move before free-running cameras; and how many of those that are smaller were found."""
    markers = correct = points = n_found = found_off = 0
    start = time.process_time()
    for seed in seeds:
        velocities = in_direction(speed_m_s, seed=seed)
        got, number, places = moving_markers(velocities, FREE_RUNNING[:cameras], apart_m, off=off)
        kinds = [set(number[marker.detections].tolist()) for marker in got]
        right = [min(kind) for kind in kinds if len(kind) == 1]
        markers, correct, points = markers + len(kinds), correct + len(right), points + len(places)
        n_found, found_off = n_found + len(set(right)), found_off + len({k for k in right if k < off})
    cost_s = (time.process_time() - start) / len(seeds)
    return Score(markers, correct, points, n_found, 0, 0, cost_s), found_off


def shaken(scene: Scene) -> Scene:
    """With camera poses that are off by 0.3 mrad and 1 mm."""
    return replace(scene, turned_rad=3e-4, moved_m=1e-3)


SIDE_BY_SIDE = Scene(130, 10, 0.15, 0.3)
SCENES = {
    "34 points, 2 cameras 1 m apart": Scene(baseline_m=1.0),
    "the same, 0.3 px": Scene(baseline_m=1.0, sigma_px=0.3),
    "the same, poses off by 0.3 mrad, 1 mm": shaken(Scene(baseline_m=1.0)),
    "the same, poses off by 1 mrad, 3 mm": Scene(baseline_m=1.0, turned_rad=1e-3, moved_m=3e-3),
    "the same, 40 % missing, 10 false": Scene(baseline_m=1.0, missing=0.4, false=10),
    "130 points, 2 cameras 1 m apart": Scene(130, 2, 1.0),
    "34 points, 2 cameras around": Scene(),
    "34 points, 3 cameras around, poses off": shaken(Scene(cameras=3)),
    "130 points, 4 cameras 0.6 m apart": Scene(130, 4, 0.6),
    "the same, 0.3 px, poses off": shaken(Scene(130, 4, 0.6, 0.3)),
    "the same, 50 % missing, 10 false": Scene(130, 4, 0.6, missing=0.5, false=10),
    "130 points, 10 cameras 0.15 m apart, 0.3 px": SIDE_BY_SIDE,
    "the same, poses off": shaken(SIDE_BY_SIDE),
    "30 false roundels in 2 cameras": Scene(1, missing=1.0, false=30),
}


def main() -> None:
    seeds = range(40 if "--thorough" in sys.argv else 8)
    print(f"{'scene, sizes unknown':45} precision  recall  in two views        ms")
    for name, scene in SCENES.items():
        got = score(scene, seeds)
        two = f"{got.found_of_two}/{got.of_two} = {got.recall_of_two:.2f}"
        print(
            f"{name:45} {got.precision:9.3f} {got.recall:7.3f}  {two:18} {1e3 * got.cost_s:4.1f}", flush=True
        )
    print(f"\n{'36 moving discs, free-running cameras':45} precision  recall  ms with rendering")
    for cameras, apart_m, speed_m_s in product((4, 8), (0.15, 0.35), (0.0, 1.0, 2.0)):
        got, _ = moving_score(speed_m_s, cameras, apart_m, seeds)
        name = f"{cameras} cameras, {apart_m:g} m apart, {speed_m_s:g} m/s"
        print(f"{name:45} {got.precision:9.3f} {got.recall:7.3f}  {1e3 * got.cost_s:4.1f}", flush=True)


if __name__ == "__main__":
    main()
