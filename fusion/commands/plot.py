# SPDX-License-Identifier: BSD-3-Clause
"""`roundel plot`: a picture of a recording."""

from pathlib import Path

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from fusion.export.plots import (
    compare_positions,
    draw_comparison,
    draw_recording,
    read_curves,
    write_figure,
)
from fusion.recordings.recording_files import say_skipped


def plot(
    recording: Path,
    /,
    *,
    out: Path | None = None,
    compare: Path | None = None,
    robots: tuple[str, ...] = (),
    force: bool = False,
) -> int:
    """Draw the trajectories of a recording, their uncertainty, and the residuals of the cameras.

    Args:
        recording: the MCAP file of roundel record or roundel replay.
        out: the picture to write, .png, .pdf or .svg; unless given RECORDING.png.
        compare: draw how far this recording's positions are from those of the first.
        robots: names of the robots to draw; all unless given.
        force: replace what exists.
    """
    out = out or recording.with_suffix(".png")
    if out.exists() and not force:
        raise ConfigError(f"{out} exists; give another name by --out, or --force to replace it")
    curves = read_curves(recording, robots)
    say_skipped(curves.faults)
    if compare is None:
        write_figure(draw_recording(curves), out)
    else:
        other = read_curves(compare, robots)
        say_skipped(other.faults)
        for name, _, distances in compare_positions(curves, other):
            finite = distances[distances == distances]
            say(f"{name}: {(finite**2).mean() ** 0.5:.3f} mm RMS apart, {finite.max():.3f} mm at most")
        write_figure(draw_comparison(curves, other), out)
    say(f"wrote {out}")
    return 0
