# SPDX-License-Identifier: BSD-3-Clause
"""The programs of docs/api.md run as they are written there, each of at most 15 lines."""

import contextlib
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas
import pytest

from camera_node.sources.recorded_frames import read_grey
from fusion.recordings.recording_files import trim_recording
from roundel import Recording
from tests.conftest import free_port
from tests.fusion.bridges.pose_server import ARENA, PoseServer
from tests.pages import programs
from tests.waiting import DEADLINE_S
from web.roundel.command import execute

LOOP, BATCH, VIDEO = PROGRAMS = programs("api.md")


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("api")
    with contextlib.chdir(path):
        execute("sample")
    return path / "sample"


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_has_at_most_15_lines(program: str):
    assert len([line for line in program.splitlines() if line.strip()]) <= 15


def test_the_loop_drives_towards_the_goal_and_stops_without_poses():
    """Commands point to the goal while poses come, and are zero once the server is gone."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    program = LOOP.replace("tcp/localhost:7447", endpoint).replace('arena="arena"', f'arena="{ARENA}"')
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(contextlib.ExitStack())
        server.enter_context(PoseServer(endpoint))
        loop = stack.enter_context(
            subprocess.Popen([sys.executable, "-u", "-c", program], stdout=subprocess.PIPE, text=True)
        )
        stack.callback(loop.kill)
        assert loop.stdout is not None
        moving = next(line for line in loop.stdout if line.split() != ["+0.000", "+0.000"])
        server.close()
        stopped = next(line for line in loop.stdout if line.split() == ["+0.000", "+0.000"])
    assert moving
    assert stopped


@pytest.mark.slow
def test_the_batch_compares_recordings_and_names_those_that_are_refused(sample: Path, tmp_path: Path):
    """Two halves of a wand recording agree; a file that is no recording does not end the batch."""
    for name in ("lenses.yaml", "wand.yaml"):
        shutil.copy(sample / name, tmp_path)
    (tmp_path / "waves").mkdir()
    for name, start_s in (("a", 0.0), ("b", 5.0)):
        trim_recording(sample / "wand.mcap", tmp_path / f"waves/{name}.mcap", start_s, start_s + 5.0)
    (tmp_path / "waves/c.mcap").write_text("no recording")
    words = [sys.executable, "-c", BATCH]
    done = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    first, second, comparison, refused = done.stdout.splitlines()
    assert first.startswith("a.mcap: grade ")
    assert second.startswith("b.mcap: grade ")
    assert comparison.strip().startswith("it and the first one agree within their covariance")
    assert refused.startswith("c.mcap: waves/c.mcap is not an MCAP recording")


def test_the_roundels_of_a_video_are_a_table(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Its rows are those of the detections, with the times of the frame rate."""
    frames = [read_grey(path) for path in sorted((sample / "frames/north").iterdir())]
    video = cv2.VideoWriter(
        str(tmp_path / "north.mp4"),
        cv2.VideoWriter.fourcc(*"mp4v"),
        20.0,
        frames[0].shape[::-1],
        isColor=False,
    )
    for frame in frames:
        video.write(frame)
    video.release()
    monkeypatch.chdir(tmp_path)
    exec(compile(VIDEO, "api.md", "exec"), {})
    table = pandas.read_csv("roundels.csv")
    messages = list(Recording("north.mp4").detections("north"))
    assert [message.t_ns for message in messages] == [50_000_000 * k for k in range(len(frames))]
    assert np.allclose(table["u"], np.concatenate([m.unpack().uv[:, 0] for m in messages]))
    assert "frames" in capsys.readouterr().out
