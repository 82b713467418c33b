# SPDX-License-Identifier: BSD-3-Clause
"""Recordings in the formats of other programs, read back by independent readers: c3d, ezc3d, rosbags."""

import csv
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import c3d
import ezc3d
import msgspec
import numpy as np
import pyarrow.parquet as parquet
import pytest
from rosbags.highlevel import AnyReader

from calib.rig.camera import Camera
from calib.rig.recording import RecordingWriter, read_detections, read_messages
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import Pose, rotation_from_wxyz
from camera_node.protocol.messages import encode
from camera_node.sources.recorded_detections import read_observations
from fusion.__main__ import execute
from fusion.commands.export import export
from fusion.export import pose_formats
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import RobotPose, Robots
from tests.conftest import ROOT
from tests.fusion.bridges.foxglove_reader import read_mcap
from tests.fusion.bridges.pose_server import moving_pose
from tests.missing_package import advice_without
from tests.processes import run_here

START_NS, RATE_HZ, N = 1_790_000_000_000_000_000, 60, 180
BODY = Robot(diameter_m=0.09, markers=((0.1, 0.0, 0.0), (-0.1, 0.05, 0.0), (0.0, -0.1, 0.02)))
BODIES = {"rover": BODY, "drone": Robot(diameter_m=0.09)}
LOST = range(60, 90)  # poses of the drone
HERMITE_MM = 1e3 * RATE_HZ**-4 / 384 * 10  # the fourth derivative of `moving_pose` is below 10 m/s^4
FLOAT32_MM = 5e-4  # half a step of numbers up to 8192


def jittered(k: int) -> int:
    """Time of pose k: poses are up to 2 ms off the constant rate, as those of free-running cameras."""
    return START_NS + round(k * 1e9 / RATE_HZ) + round(2e6 * np.sin(7.0 * k)) * (0 < k < N - 1)


def recorded_poses() -> list[RobotPose]:
    return [
        moving_pose(robot, jittered(k), seed, "lost" if robot == "drone" and k in LOST else "tracked")
        for k in range(N)
        for seed, robot in enumerate(BODIES)
    ]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "in.mcap"
    with RecordingWriter(path) as writer:
        writer.put("x/robots", encode(Robots(robots=BODIES)), START_NS)
        for pose in recorded_poses():
            writer.put(f"x/robot/{pose.robot}/pose", encode(pose), pose.t_ns + 10_000_000)
        writer.put("x/robot/rover/pose", b"\xc1", START_NS)  # undecodable
        writer.put("x/robot/rover/pose", encode(moving_pose("rover", jittered(3))), START_NS)  # late
    return path


def true_points_mm() -> dict[str, np.ndarray]:
    """(N, 3) the points at the constant rate, from the motion itself."""
    points: dict[str, np.ndarray] = {}
    for seed, (robot, body) in enumerate(BODIES.items()):
        poses = [moving_pose(robot, START_NS + round(k * 1e9 / RATE_HZ), seed) for k in range(N)]
        for j, point in enumerate(np.vstack([np.zeros((1, 3)), body.points])):
            rows = [p.position + rotation_from_wxyz(p.quaternion_wxyz) @ point for p in poses]
            points[f"{robot}_{j}" if j else robot] = 1000 * np.array(rows)
    return points


def assert_points(label: str, points: np.ndarray, tolerance_mm: float) -> None:
    """Points (N, 3), mm, are those of the motion, and missing where the robot is lost."""
    missing = np.zeros(N, bool)
    if label.startswith("drone"):
        missing[LOST.start : LOST.stop] = True
        border = [LOST.start - 1, LOST.stop]  # with jitter, these frames may lie inside the gap
        missing[border] = np.isnan(points[border]).all(axis=1)
    assert (np.isnan(points).any(axis=1) == missing).all()
    assert np.abs(points[~missing] - true_points_mm()[label][~missing]).max() < tolerance_mm


