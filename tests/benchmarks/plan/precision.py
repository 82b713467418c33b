# SPDX-License-Identifier: BSD-3-Clause
"""Compares the errors of tracked robots with the planner's prediction."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.plan.planner import PlannedArena
from calib.rig.camera import Camera
from camera_node.detector import Detector
from camera_node.foundation.arrays import Array
from camera_node.foundation.terminal import track
from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import Scene
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.tracking.tracker import Tracker
from tests.benchmarks.plan.arena import (
    DIAMETER_M,
    FPS,
    HALF_M,
    HEIGHTS_M,
    image_of,
    planned_arena,
    write_scene,
)

APART_M = 0.65  # of the robots: single markers are distinguished by their starts
# Motion of the robots, with the accelerations that they declare: the planner predicts what a frame set shows, and a
# tracker averages frame sets of robots that move gently.
CIRCLE_M, PERIOD_S = 0.004, 0.13
WARM_UP = 30  # frame sets until all robots are tracked
START_NS = 1_000_000_000_000
WITHIN = 0.2  # goal: relative difference of measured and predicted errors, in 95 % of the volume


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


def _overlap(camera: Camera, places: Array, place: Array) -> bool:
    """Whether the card at a place (3,) overlaps one of those at places (N, 3) in the image, or nearly."""
    if not len(places):
        return False
    uv, radius = image_of(camera, places)
    own, own_radius = image_of(camera, place[None])
    return bool((np.linalg.norm(uv - own, axis=1) < 1.6 * (radius + own_radius)).any())


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
