# SPDX-License-Identifier: BSD-3-Clause
"""`Recording` reads what was recorded, whole or in part, without holding the file in memory."""

import csv
import shutil
import subprocess
import sys
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calib.rig.recording import RecordingWriter, read_messages
from camera_node.foundation.errors import ConfigError
from fusion.export.pose_formats import COLUMNS
from fusion.recordings.arena_recording import DETECTIONS, POSE, read_recording
from roundel import Recording
from tests.conftest import ROOT

SAMPLE = ROOT / "configs" / "sample" / "recording.mcap"
WAND = ROOT / "tests" / "data" / "wand"


def test_all_of_a_recording():
    recording, held = Recording(SAMPLE), read_recording(SAMPLE)
    assert list(recording.detections()) == [message for _, message in held.messages(DETECTIONS)]
    assert list(recording.poses()) == [pose for _, pose in held.messages(POSE)]
    assert recording.rig == held.rig
    assert recording.robots is not None
    assert recording.robots.robots == held.robots
    assert recording.limits == held.limits
    assert recording.cameras == ("east", "north", "south", "west")
    times = [t_ns for *_, t_ns in read_messages(SAMPLE)]
    assert recording.duration_s == (max(times) - min(times)) / 1e9
    assert not recording.faults


def test_parts_by_name_and_time():
    """Parts that meet are the whole; names select."""
    recording = Recording(SAMPLE)
    edges = [0.0, 2.5, 5.0, recording.duration_s + 1]
    parts = [list(recording.poses(start_s=a, end_s=b)) for a, b in pairwise(edges)]
    assert all(parts)
    assert [pose for part in parts for pose in part] == list(recording.poses())
    rover = list(recording.poses("rover"))
    assert rover == [pose for pose in recording.poses() if pose.robot == "rover"]
    north = list(recording.detections(["north", "east"], end_s=1.0))
    assert {message.camera for message in north} == {"north", "east"}


def test_columns_are_those_of_the_messages():
    """Arrays and tables have the values of the messages; poses have the columns of poses.csv."""
    pandas = pytest.importorskip("pandas")
    recording = Recording(SAMPLE)
    poses, table = recording.to_numpy(), recording.to_pandas()
    assert isinstance(table, pandas.DataFrame)
    assert list(table) == COLUMNS.split(",")
    assert len(table) == len(poses) > 400
    for row, pose in zip(poses, recording.poses(), strict=True):
        assert (row["t_ns"], row["robot"], row["state"]) == (pose.t_ns, pose.robot, pose.state)
        assert tuple(row["position"]) == pose.position
        assert (row["covariance"] == pose.covariance_matrix.astype(np.float32)).all()
    assert (table[["x", "y", "z"]].to_numpy() == poses["position"]).all()
    assert (table["qw"].to_numpy() == poses["quaternion_wxyz"][:, 0]).all()
    detections, flat = recording.to_numpy("detections"), recording.to_pandas("detections")
    uv = np.concatenate([message.unpack().uv for message in recording.detections()])
    assert (detections["uv"] == uv).all()
    assert (flat["v"].to_numpy() == uv[:, 1]).all()
    assert (flat["cov_vv"].to_numpy() == detections["cov"][:, 1, 1]).all()
    with pytest.raises(ConfigError, match="'poses' or 'detections'"):
        recording.to_numpy("markers")  # type: ignore[arg-type]


def test_a_recording_without_poses(tmp_path: Path):
    """Tables are empty, with all columns; there is no rig and there are no robots."""
    pytest.importorskip("pandas")
    path = tmp_path / "wand.mcap"
    with RecordingWriter(path) as writer:
        for key, data, t_ns in read_messages(SAMPLE):
            if key.endswith("/detections"):
                writer.put(key, data, t_ns)
    recording = Recording(path)
    assert len(recording.to_numpy()) == 0
    assert list(recording.to_pandas()) == COLUMNS.split(",")
    assert (recording.rig, recording.robots, recording.limits) == (None, None, None)


@pytest.mark.ci
def test_memory_stays_below_the_size_of_the_file(tmp_path: Path):
    """Iterating holds one chunk of the file, 1 MB before compression at most, and the messages decoded from it."""
    path, entries = tmp_path / "long.mcap", list(read_messages(SAMPLE))
    with RecordingWriter(path) as writer:
        for repeat in range(15):
            for key, data, t_ns in entries:
                writer.put(key, data, t_ns + repeat * 8_000_000_000)
    size = sum(len(data) for _, data, _ in entries) * 15
    recording = Recording(path)
    tracemalloc.start()
    try:
        n = sum(1 for _ in recording.detections()) + sum(1 for _ in recording.poses())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert n > 15_000
    assert size > 15e6
    assert peak < 6e6


def test_a_recording_that_was_cut_off(tmp_path: Path):
    """It is read up to its end, and says so."""
    path = tmp_path / "cut.mcap"
    path.write_bytes(SAMPLE.read_bytes()[:400_000])
    recording = Recording(path)
    whole = list(Recording(SAMPLE).detections())
    read = list(recording.detections())
    assert 0 < len(read) < len(whole)
    assert read == whole[: len(read)]
    assert recording.cameras == ("east", "north", "south", "west")
    assert 0 < recording.duration_s < 8
    assert recording.faults["end: the recording was cut off"]


def test_observations_of_a_table():
    """The messages have the rows of the file, in order of time; the rig beside it gives the sizes of the images."""
    recording = Recording(WAND / "observations.csv")
    with (WAND / "observations.csv").open() as file:
        rows = [(int(row["t_ns"]), row["camera"], float(row["u"])) for row in csv.DictReader(file)]
    assert sum(len(message) for message in recording.detections()) == len(rows)
    assert recording.cameras == tuple(sorted({camera for _, camera, _ in rows}))
    assert recording.duration_s == (max(rows)[0] - min(rows)[0]) / 1e9
    assert recording.rig is not None
    for message in recording.detections(end_s=0.2):
        camera = recording.rig[message.camera]
        assert (message.width, message.height) == (camera.width, camera.height)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("absent.mcap", None, "does not exist"),
        ("text.mcap", "no recording", "not an MCAP recording"),
        ("table.csv", "a,b\n1,2\n", "lacks the column"),
    ],
)
def test_what_is_no_recording(tmp_path: Path, name: str, content: str | None, said: str):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ConfigError, match=said):
        list(Recording(tmp_path / name).detections())


def test_a_folder_may_hold_a_rig_and_robots(tmp_path: Path):
    shutil.copy(WAND / "truth.yaml", tmp_path / "rig.yaml")
    shutil.copy(ROOT / "configs" / "demo" / "robots.yaml", tmp_path)
    (tmp_path / "north").mkdir()
    recording = Recording(tmp_path)
    assert recording.cameras == ("north",)
    assert recording.rig is not None
    assert recording.robots is not None
    assert sorted(recording.rig) == ["east", "north", "south", "west"]
    assert recording.robots["rover"].diameter_m == 0.12
    for loaded in (recording.rig, recording.robots):
        loaded.save(tmp_path / "again.yaml")
        assert type(loaded).load(tmp_path / "again.yaml") == loaded


def test_pandas_is_optional():
    code = (
        "import sys; sys.modules['pandas'] = None\n"
        "from roundel import Recording, RoundelError\n"
        "try:\n    Recording('configs/sample/recording.mcap').to_pandas()\n"
        "except RoundelError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert "pip install 'roundel[pandas]'" in done.stdout, done.stderr
