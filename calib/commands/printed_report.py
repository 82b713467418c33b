# SPDX-License-Identifier: BSD-3-Clause
"""Prints calibrations, and the progress of a wand session, on the terminal, and writes images of them."""

from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from calib.commands.output import save_image
from calib.intrinsics.residual_plot import draw_residuals
from calib.rig.estimation import CLEAR
from calib.rig.precision_map import draw_precision
from calib.wand.quality.grade import RigQuality
from calib.wand.quality.lenses import describe_lens_changes, find_lens_changes
from calib.wand.single_camera import Recalibration
from calib.wand.wand_report import WandCalibration, WandReport
from camera_node.foundation.terminal import console, say

MIN_INFLATION = 1.2  # of standard deviations, that is printed
# Of a readout time that counts as determined: 1 mm at the edge of the image at 1 m/s
MAX_READOUT_SIGMA_MS = 2.0
MAX_GROSS = 0.15  # share of gross errors, above which a recording contradicts itself
MAX_OUTLIERS = 5  # that are listed one by one


def print_report(result: WandCalibration, quality: RigQuality) -> None:
    """Print a table of the cameras, then remarks and advice; the grade comes last."""
    console().print(camera_table(result, quality))
    lenses = describe_lens_changes(find_lens_changes(result.names, result.adjusted))
    for line in [
        *_remarks(result.report),
        *_drifts(result),
        *_readouts(result),
        *([f"warning: camera {result.jump.camera}: {result.jump.sentence()}"] if result.jump else []),
        *lenses,
        *(quality.expected.lines() if quality.expected else []),
        *(f"{camera.name}: {camera.wave_next}" for camera in quality.cameras if camera.wave_next),
        *quality.lens_warnings(),
        quality.sentence(),
    ]:
        say(line)


