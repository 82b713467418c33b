# SPDX-License-Identifier: BSD-3-Clause
"""A calibration, and a wave as it goes, as a person reads it on the terminal."""

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from calib.live.wand_session import SessionProgress
from calib.wand.quality.grade import RigQuality
from calib.wand.quality.lenses import describe_lens_changes, find_lens_changes, find_misfit
from calib.wand.result import WandCalibration, WandReport
from camera_node.terminal import say

WIDENED = 1.2  # below, it is not worth a line
CLEAR = 3.0  # sigmas: below, a drift is not worth one either
WORST = 5  # outliers that are listed one by one


def print_report(result: WandCalibration, trust: RigQuality, console: Console) -> None:
    """A table of the cameras, then what else a person has to know; the grade comes last."""
    report, clocks = result.report, bool((result.time_sigma_ms > 0).any())
    error = "error mm" if report.metric else "error %"
    heads = ["camera", "grade", "frames", "outliers", "residual px", error, "waved"]
    table = Table(*heads, *["clock ms"] * clocks, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    judged = {camera.name: camera for camera in trust.cameras}
    for k, row in enumerate(report.cameras):
        camera = judged[row.name]
        counts = (f"{row.frames_used}/{row.frames}", str(row.outliers))
        error_mm = row.sigma_mm if report.metric else row.sigma_mm / 10
        figures = (f"{row.residual_px:.3f}", f"{error_mm:.2f}", f"{1 - camera.figures['unused']:.0%}")
        clock = f"{result.time_offset_ms[k]:+.2f} ± {result.time_sigma_ms[k]:.2f}"
        table.add_row(row.name, camera.grade, *counts, *figures, *[clock] * clocks)
    console.print(table)
    foretold = trust.expected.lines() if trust.expected else []
    wave = [f"{camera.name}: {camera.wave_next}" for camera in trust.cameras if camera.wave_next]
    lenses = describe_lens_changes(find_lens_changes(result.names, result.adjusted))
    misfit = find_misfit(result.names, result.adjusted, result.observations)
    lenses += [misfit.sentence()] if misfit else []
    jump = [f"warning: camera {result.jump.camera}: {result.jump.sentence()}"] if result.jump else []
    for line in [
        *_remarks(report),
        *_drifts(result),
        *jump,
        *lenses,
        *foretold,
        *wave,
        *trust.lens_warnings(),
        trust.sentence(),
    ]:
        say(line, console)


def _drifts(result: WandCalibration) -> list[str]:
    if not (np.abs(result.drift_ppm) > CLEAR * result.drift_sigma_ppm).any():
        return []
    rows = zip(result.names, result.drift_ppm, result.drift_sigma_ppm, strict=True)
    return ["clocks drift apart, in ppm: " + ", ".join(f"{n} {d:+.1f} ± {s:.1f}" for n, d, s in rows)]


def show_progress(told: SessionProgress) -> Group:
    """A wave as it goes: what each camera has seen, what it would give now, and what to do next."""
    table = Table("camera", "frames", "image", "shared part", "place over noise")
    for cells in told.cells():
        table.add_row(*cells)
    return Group(Text(told.standing, "bold"), table, Text(told.advice, "green" if told.enough else "yellow"))


def _remarks(report: WandReport) -> list[str]:
    lines = [f"{report.wand_poses} wand poses, residual {report.residual_px:.3f} px"]
    if report.sigma_inflation > WIDENED:
        lines.append(
            f"what neighbouring moments say is off alike (a lens or a clock that fits not quite): all errors below are "
            f"taken {report.sigma_inflation:.1f} times as large as noise alone would make them"
        )
    if report.length_mean_mm is not None and report.length_std_mm is not None:
        lines.append(
            f"wand length as the cameras measure it: {report.length_mean_mm:+.2f} mm off in the mean, "
            f"{report.length_std_mm:.2f} mm standard deviation"
        )
    if not report.metric:
        lines.append(
            "warning: one marker of unknown size gives no scale: the two cameras farthest apart "
            "are set 1 m apart; give the distance of two of them, --distance NAME NAME METRES"
        )
    if (told := report.scaled_by) is not None:
        lines.append(
            f"scale: '{told.a}' and '{told.b}' are {told.metres:g} ± {told.sigma_m:g} m apart, as was measured"
        )
    if report.compared is not None:
        lines.append(report.compared.sentence())
    if left_out := report.left_out():
        lines.append("frames left out: " + ", ".join(f"{n} {why}" for why, n in left_out.most_common()))
    if report.outliers:
        worst = ", ".join(
            f"{o.camera} {o.t_s:.3f} s marker {o.marker} ({o.off_px:.1f} px)" for o in report.outliers[:WORST]
        )
        lines.append(f"{len(report.outliers)} marker centres rejected as outliers; the worst: {worst}")
    lines += [f"warning: camera '{name}' has no place: {why}" for name, why in report.unplaced.items()]
    lines.append(
        "world: z up as the cameras are mounted (upright), origin under the middle of the wave, z = 0 at its lowest"
    )
    return lines
