# SPDX-License-Identifier: BSD-3-Clause
"""Accuracy of poses and recall of markers of equal printed area, on the same rendered views."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry.lens import Lens
from camera_node.simulation.sensor import SENSORS, Sensor
from tests.benchmarks.detector.recall import blur_by_motion
from tests.benchmarks.paper.markers import AREA_M2, Found, Marker, markers
from tests.benchmarks.paper.report import PLOTS, Section, table
from tests.benchmarks.paper.scenes import View, trace_print

LENS = Lens(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
EXPOSURES = 3  # images of each view, of which the last one counts
NEAR = 0.25  # a marker counts as found within this share of its reach from the true centre
FLIPPED_DEG = 15.0
PLOT = "paper_markers.png"


@dataclass(frozen=True)
class Condition:
    """A marker's distance in metres, slant in degrees, blur and motion in pixels, and the sensor."""

    distance: float = 2.5
    slant: float = 30.0
    blur: float = 0.7
    motion: float = 0.0
    sensor: Sensor = SENSORS["clean"]


@dataclass(frozen=True)
class Result:
    """Of one marker under one condition.

    Attributes:
        recall: share of the views in which it is found.
        centre_px, distance_percent, normal_deg: medians of the errors; of the normal that the detector prefers, of the
            better one where it prefers none.
        flipped: share of the normals that are wrong by more than 15 degrees, or undecided.
    """

    recall: float
    centre_px: float
    distance_percent: float
    normal_deg: float
    flipped: float


SWEEPS: Mapping[str, Mapping[str, Condition]] = {
    "distance (m)": {f"{x:g}": Condition(x) for x in (1.5, 2.5, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0)},
    "slant (degrees)": {f"{x:g}": Condition(slant=x) for x in (0.0, 15.0, 30.0, 45.0, 60.0, 70.0)},
    "blur (sigma, px)": {f"{x:g}": Condition(blur=x) for x in (0.5, 1.0, 1.5, 2.0, 3.0)},
    "motion during the exposure (px)": {f"{x:g}": Condition(motion=x) for x in (0.0, 4.0, 8.0, 16.0, 24.0)},
    "noise (grey levels)": {f"{x:g}": Condition(sensor=Sensor(noise=x)) for x in (1.0, 3.0, 6.0, 12.0, 20.0)},
    "camera": {name: Condition(sensor=sensor) for name, sensor in SENSORS.items()},
}


def measure_point(marker: Marker, condition: Condition, views: int) -> Result:
    """Measure views of random position, direction of slant and rotation in the plane, on clutter."""
    rows = []
    for seed in range(views):
        rng = np.random.default_rng(seed)
        u, v = np.array([LENS.cx, LENS.cy]) + rng.uniform(-100, 100, 2)
        turn, roll, heading = rng.uniform(0, 2 * np.pi, 3)
        view = View(LENS, (u, v), condition.distance, np.radians(condition.slant), turn, roll, condition.blur)
        picture = trace_print(view, marker.sheet, rng)
        light = picture.light
        if condition.motion:
            light = blur_by_motion(light, condition.motion, heading)
        images: list[Grey] = [condition.sensor.expose(light, rng) for _ in range(EXPOSURES)]
        found = [_errors(f, view, picture.lens) for f in marker.find(images, picture.lens)]
        reach = marker.sheet.reach_m * LENS.fx / condition.distance
        rows += [row for row in found if row[0] < NEAR * reach][:1]
    if not rows:
        return Result(0.0, np.nan, np.nan, np.nan, np.nan)
    centre, distance, normal, flipped = np.array(rows).T
    medians = (float(np.median(errors)) for errors in (centre, distance, normal))
    return Result(len(rows) / views, *medians, flipped=float(flipped.mean()))


