# SPDX-License-Identifier: BSD-3-Clause
"""Public recordings beside published figures: `python -m tests.benchmarks.public [FILE.mcap ...]`.

Each set of ../shared/data is calibrated by the commands of the documentation: an import, and the command that the
import prints. Sets that are not beside the checkout are named. Figures are RMS distances of all images from those of
their points, triangulated by the rig; or of a board, errors of the distances between its corners.

Recordings of `roundel record --public` are tracked again: how long each robot was tracked, how far the poses are from
the published ones, the residuals, and the roundels that the detector finds in the pictures (docs/benchmark.md).
"""

import re
import shlex
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import tyro
from rich.table import Table

from calib.rig.estimation import rms
from calib.rig.recording import read_messages
from calib.rig.rig import Rig, load_rig
from camera_node.foundation.terminal import console, say
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import read_observations
from fusion.recordings.arena_recording import POSE, read_recording
from roundel import Detector, track
from tests.benchmarks.calibration_data import gather_points, residuals_px
from tests.benchmarks.calibration_recordings import DATA, board_corners, corner_errors, tracks_of_messages
from tests.web.roundel.programs import roundel_command

NEXT = re.compile(r"^next: roundel (.*)$", re.MULTILINE)
TIMEOUT_S = 600  # of one command
SYNC_S = 1 / 30  # between frames of sets with numbers in place of times


@dataclass(frozen=True)
class PublicSet:
    """A recording of others.

    Attributes:
        folder: in ../shared/data.
        importing: words of `roundel calibrate import` but for `--out`; `{data}` is the folder.
        calibrating: words of `roundel calibrate wand`, if the import has no observations and so prints no command.
        observations: from which the figure is computed; `{out}` is the folder of the import.
        figure: of the calibrated rig and the observations.
        unit: of the figure.
        published: the same figure by others, or how it follows from their files.
        by: whose that is.
        held_out: whether each half of the frames is judged by a rig from the other half.
    """

    folder: str
    importing: str
    observations: str
    figure: Callable[[Rig, list[Detections]], float]
    unit: str
    published: float | Callable[[Path], float]
    by: str
    calibrating: str = ""
    held_out: bool = False

    def published_figure(self, data: Path) -> float:
        """The same figure by others."""
        return self.published(data) if callable(self.published) else self.published


def residual_px(rig: Rig, messages: list[Detections]) -> float:
    """RMS of the distances of all images from those of their points."""
    points = gather_points(tracks_of_messages(rig, messages), gap_s=0.0)
    return rms(residuals_px(rig, points))


def board_mm(rig: Rig, messages: list[Detections]) -> float:
    """RMS error of the distances between the corners of the board with squares of 54 mm."""
    return 1e3 * rms(corner_errors(rig, messages, SYNC_S))


def caliscope_mm(data: Path) -> float:
    """The same by the points of Caliscope's own result, `xyz_CHARUCO.csv`."""
    table = np.genfromtxt(data / "xyz_CHARUCO.csv", delimiter=",", names=True, dtype=float)
    board, errors = np.array(board_corners()), []
    for instant in np.unique(table["sync_index"]):
        rows = table[table["sync_index"] == instant]
        there = np.column_stack([rows[f"{axis}_coord"] for axis in "xyz"])
        corners = board[rows["keypoint_id"].astype(int)]
        for a, b in combinations(range(len(rows)), 2):
            errors.append(np.linalg.norm(there[a] - there[b]) - np.linalg.norm(corners[a] - corners[b]))
    return 1e3 * rms(np.array(errors))


TAG_WAND = PublicSet(
    "tag_wand",
    "--format kalibr {data}/camchain.yaml",
    "{data}/wand.csv",
    residual_px,
    "px",
    0.526,
    "TagSLAM",
    "--rig {out}/rig.yaml --observations {data}/wand.csv --wand {data}/wand.yaml --synchronised "
    "--out {out}/calibrated.yaml",
)
MULTICAMSELFCAL = PublicSet(
    "multicamselfcal_result",
    "--format multicamselfcal {data}",
    "{out}/observations.csv",
    residual_px,
    "px",
    0.27,
    "MultiCamSelfCal",
)
CALISCOPE = PublicSet(
    "caliscope_current",
    "--format caliscope {data}/camera_array.toml {data}/xy_CHARUCO.csv",
    "{out}/observations.csv",
    board_mm,
    "mm",
    caliscope_mm,
    "Caliscope",
)
SETS = (TAG_WAND, MULTICAMSELFCAL, CALISCOPE, replace(CALISCOPE, held_out=True))