def camera_table(result: WandCalibration, quality: RigQuality) -> Table:
    """One row per placed camera: grade, frames, residual, error and clock."""
    report, clocks = result.report, bool((result.time_sigma_ms > 0).any())
    error = "error mm" if report.metric else "error %"
    heads = ["camera", "grade", "frames", "outliers", "residual px", error, "area used"]
    table = Table(*heads, *["clock ms"] * clocks, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    assessed = {camera.name: camera for camera in quality.cameras}
    for k, row in enumerate(report.cameras):
        camera = assessed[row.name]
        counts = (f"{row.frames_used}/{row.frames}", str(row.outliers))
        error_mm = row.sigma_mm if report.metric else row.sigma_mm / 10
        figures = (f"{row.residual_px:.3f}", f"{error_mm:.2f}", f"{1 - camera.figures['unused']:.0%}")
        clock = f"{result.time_offset_ms[k]:+z.2f} ± {result.time_sigma_ms[k]:.2f}"
        table.add_row(row.name, camera.grade, *counts, *figures, *[clock] * clocks)
    return table


def print_recalibration(result: Recalibration) -> None:
    """Print how far one camera moved, and how precise its new pose is."""
    moved = (
        ""
        if result.moved_mm is None
        else f"moved {result.moved_mm:.1f} mm, {result.turned_deg:.2f} degrees; "
    )
    say(
        f"{result.name}: {moved}standard deviation of its position {result.sigma_mm:.1f} mm, "
        f"residual {result.residual_px:.2f} px"
    )


def _drifts(result: WandCalibration) -> list[str]:
    if not (np.abs(result.drift_ppm) > CLEAR * result.drift_sigma_ppm).any():
        return []
    rows = zip(result.names, result.drift_ppm, result.drift_sigma_ppm, strict=True)
    return ["clock drift, ppm: " + ", ".join(f"{n} {d:+.1f} ± {s:.1f}" for n, d, s in rows)]


def _readouts(result: WandCalibration) -> list[str]:
    if not (result.readout_sigma_ms > 0).any():
        return []
    rows = zip(result.names, result.readout_ms, result.readout_sigma_ms, strict=True)
    shown = (
        f"{name} {ms:+.2f} ± {sigma:.2f}"
        if sigma < MAX_READOUT_SIGMA_MS
        else f"{name} not determined ({sigma:.0f})"
        for name, ms, sigma in rows
    )
    return ["rolling shutter, readout time of the image, ms: " + ", ".join(shown)]


def _remarks(report: WandReport) -> list[str]:
    lines = [f"{report.wand_poses} wand poses, residual {report.residual_px:.3f} px"]
    lines += [*_validation_remarks(report), report.timing]
    if report.sigma_inflation > MIN_INFLATION:
        lines.append(
            f"residuals are correlated in time; standard deviations are inflated by {report.sigma_inflation:.1f} "
            "(check the lenses and the clocks)"
        )
    if report.length_mean_mm is not None and report.length_std_mm is not None:
        lines.append(
            f"measured less given wand length: mean {report.length_mean_mm:+.2f} mm, "
            f"standard deviation {report.length_std_mm:.2f} mm"
        )
    lines += _scale_remarks(report)
    if report.background is not None:
        lines.append(report.background.sentence())
    if left_out := report.left_out():
        lines.append("unused frames: " + ", ".join(f"{n} {reason}" for reason, n in left_out.most_common()))
    if report.outliers:
        worst = ", ".join(
            f"{o.camera} {o.t_s:.3f} s marker {o.marker} ({o.off_px:.1f} px)"
            for o in report.outliers[:MAX_OUTLIERS]
        )
        lines.append(f"{len(report.outliers)} marker centres rejected as outliers; the worst: {worst}")
    lines += _exchange_remarks(report)
    lines += [f"warning: camera '{name}' is not placed: {why}" for name, why in report.unplaced.items()]
    lines.append(
        "world: z up for cameras that are mounted upright, origin below the median of the wand's positions, z = 0 at "
        "the lowest of them"
    )
    return lines


def _validation_remarks(report: WandReport) -> list[str]:
    lines = []
    if (given := report.given) is not None:
        lines.append(
            f"all {given.count} detections that two cameras or more saw: residual {given.all_px:.2f} px; without the "
            f"{given.gross:.1%} that are gross errors {given.residual_px:.2f} px"
        )
        if given.gross > MAX_GROSS:
            lines.append(
                f"warning: {given.gross:.0%} of the detections contradict the rig, for a reason that was not found: do "
                "not trust it before you know why; see the outliers below"
            )
    if (held_out := report.held_out) is not None:
        unit = (
            f"{1e3 * held_out.error_m:.2f} mm"
            if report.metric
            else f"{1e3 * held_out.relative:.2f} per mille"
        )
        at = f"at a distance of {held_out.range_m:.1f} m" if report.metric else "of the distance"
        lines.append(
            f"held-out detections ({held_out.count}): viewing rays pass the markers by {unit} {at}, "
            f"{held_out.residual_px:.2f} px"
        )
    return lines


def _exchange_remarks(report: WandReport) -> list[str]:
    if not report.exchanges:
        return []
    who = ", ".join(f"'{e.shown}' has those of '{e.of}' in {e.share:.0%}" for e in report.exchanges)
    return [
        f"warning: the recording has points under the wrong camera: {who} of its detections; they are left out; check "
        "the order of cameras or columns in the recording"
    ]


def _scale_remarks(report: WandReport) -> list[str]:
    lines = []
    if not report.metric:
        lines.append(
            "warning: a wand of one marker of unknown size gives no scale: the distance of the two farthest cameras "
            "is set to 1 m; measure the distance of two cameras and add --distance NAME NAME METRES"
        )
    if (distance := report.scaled_by) is not None:
        lines.append(
            f"scale: by the measured distance of '{distance.a}' and '{distance.b}', {distance.metres:g} ± "
            f"{distance.sigma_m:g} m"
        )
    if report.compared is not None:
        lines.append(report.compared.sentence())
    return lines


def save_maps(folder: Path, result: WandCalibration, quality: RigQuality) -> None:
    """Write an image of each camera's residuals, with the area to wave in next, and one of the expected errors."""
    observations, adjusted = result.observations, result.adjusted
    for k, camera in enumerate(quality.cameras):
        rows, lens = adjusted.used & (observations.camera == k), result.rig.cameras[camera.name]
        image = draw_residuals(
            camera.name, lens, observations.uv[rows], adjusted.residuals[rows], camera.missing
        )
        save_image(folder / f"{camera.name}.png", image)
    if quality.expected is not None:
        save_image(folder / "expected.png", draw_precision(quality.expected, result.rig.placed()))
    say(f"wrote images of residuals and expected errors to {folder}")