def _errors(found: Found, view: View, lens: Lens) -> tuple[float, float, float, float]:
    """Errors of centre in pixels, distance in % and normal in degrees, and whether the normal is wrong or undecided."""
    centre = np.linalg.norm(lens.project(found.position_m) - lens.project(view.position))
    distance = 100 * abs(np.linalg.norm(found.position_m) / view.distance_m - 1)
    angles = np.degrees(np.arccos(np.clip(found.normals @ view.normal, -1, 1)))
    angle = angles.min() if found.ambiguous else angles[0]
    undecided = found.ambiguous and np.ptp(angles) > FLIPPED_DEG
    return float(centre), float(distance), float(angle), float(undecided or angle > FLIPPED_DEG)


Results = dict[str, dict[str, dict[str, Result]]]  # by sweep, marker and value


def measure_all(views: int, progress: Callable[[str], None] = print) -> Results:
    """Measure all sweeps."""
    done: Results = {}
    for sweep, points in SWEEPS.items():
        done[sweep] = {
            marker.name: {value: measure_point(marker, at, views) for value, at in points.items()}
            for marker in markers()
        }
        progress(f"measured markers by {sweep}")
    return done


METRICS = {
    "recall": "found (share)",
    "centre_px": "centre, median error (px)",
    "distance_percent": "distance, median error (%)",
    "normal_deg": "normal, median error (degrees)",
    "flipped": "normal wrong by > 15° (share)",
}


def plot(results: Results, path: Path) -> None:
    """Write a figure with a row for each sweep and a column for each metric."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17, 2.7 * len(results)), dpi=75, layout="constrained")
    axes = np.atleast_2d(figure.subplots(len(results), len(METRICS)))
    for row, (sweep, by_marker) in zip(axes, results.items(), strict=True):
        for ax, (metric, label) in zip(row, METRICS.items(), strict=True):
            for (name, points), style in zip(by_marker.items(), ("o-", "s--", "^-.", "d:"), strict=False):
                ax.plot(list(points), [getattr(r, metric) for r in points.values()], style, label=name, ms=4)
            if metric in ("recall", "flipped"):
                ax.set_ylim(-0.05, 1.05)
            else:
                ax.set_yscale("log")
            ax.set_xlabel(sweep)
            ax.set_ylabel(label, fontsize=8)
            ax.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    FigureCanvasAgg(figure)
    figure.savefig(path, metadata={"Software": None})


def measure(views: int = 16, folder: Path = PLOTS, progress: Callable[[str], None] = print) -> Section:
    """Measure, write the plot into `folder`, and return the tables."""
    results = measure_all(views, progress)
    plot(results, folder / PLOT)
    tables = [f"![Errors and recall by {', '.join(SWEEPS)}]({PLOT})"]
    for sweep, by_marker in results.items():
        rows = [(name, *(_cell(result) for result in points.values())) for name, points in by_marker.items()]
        tables.append(table((sweep, *SWEEPS[sweep]), rows))
    return Section(
        "Comparison with tags of equal printed area",
        f"Each sheet has {1e4 * AREA_M2:.0f} cm² with its margin: a roundel of d_o = 14 cm, an AprilTag of 12.8 cm, an "
        f"ArUco tag of 12.0 cm. Simulated: f = 600 px, 640x480, {views} views for each point at random positions and "
        f"rotations on clutter; unless it is varied, {Condition().distance:g} m, {Condition().slant:g} degrees, blur "
        "0.7 px, noise 3. Tags: AprilTag 3 (pyapriltags) without decimation, ArUco with sub-pixel corners, poses by "
        "IPPE_SQUARE. Cells: found / centre px / distance % / normal degrees / share of wrong normals.",
        tables,
    )


def _cell(result: Result) -> str:
    if not result.recall:
        return "0"
    errors: Array = np.array([result.centre_px, result.distance_percent, result.normal_deg])
    return " / ".join(
        [
            f"{result.recall:.2f}",
            *(f"{e:.2g}" if e < 10 else f"{e:.0f}" for e in errors),
            f"{result.flipped:.2f}",
        ]
    )