def calibrate_set(public: PublicSet, data: Path, out: Path) -> tuple[Rig, float]:
    """Calibrate by the documented commands; the rig, of several that with the fewest placed cameras, and the figure.

    Raises:
        SystemExit: a command fails; with what it printed.
    """

    def roundel(words: str) -> str:
        words = words.format(data=data, out=out)
        command = roundel_command(*shlex.split(words))
        program = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        if program.returncode != 0:
            raise SystemExit(f"roundel {words}\n{program.stdout}{program.stderr}")
        return program.stdout + program.stderr

    printed = roundel(f"calibrate import {public.importing} --out {{out}}")
    following = NEXT.search(printed)
    words = f"calibrate wand {public.calibrating}" if following is None else following[1]
    observations = Path(public.observations.format(data=data, out=out))
    rigs, figures = [], []
    for used, judged in _halves(observations) if public.held_out else [(observations, observations)]:
        roundel(words.replace(str(observations), str(used)))
        rigs.append(rig := load_rig(out / "calibrated.yaml"))
        sizes = {name: (camera.width, camera.height) for name, camera in rig.cameras.items()}
        numbered = "t_ns" not in judged.read_text().splitlines()[0]
        figures.append(
            public.figure(rig, read_observations(judged, sizes, fps=1 / SYNC_S if numbered else None))
        )
    return min(rigs, key=lambda rig: len(rig.placed())), rms(np.array(figures))


def _halves(observations: Path) -> list[tuple[Path, Path]]:
    """The rows of every second frame, and the others, in files of their own; then the same, exchanged."""
    header, *rows = observations.read_text().splitlines()
    halves = []
    for half in (0, 1):
        halves.append(observations.with_name(f"half{half}.csv"))
        chosen = [row for row in rows if int(row.split(",")[0]) % 2 == half]
        halves[half].write_text("\n".join([header, *chosen]) + "\n")
    return [(halves[0], halves[1]), (halves[1], halves[0])]


def tabulate_sets() -> Table:
    """A row for each set that is beside the checkout."""
    table = Table("recording", "cameras", "ours", "published")
    for public in SETS:
        data = DATA / public.folder
        if not data.is_dir():
            say(f"{data} is absent")
            continue
        with tempfile.TemporaryDirectory(prefix="roundel-public-") as folder:
            rig, figure = calibrate_set(public, data, Path(folder) / "out")
            theirs = f"{public.published_figure(data):.3f} ({public.by})"
            placed = f"{len(rig.placed())} of {len(rig.cameras)}"
            name = f"{public.folder}, held out" if public.held_out else public.folder
            table.add_row(name, placed, f"{figure:.3f} {public.unit}", theirs)
    return table


def tabulate_recording(path: Path) -> Table:
    """A row for each robot of a recording: tracked share of the estimated poses, and distance from the published."""
    recording = read_recording(path)
    published = {
        (pose.robot, pose.t_ns): pose.position for _, pose in recording.messages(POSE) if pose.state != "lost"
    }
    rows: dict[str, list[tuple[bool, float, float]]] = {}
    for pose in track(path, recording.rig, recording.robots):
        before = published.get((pose.robot, pose.t_ns))
        off = np.nan if before is None else float(np.linalg.norm(np.subtract(pose.position, before)))
        residual = np.nan if pose.residual_px is None else pose.residual_px
        rows.setdefault(pose.robot, []).append((pose.state == "tracked", off, residual))
    title = f"{path.name}: {describe_pictures(path)}"
    table = Table("robot", "poses", "tracked", "from the published, mm RMS", "residual, px RMS", title=title)
    for robot, values in sorted(rows.items()):
        tracked, off, residual = np.array(values, float).T
        figures = [f"{np.sqrt(np.nanmean(column**2)):.3f}" for column in (1e3 * off, residual)]
        table.add_row(robot, str(len(values)), f"{tracked.mean():.1%}", *figures)
    return table


def describe_pictures(path: Path) -> str:
    """What the recording was made with, and the mean number of roundels in its pictures."""
    made = read_recording(path).installation
    versions = "not a public recording" if made is None else f"Roundel {made.packages.get('roundel', '?')}"
    pictures = [
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        for key, data, _ in read_messages(path, Counter())
        if key.endswith("/snapshot")
    ]
    found = [len(Detector().detect(picture.astype(np.uint8))) for picture in pictures if picture is not None]
    return f"{versions}, {len(found)} pictures with {np.mean(found or [0]):.1f} roundels"


def main(recordings: tuple[Path, ...] = ()) -> None:
    """Print the tables.

    Args:
        recordings: of `roundel record --public`; the sets of ../shared/data unless given.
    """
    tables: Sequence[Table] = [*map(tabulate_recording, recordings)] or [tabulate_sets()]
    for table in tables:
        console().print(table)


if __name__ == "__main__":
    tyro.cli(main, config=(tyro.conf.Positional,))