def test_parquet_is_read_by_pyarrow_and_pandas(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """In several row groups, with each pose's own numbers; LeRobot's names of times."""
    monkeypatch.setattr(pose_formats, "ROW_GROUP", 100)
    out = tmp_path / "out.parquet"
    assert export(recording, out) == 0
    file = parquet.ParquetFile(out)
    assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == [100, 100, 100, 60]
    table, poses = file.read().to_pandas(), recorded_poses()
    assert list(table.t_ns) == [pose.t_ns for pose in poses]
    assert list(table.robot) == [pose.robot for pose in poses]
    assert list(table.state) == [pose.state for pose in poses]
    assert (table[["x", "y", "z"]].to_numpy() == [pose.position for pose in poses]).all()
    assert (table[["qw", "qx", "qy", "qz"]].to_numpy() == [pose.quaternion_wxyz for pose in poses]).all()
    covariances = np.stack(list(table.covariance)).reshape(-1, 12, 12)
    assert (covariances == [pose.covariance_matrix for pose in poses]).all()
    assert list(table.frame_index) == [k for k in range(N) for _ in BODIES]
    assert (table.timestamp == (table.t_ns - START_NS) / 1e9).all()


def test_observations_are_the_recorded_detections(tmp_path: Path):
    """Of the sample: every centre, at its frame's time; frames without a roundel have no row."""
    source, out = ROOT / "configs" / "sample" / "recording.mcap", tmp_path / "observations.csv"
    assert export(source, out, format="observations") == 0
    sent = {(m.camera, m.t_ns): m.unpack().uv for m in read_detections(source) if len(m)}
    got = {(m.camera, m.t_ns): m.unpack().uv for m in read_observations(out)}
    assert got.keys() == sent.keys()
    for key, uv in sent.items():
        np.testing.assert_allclose(got[key], uv, atol=0.5001e-4)


@pytest.mark.parametrize("out", ["results", ".", "..", "results.d", "link"])
@pytest.mark.parametrize("command", ["replay --out", "export --force", "export --force --format csv"])
def test_a_result_replaces_no_folder(tmp_path: Path, command: str, out: str):
    """Before, replay --out FOLDER and export FOLDER --force deleted the folder with all that was in it."""
    source = ROOT / "configs" / "sample" / "recording.mcap"
    inside = tmp_path / "here" / "inside"
    for folder in ("results", "results.d"):
        (inside / folder / "years").mkdir(parents=True)
        (inside / folder / "years" / "of.mcap").write_text("work")
    (inside / "link").symlink_to("results")
    before = sorted(tmp_path.rglob("*"))
    name, *options = command.split()
    words = [source, *options, out] if name == "replay" else [source, out, *options]
    done = run_here(lambda: execute([name, *map(str, words)]), inside)
    assert done.returncode == 2, done.stdout
    assert "Traceback" not in done.stderr
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.ci
def test_rerun_reads_its_recording(recording: Path, tmp_path: Path):
    """By Rerun's own reader: each pose that is not lost at its time, and the cameras."""
    chunks = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed: pip install '.[rerun]'")
    pose = Pose(position_m=(0.0, 0.0, 2.0), wxyz=(0.0, 1.0, 0.0, 0.0))
    camera = Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0, T_world_cam=pose)
    rig = RigMessage(rig=Rig(cameras={"north": camera}), t_ns=START_NS)
    with RecordingWriter(tmp_path / "both.mcap") as writer:
        writer.put("x/rig", encode(rig), START_NS)
        for key, data, t_ns in read_messages(recording, Counter()):
            writer.put(key, data, t_ns)
    out = tmp_path / "out.rrd"
    assert export(tmp_path / "both.mcap", out) == 0
    found: dict[str, dict[int, list[float]]] = {}
    for chunk in chunks.RrdReader(str(out)).stream():
        batch = chunk.to_record_batch()
        if "Transform3D:translation" in batch.schema.names:
            times = batch["capture"].cast("int64").to_pylist()
            places = batch["Transform3D:translation"].to_pylist()
            entity = found.setdefault(chunk.entity_path, {})
            entity.update({t: place[0] for t, place in zip(times, places, strict=True) if place})
    assert found["/world/cameras/north"] == {START_NS: [0, 0, 2]}
    for robot in BODIES:
        expected = {p.t_ns: p.position for p in recorded_poses() if p.robot == robot and p.state != "lost"}
        rows = found[f"/world/robots/{robot}"]
        assert rows.keys() == expected.keys()
        np.testing.assert_allclose([rows[t] for t in expected], list(expected.values()), rtol=1e-6)


