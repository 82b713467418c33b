# SPDX-License-Identifier: BSD-3-Clause
"""What the drawings of a recording show, read from the figures; and the files that the command writes."""

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from calib.rig.recording import RecordingWriter
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import encode
from fusion.commands.plot import plot
from fusion.export import plots
from fusion.export.plots import compare_positions, draw_comparison, draw_recording, read_curves
from fusion.protocol.pose_messages import RobotPose
from tests.fusion.bridges.pose_server import moving_pose
from tests.messages import HEALTH, STATUS

START_NS, N = 1_790_000_000_000_000_000, 100
LOST = range(40, 60)
STEP_NS = 20_000_000


def recorded_poses(robot: str, seed: int, offset_m: float = 0.0) -> list[RobotPose]:
    poses = [
        moving_pose(robot, START_NS + k * STEP_NS, seed, "lost" if k in LOST else "tracked") for k in range(N)
    ]
    moved = [(pose.position[0], pose.position[1] + offset_m, pose.position[2]) for pose in poses]
    return [msgspec.structs.replace(p, position=xyz) for p, xyz in zip(poses, moved, strict=True)]


def write_recording(path: Path, robots: dict[str, int], offset_m: float = 0.0) -> Path:
    with RecordingWriter(path) as writer:
        for robot, seed in robots.items():
            for pose in recorded_poses(robot, seed, offset_m):
                writer.put(f"x/robot/{robot}/pose", encode(pose), pose.t_ns)
        for k, residual in enumerate([0.1, None, 0.3]):
            cameras = {"north": msgspec.structs.replace(HEALTH, residual_px=residual)}
            status = msgspec.structs.replace(STATUS, t_ns=START_NS + k * 10**9, cameras=cameras)
            writer.put("x/fusion/status", encode(status), status.t_ns)
        writer.put("x/fusion/status", b"\xc1", START_NS)
    return path


def test_the_figure_shows_the_recorded_numbers(tmp_path: Path):
    figure = draw_recording(read_curves(write_recording(tmp_path / "a.mcap", {"rover": 1, "drone": 2})))
    top, residuals, *positions, sigmas = figure.get_axes()
    poses = recorded_poses("drone", 2)
    expected = np.array([[np.nan] * 3 if p.state == "lost" else p.position for p in poses])
    for k, axes in enumerate(positions):
        drone, rover = axes.get_lines()
        np.testing.assert_array_equal(
            drone.get_xydata(), np.stack([STEP_NS * np.arange(N) / 1e9, expected[:, k]], 1)
        )
        assert drone.get_color() != rover.get_color()
    assert {line.get_label(): line.get_color() for line in top.get_lines()} == {
        line.get_label(): line.get_color() for line in positions[0].get_lines()
    }
    variances = np.array([p.covariance_matrix.diagonal()[3:6] for p in poses])
    drawn = np.array(sigmas.get_lines()[0].get_ydata(), float)
    known = np.isfinite(drawn)
    np.testing.assert_array_equal(np.flatnonzero(~known), LOST)
    np.testing.assert_allclose(drawn[known], 1e3 * np.sqrt(variances.max(axis=1))[known], rtol=1e-9)
    (north,) = residuals.get_lines()
    np.testing.assert_array_equal(north.get_ydata(), [0.1, np.nan, 0.3])


def test_curves_of_any_length_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The rows that are kept are equally spaced and reach to the end."""
    monkeypatch.setattr(plots, "MAX_POINTS", 16)
    curve = plots.Curve()
    for k in range(1000):
        curve.add(k, [k])
    assert 8 <= len(curve.rows) < 16
    assert curve.t_ns == [row[0] for row in curve.rows]
    (step,) = set(np.diff(curve.t_ns))
    assert 1000 - step <= curve.t_ns[-1]


def test_two_recordings_are_compared_where_both_have_the_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    first = write_recording(tmp_path / "a.mcap", {"rover": 1, "drone": 2})
    second = write_recording(tmp_path / "b.mcap", {"drone": 2}, offset_m=0.003)
    ((name, seconds, distances),) = compare_positions(read_curves(first), read_curves(second))
    assert name == "drone"
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(distances)), LOST)
    np.testing.assert_allclose(distances[np.isfinite(distances)], 3.0, rtol=1e-9)
    assert len(seconds) == N
    assert plot(first, out=tmp_path / "apart.svg", compare=second) == 0
    assert "drone: 3.000 mm RMS apart, 3.000 mm at most" in capsys.readouterr().out
    (axes,) = draw_comparison(read_curves(first), read_curves(second)).axes
    assert [line.get_label() for line in axes.get_lines()] == ["drone: RMS 3.00 mm"]
    stranger = write_recording(tmp_path / "c.mcap", {"puck": 3})
    with pytest.raises(ConfigError, match="no robot in common"):
        plot(first, out=tmp_path / "none.png", compare=stranger)
    assert not (tmp_path / "none.png").exists()


@pytest.mark.ci
def test_the_command_writes_a_picture_and_replaces_none(tmp_path: Path):
    recording = write_recording(tmp_path / "a.mcap", {"rover": 1})
    assert plot(recording) == 0
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    with pytest.raises(ConfigError, match="--force"):
        plot(recording)
    assert plot(recording, force=True, out=tmp_path / "a.pdf") == 0
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(ConfigError, match=r"\.png, \.pdf, \.svg"):
        plot(recording, out=tmp_path / "a.xyz")
    with pytest.raises(ConfigError, match="no poses of ghost"):
        plot(recording, out=tmp_path / "ghost.png", robots=("ghost",))
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap", "a.png", "a.pdf"}
