# SPDX-License-Identifier: BSD-3-Clause
"""The evaluation of an arena as plain values for `--json`, and as lines of text."""

import math

import msgspec
import numpy as np

from calib.plan.planner import BUSY, CameraReach, PlanReport
from calib.rig.precision_map import FloorGrid, error_rows
from camera_node.foundation.arrays import Array

COLUMNS = 13  # of a map as text, at most
BLIND_LINES = 5


class CameraSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One camera: position and optical axis in the world, range (metres), share of the volume, and load."""

    position_m: tuple[float, ...]
    axis: tuple[float, ...]
    v_min_m: float
    v_max_m: float
    v_y_m: float
    v_z_m: float
    share: float
    fps: float
    bit_s: float


class BlindSpot(msgspec.Struct, frozen=True, kw_only=True):
    """The box around a connected region that fewer than two cameras see, and its share of the volume."""

    low_m: tuple[float, ...]
    high_m: tuple[float, ...]
    share: float


class Grid(msgspec.Struct, frozen=True, kw_only=True):
    """The volume's points x, y, z, and values at them in the order of (z, y, x); None where nothing is known."""

    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    z_m: tuple[float, ...]
    cameras: tuple[int, ...]
    error_mm: tuple[float | None, ...]
    orientation_deg: tuple[float | None, ...]


class PlanSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The evaluation of an arena; None where a figure does not exist.

    Errors are root mean square distances and angles of one frame set; `covered` is the share of the volume that two
    cameras or more see, `single` the share that one sees.
    """

    cameras: dict[str, CameraSummary]
    covered: float
    single: float
    median_error_mm: float | None
    p95_error_mm: float | None
    median_orientation_deg: float | None
    required_error_mm: float | None
    required_share: float | None
    share_within_required: float | None
    is_sufficient: bool | None
    blind_spots: tuple[BlindSpot, ...]
    slowest_hz: float
    fastest_hz: float
    detections_s: float
    network_bit_s: float
    grid: Grid


def summarize(report: PlanReport) -> PlanSummary:
    """The report as plain values."""
    required = report.arena.plan.required
    return PlanSummary(
        cameras={name: _summarize_camera(report, name, reach) for name, reach in report.reach.items()},
        covered=float(report.covered.mean()),
        single=float(np.mean(report.errors.cameras == 1)),
        median_error_mm=_finite(report.median_mm),
        p95_error_mm=_finite(report.quantile_mm(0.95)),
        median_orientation_deg=_finite(report.median_deg),
        required_error_mm=required and required.error_mm,
        required_share=required and required.share,
        share_within_required=required and report.share_within(required.error_mm),
        is_sufficient=report.is_sufficient,
        blind_spots=tuple(
            BlindSpot(low_m=_plain(r.low), high_m=_plain(r.high), share=r.share) for r in report.blind
        ),
        slowest_hz=report.network.slowest_hz,
        fastest_hz=report.network.fastest_hz,
        detections_s=report.network.detections_s,
        network_bit_s=report.network.total_bit_s,
        grid=_summarize_grid(report),
    )


def describe(report: PlanReport) -> list[str]:
    """The report, line by line."""
    return [
        *(describe_camera(report, name) for name in report.reach),
        *describe_map(report),
        describe_coverage(report),
        describe_precision(report),
        *describe_blind_spots(report),
        describe_network(report),
        *describe_verdict(report),
    ]


def describe_camera(report: PlanReport, name: str) -> str:
    """Range and share of one camera."""
    reach, d_o = report.reach[name], report.arena.plan.robots.diameter_m
    space = reach.space
    if not space.v_max:
        return f"{name}: level roundels are too slanted on its axis; sees {reach.share:.0%} of the volume"
    return (
        f"{name}: level roundels of {d_o:g} m from {space.v_min:.2f} to {space.v_max:.2f} m along its axis, "
        f"{space.v_y:.2f} x {space.v_z:.2f} m there; sees {reach.share:.0%} of the volume"
    )


def describe_map(report: PlanReport) -> list[str]:
    """The errors at the lowest level as text, north (y) up, with a dot where fewer than two cameras see."""
    volume, errors = report.volume, report.errors
    level = errors.position_mm.reshape(volume.shape)[0]
    rows, columns = (
        np.unique(np.linspace(0, n - 1, min(n, COLUMNS)).round().astype(int)) for n in level.shape
    )
    grid = FloorGrid(volume.x[columns], volume.y[rows], float(volume.z[0]))
    title = f"expected error in mm at z = {grid.z:.2f} m (root mean square, one frame set):"
    return [title, *error_rows(grid, level[np.ix_(rows, columns)])]


def describe_coverage(report: PlanReport) -> str:
    """Shares of the volume by the number of cameras."""
    count = report.errors.cameras
    place = "area" if len(report.volume.z) == 1 else "volume"
    return (
        f"two cameras or more see {report.covered.mean():.0%} of the {place}, one {np.mean(count == 1):.0%}, none "
        f"{np.mean(count == 0):.0%}; {count.mean():.1f} cameras see a place in the mean"
    )


def describe_precision(report: PlanReport) -> str:
    """Median and 95 % quantile of the error."""
    if not report.covered.any():
        return "no place is seen by two cameras: no error can be predicted"
    typical, high = report.median_mm, report.quantile_mm(0.95)
    text = f"expected error {typical:.2f} mm in the median, {high:.2f} mm at the 95 % quantile"
    if math.isnan(report.median_deg):
        return f"{text}; the orientation needs robots with 3 roundels or more"
    return f"{text}; orientation {report.median_deg:.2f} degrees in the median"


def describe_blind_spots(report: PlanReport) -> list[str]:
    """The largest regions that fewer than two cameras see."""
    lines = [f"blind spot: {region.describe()}" for region in report.blind[:BLIND_LINES]]
    if len(report.blind) > BLIND_LINES:
        lines.append(f"and {len(report.blind) - BLIND_LINES} smaller blind spots")
    return lines


def describe_network(report: PlanReport) -> str:
    """Rate and load."""
    load = report.network
    rate = f"{load.fastest_hz:g}" + (
        f" (slowest camera {load.slowest_hz:g})" * (load.slowest_hz < load.fastest_hz)
    )
    megabits = load.total_bit_s / 1e6
    text = (
        f"poses at {rate} Hz from {load.detections_s:.0f} detections/s; {megabits:.2f} Mbit/s to the server"
    )
    return text + ("; use a wired network of 1 Gbit/s" if load.total_bit_s > BUSY else "")


def describe_verdict(report: PlanReport) -> list[str]:
    """Whether the requirement is met, and what to change."""
    required = report.arena.plan.required
    lines = []
    if required is not None:
        share = report.share_within(required.error_mm)
        verdict = "met" if report.is_sufficient else "not met"
        lines.append(
            f"required: {required.error_mm:g} mm in {required.share:.0%} of the volume; "
            f"achieved in {share:.0%}: {verdict}"
        )
    if report.covered.mean() < 0.99 or report.is_sufficient is False:
        lines.append(
            "to improve: print larger roundels, mount cameras higher, add cameras, or let --suggest N place them"
        )
    return lines


def _summarize_camera(report: PlanReport, name: str, reach: CameraReach) -> CameraSummary:
    T, space = report.arena.cameras[name].matrix(), reach.space
    return CameraSummary(
        position_m=_plain(T[:3, 3]),
        axis=_plain(T[:3, 2]),
        v_min_m=space.v_min,
        v_max_m=space.v_max,
        v_y_m=space.v_y,
        v_z_m=space.v_z,
        share=reach.share,
        fps=report.arena.kinds[name].rate,
        bit_s=report.network.camera_bit_s[name],
    )


def _summarize_grid(report: PlanReport) -> Grid:
    volume, errors = report.volume, report.errors
    return Grid(
        x_m=_plain(volume.x),
        y_m=_plain(volume.y),
        z_m=_plain(volume.z),
        cameras=tuple(errors.cameras.tolist()),
        error_mm=tuple(_finite(value) for value in errors.position_mm.tolist()),
        orientation_deg=tuple(_finite(value) for value in errors.orientation_deg.tolist()),
    )


def _plain(values: Array) -> tuple[float, ...]:
    return tuple(np.round(values, 6).tolist())


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