@pytest.mark.ci
def test_c3d_is_read_by_two_libraries(recording: Path, tmp_path: Path):
    out = tmp_path / "out.c3d"
    assert export(recording, out) == 0
    content = ezc3d.c3d(str(out))
    labels = content["parameters"]["POINT"]["LABELS"]["value"]
    assert labels == ["rover", "rover_1", "rover_2", "rover_3", "drone", "drone_1"]
    assert content["parameters"]["POINT"]["RATE"]["value"] == [RATE_HZ]
    assert content["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    assert content["parameters"]["ROUNDEL"]["START_UTC_NS"]["value"] == [str(START_NS)]
    for k, label in enumerate(labels):
        assert_points(label, content["data"]["points"][:3, k].T, HERMITE_MM + FLOAT32_MM)
    with out.open("rb") as file:
        with warnings.catch_warnings(action="ignore"):  # it has no analog data
            reader = c3d.Reader(file)
        frames = np.array([points for _, points, _ in reader.read_frames()])
    assert [label.strip() for label in reader.point_labels] == labels
    assert reader.point_rate == RATE_HZ
    for k, label in enumerate(labels):
        points = np.where(frames[:, k, 3:4] < 0, np.nan, frames[:, k, :3])  # a negative residual: no point
        assert_points(label, points, HERMITE_MM + FLOAT32_MM)


def test_trc_has_the_points_in_millimetres(recording: Path, tmp_path: Path):
    out = tmp_path / "out.trc"
    export(recording, out)
    lines = out.read_text().splitlines()
    values = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert (float(values["DataRate"]), int(values["NumFrames"]), values["Units"]) == (RATE_HZ, N, "mm")
    labels = [label for label in lines[3].split("\t")[2:] if label]
    assert int(values["NumMarkers"]) == len(labels) == 6
    rows = [line.split("\t") for line in lines[6:]]
    assert {len(row) for row in rows} == {2 + 3 * len(labels)}
    assert [float(row[1]) for row in rows] == pytest.approx(np.arange(N) / RATE_HZ, abs=1e-6)
    for k, label in enumerate(labels):
        points = [[float(x or "nan") for x in row[2 + 3 * k : 5 + 3 * k]] for row in rows]
        assert_points(label, np.array(points), HERMITE_MM + 1e-4)


def test_points_are_sampled_at_another_rate(recording: Path, tmp_path: Path):
    export(recording, tmp_path / "out.c3d", rate_hz=20.0, robots=("rover",))
    points = ezc3d.c3d(str(tmp_path / "out.c3d"))["data"]["points"][:3, 0].T
    assert np.abs(points - true_points_mm()["rover"][::3]).max() < HERMITE_MM + FLOAT32_MM


def test_csv_has_every_pose(recording: Path, tmp_path: Path):
    export(recording, tmp_path / "out.csv")
    with (tmp_path / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    poses = recorded_poses()
    assert [(int(r["t_ns"]), r["robot"], r["state"]) for r in rows] == [
        (p.t_ns, p.robot, p.state) for p in poses
    ]
    positions = np.array([[float(r[c]) for c in "xyz"] for r in rows])
    assert positions == pytest.approx(np.array([p.position for p in poses]), rel=1e-6, abs=1e-7)


def test_tum_has_one_file_for_each_robot(recording: Path, tmp_path: Path):
    export(recording, tmp_path / "out.tum")
    for robot in BODIES:
        rows = np.loadtxt(tmp_path / f"out-{robot}.tum")
        poses = [p for p in recorded_poses() if p.robot == robot and p.state != "lost"]
        assert rows[:, 1:4] == pytest.approx(np.array([p.position for p in poses]), abs=1e-8)
        wxyz = np.array([p.quaternion_wxyz for p in poses])
        assert rows[:, [7, 4, 5, 6]] == pytest.approx(wxyz, abs=1e-8)
        stamps = [line.split()[0] for line in (tmp_path / f"out-{robot}.tum").read_text().splitlines()]
        assert [int(s.replace(".", "")) for s in stamps] == [p.t_ns for p in poses]
    export(recording, tmp_path / "one.tum", robots=("drone",))
    assert (tmp_path / "one.tum").read_bytes() == (tmp_path / "out-drone.tum").read_bytes()


def test_files_of_single_robots_are_replaced_by_force_only(recording: Path, tmp_path: Path):
    kept = tmp_path / f"out-{next(iter(BODIES))}.tum"
    kept.write_text("mine")
    with pytest.raises(ConfigError, match="--force"):
        export(recording, tmp_path / "out.tum")
    assert [file.name for file in tmp_path.iterdir() if file.suffix == ".tum"] == [kept.name]
    assert kept.read_text() == "mine"
    export(recording, tmp_path / "out.tum", force=True)
    assert kept.read_text() != "mine"


def test_a_ros_2_bag_has_the_messages_of_the_bridge(recording: Path, tmp_path: Path):
    for is_again in (False, True):  # a bag replaces a bag
        export(recording, tmp_path / "bag", force=is_again)
    expected = {(p.robot, p.t_ns): p for p in recorded_poses() if p.state != "lost"}
    counts: dict[str, int] = {}
    with AnyReader([tmp_path / "bag"]) as reader:
        for connection, t_ns, data in reader.messages():
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic.endswith("/odometry"):
                pose = expected[connection.topic.split("/")[1], t_ns]
                place, stamp = message.pose.pose.position, message.header.stamp  # pyright: ignore[reportAttributeAccessIssue]
                assert (place.x, place.y, place.z) == pose.position
                assert stamp.sec * 10**9 + stamp.nanosec == t_ns
    n_drone = N - len(LOST)
    assert counts == {
        "/rover/pose": N,
        "/rover/odometry": N,
        "/drone/pose": n_drone,
        "/drone/odometry": n_drone,
        "/tf": N + n_drone,
    }


def test_a_file_for_foxglove_has_the_arena(recording: Path, tmp_path: Path):
    export(recording, tmp_path / "out.mcap")
    found = read_mcap(tmp_path / "out.mcap")
    poses = recorded_poses()
    assert set(found) == {"/tf", "/cameras/tf", "/scene", "/robots/rover/pose", "/robots/drone/pose", "/log"}
    for robot in BODIES:
        expected = [p for p in poses if p.robot == robot and p.state != "lost"]
        messages = found[f"/robots/{robot}/pose"]
        assert [t_ns for t_ns, _ in messages] == [p.t_ns for p in expected]
        positions = [(m.pose.position.x, m.pose.position.y, m.pose.position.z) for _, m in messages]
        assert positions == [p.position for p in expected]
    assert len(found["/tf"]) == 2 * N - len(LOST)
    (_, scene), (_, lost), (_, tracked) = found["/scene"]
    assert {(e.id, len(e.cylinders)) for e in scene.entities} == {("rover", 3), ("drone", 1)}
    assert [deletion.id for deletion in lost.deletions] == ["drone"]  # a lost robot is not shown where it was
    assert [entity.id for entity in tracked.entities] == ["drone"]
    assert [m.message for _, m in found["/log"]] == ["drone is lost", "drone is tracked"]


def test_what_can_not_be_exported_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    export(recording, tmp_path / "out.csv")
    assert "1 undecodable poses" in capsys.readouterr().out
    (tmp_path / "empty.mcap").touch()
    with RecordingWriter(tmp_path / "none.mcap") as writer:
        writer.put("x/robots", encode(Robots(robots=BODIES)), START_NS)
    cases: list[tuple[tuple[Path, Path], dict[str, Any], str]] = [
        ((recording, tmp_path / "out.csv"), {}, "--force"),
        ((recording, tmp_path / "out.xyz"), {}, "--format"),
        ((recording, tmp_path / "no" / "out.csv"), {}, "does its folder exist"),
        ((recording, tmp_path / "no" / "out.c3d"), {}, "can't be written"),
        ((tmp_path / "empty.mcap", tmp_path / "new.csv"), {}, "not an MCAP recording"),
        ((tmp_path / "none.mcap", tmp_path / "new.csv"), {}, "holds no poses"),
        ((recording, tmp_path / "new.csv"), {"robots": ("ghost",)}, "no poses of ghost"),
        ((recording, tmp_path / "new.c3d"), {"rate_hz": float("nan")}, "--rate-hz"),
        ((recording, tmp_path / "new.c3d"), {"rate_hz": 1e-9}, "--rate-hz"),
    ]
    for arguments, options, reason in cases:
        with pytest.raises(ConfigError, match=reason):
            export(*arguments, **options)
    assert {p.name for p in tmp_path.iterdir()} == {"in.mcap", "out.csv", "empty.mcap", "none.mcap"}


def test_a_recording_too_long_for_c3d_is_refused(tmp_path: Path):
    with RecordingWriter(tmp_path / "long.mcap") as writer:
        for k in (0, 1, 2, 70_000):
            pose = msgspec.structs.replace(
                moving_pose("rover", START_NS), t_ns=START_NS + k * 10**9 // RATE_HZ
            )
            writer.put("x/robot/rover/pose", encode(pose), pose.t_ns)
    with pytest.raises(ConfigError, match="C3D has 65535 at most: give a lower --rate-hz"):
        export(tmp_path / "long.mcap", tmp_path / "out.c3d")
    export(tmp_path / "long.mcap", tmp_path / "out.c3d", rate_hz=50.0)
    points = ezc3d.c3d(str(tmp_path / "out.c3d"))["data"]["points"][:3, 0]
    assert points.shape == (3, 70_000 * 50 // 60 + 1)
    assert np.isfinite(points[:, 0]).all()


@pytest.mark.parametrize(
    ("package", "out"),
    [
        ("ezc3d", "out.c3d"),
        *(
            pytest.param(*case, marks=pytest.mark.ci)
            for case in (("rosbags", "bag"), ("pyarrow", "out.parquet"), ("rerun", "out.rrd"))
        ),
    ],
)
def test_without_its_library_one_line_says_what_to_install(recording: Path, package: str, out: str):
    advice = advice_without(package, "fusion", "export", str(recording), str(recording.with_name(out)))
    extra = {"pyarrow": "parquet", "rerun": "rerun"}.get(package, "export")
    assert f"pip install 'roundel[{extra}]'" in advice
