# SPDX-License-Identifier: BSD-3-Clause
"""Cameras that see different sides of the wand are joined by its pose as a rigid body."""

import os
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.commands.formats import ImportData
from calib.rig.camera import transform
from calib.rig.rig import Rig, load_rig
from calib.rig.wand_file import WandBody, load_wand
from calib.wand.body_poses import BodyLocator, solve_view
from calib.wand.calibrate import calibrate
from calib.wand.detections import MarkerTrack
from calib.wand.initial_rig import TwoViewGeometry, build_initial_rig
from calib.wand.labels import label_recording
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import Pose, invert, rotation_from_vector
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import read_observations
from tests.calib.cube import CORNERS, CUBE, SIGMA_PX, one_after_the_other, wave
from tests.calib.synthetic import CAREFUL, assert_honest, camera_errors, ring, roughly, see_points


def only(messages: list[Detections], name: str, keep: Callable[[Detections], bool]) -> list[Detections]:
    """The messages, of one camera those for which `keep` is true."""
    return [message for message in messages if message.camera != name or keep(message)]


@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("sides", [1, pytest.param(2, marks=pytest.mark.ci)])
def test_eight_cameras_around_a_cube_are_placed_with_an_honest_covariance(sides: int, seeds: int):
    """The squared Mahalanobis errors of all poses, summed over recordings, are between the 0.1 % and 99.9 % quantiles
    of chi-square."""
    arena, results = ring(8, wand=CUBE), []
    for seed in range(seeds):
        rig = roughly(arena.intrinsics, CAREFUL, with_sigma=True, seed=seed)
        result = calibrate(rig, CUBE, wave(arena, sides, 40, seed), synchronous=True)
        assert len(result.rig.placed()) == 8
        assert camera_errors(result.rig, arena.truth)[0].max() < 0.02
        results.append((result, arena.truth))
    assert_honest(results, exactly=True)


def test_one_frame_places_a_camera_that_saw_two_sides():
    arena = ring(4, wand=CUBE)
    messages = only(wave(arena, 2, 40, 0), "cam2", lambda message: message.seq == 3)
    result = calibrate(arena.intrinsics, CUBE, messages, synchronous=True)
    assert len(result.rig.placed()) == 4
    sigma = {n: np.sqrt(np.diag(np.array(c.covariance))[3:].sum()) for n, c in result.rig.cameras.items()}
    assert sigma["cam2"] > 2 * sigma["cam0"]
    assert camera_errors(result.rig, arena.truth)[0][2] < 4 * sigma["cam2"]


@pytest.mark.ci
def test_one_frame_of_one_side_leaves_a_camera_out_where_it_allows_two_poses():
    arena = ring(4, wand=CUBE)
    messages = only(wave(arena, 2, 40, 0), "cam2", lambda message: message.seq == 7)
    result = calibrate(arena.intrinsics, CUBE, messages, synchronous=True)
    assert "allow two poses" in result.report.unplaced["cam2"]


@pytest.mark.ci
def test_free_running_cameras_are_joined_by_the_body_too():
    arena = ring(4, wand=CUBE)
    messages = wave(arena, 1, 80, 0, period_ns=50_000_000, phase=0.24)
    result = calibrate(arena.intrinsics, CUBE, messages)
    assert len(result.rig.placed()) == 4
    assert camera_errors(result.rig, arena.truth)[0].max() < 0.03


def test_cameras_that_never_saw_the_wand_together_are_named_with_what_would_connect_them():
    """cam2 and cam3 record after cam0 and cam1."""
    arena, late = ring(4, wand=CUBE), ("cam2", "cam3")
    messages = [m for m in wave(arena, 2, 80, 0) if (m.camera in late) == (m.seq >= 40)]
    result = calibrate(arena.intrinsics, CUBE, messages, synchronous=True)
    assert set(result.report.unplaced) in ({"cam0", "cam1"}, {"cam2", "cam3"})
    for reason in result.report.unplaced.values():
        assert "any side of the wand" in reason


@pytest.mark.ci
def test_cameras_that_see_the_wand_one_after_the_other_get_an_initial_pose():
    arena, messages = one_after_the_other((2, 2), 200)
    recording = label_recording(arena.intrinsics, CUBE, messages)
    pairs = TwoViewGeometry(recording.detections, recording.lenses, CUBE, recording.timing)
    start = build_initial_rig(pairs, range(4))
    assert start.placed == [0, 1, 2, 3]
    poses = dict(zip(recording.names, (Pose.from_matrix(start.poses[k]) for k in range(4)), strict=True))
    rough = {n: msgspec.structs.replace(c, T_world_cam=poses[n]) for n, c in arena.truth.cameras.items()}
    assert camera_errors(Rig(cameras=rough), arena.truth)[0].max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("groups", "frames"), [((2, 2), 200), ((2, 1), 300)])
def test_cameras_that_see_the_wand_one_after_the_other_are_joined_by_its_motion(
    groups: tuple[int, ...], frames: int
):
    """The 99.9 % quantile of chi-square bounds the error of all poses."""
    arena, messages = one_after_the_other(groups, frames)
    result = calibrate(roughly(arena.intrinsics, CAREFUL, with_sigma=True), CUBE, messages)
    assert len(result.rig.placed()) == sum(groups)
    assert camera_errors(result.rig, arena.truth)[0].max() < 0.03
    assert_honest([(result, arena.truth)])


def test_the_motion_of_the_wand_gives_its_pose_in_a_frame_next_to_those_of_placed_cameras():
    """At constant velocity exactly, before the first and after the last frame; not beyond the longest gap."""
    T_0 = np.eye(4)
    T_0[:3, :3], T_0[:3, 3] = rotation_from_vector([0.2, -0.5, 0.1]), [0.1, 0.2, 3.0]

    def pose(t_s: float) -> Array:
        T = T_0.copy()
        T[:3, :3] = rotation_from_vector([0.0, 0.4 * t_s, 0.3 * t_s]) @ T_0[:3, :3]
        T[:3, 3] += t_s * np.array([0.5, -0.2, 0.3])
        return T

    t_s = np.linspace(0.0, 0.2, 5)
    p = np.array([transform(pose(t), CUBE.points) for t in t_s])
    tracks = [[MarkerTrack.of(t_s, p[:, k, :2] / p[:, k, 2:]) for k in range(16)]]
    locator = BodyLocator(tracks, CUBE.points, {0: np.eye(4)}, {0: 0.0}, 0.12)
    times = locator.locate_by_motion(np.array([-0.15, -0.08, -0.04, 0.24, 0.28, 0.4]))
    assert times.tolist() == [-0.04, 0.24]
    for t, (found,) in zip(times, locator.locate(times), strict=True):
        assert found == pytest.approx(pose(t), abs=1e-3)


def test_one_view_of_a_plane_leaves_two_poses_and_a_second_camera_decides():
    """A small square, far away and nearly frontal."""
    camera = ring(2).truth.cameras["cam0"]
    square = 0.3 * np.column_stack([CORNERS, np.zeros(4)])
    T_cam_wand = np.eye(4)
    T_cam_wand[:3, :3], T_cam_wand[:3, 3] = rotation_from_vector([0.25, 0.1, 0.3]), [0.1, 0.2, 4.0]
    beside = np.eye(4)
    beside[:3, :3], beside[:3, 3] = rotation_from_vector([0, -0.7, 0]), [2.5, 0, 1.0]
    images = [transform(T, square) for T in (T_cam_wand, invert(beside) @ T_cam_wand)]
    rng = np.random.default_rng(0)
    images = [p[:, :2] / p[:, 2:] + 0.2 / camera.fx * rng.standard_normal((4, 2)) for p in images]
    assert len(solve_view(square, images[0])) == 2
    tracks = [[MarkerTrack.of(np.zeros(1), xy[None]) for xy in image] for image in images]
    alone = BodyLocator(tracks, square, {0: np.eye(4)}, {0: 0.0}, 0.0)
    assert len(alone.locate(np.zeros(1))[0]) == 2
    both = BodyLocator(tracks, square, {0: np.eye(4), 1: beside}, {0: 0.0, 1: 0.0}, 0.0)
    (found,) = both.locate(np.zeros(1))[0][:1]
    assert transform(found, square) == pytest.approx(transform(T_cam_wand, square), abs=0.02)


@pytest.mark.ci
def test_ten_frames_of_many_numbered_points_place_the_cameras():
    """A board of 240 points: the sample of detections for two views holds six frames of them, of which eight are
    needed."""
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 24), np.linspace(-0.3, 0.3, 10)), axis=-1).reshape(
        -1, 2
    )
    board = WandBody(markers=tuple((x, y, 0.0) for x, y in grid.tolist()))
    arena, rng, messages = ring(4), np.random.default_rng(0), []
    for seq in range(10):
        t_ns = 700_000_000 * seq
        points = transform(arena.wand_pose(1e-9 * t_ns), board.points)
        for name, camera in arena.truth.cameras.items():
            uv = camera.project_world(points) + SIGMA_PX * rng.standard_normal((240, 2))
            messages.append(see_points(name, camera, uv, SIGMA_PX, seq=seq, t_ns=t_ns))
    result = calibrate(arena.intrinsics, board, messages, synchronous=True)
    assert len(result.rig.placed()) == 4
    assert camera_errors(result.rig, arena.truth)[0].max() < 0.01


DATA = Path(os.environ.get("ROUNDEL_SHARED_DATA", "/work/shared/data")) / "tag_wand"


@pytest.mark.ci
@pytest.mark.skipif(not DATA.is_dir(), reason=f"{DATA} is absent")
def test_the_tag_wand_of_tagslam_places_all_eight_cameras(tmp_path: Path):
    """One camera sees a single tag in a single frame, another shares no tag with any. A plain bundle adjustment of all
    points has 0.45 px, TagSLAM 0.53 px."""
    ImportData(format="kalibr", files=(DATA / "camchain.yaml",), out=tmp_path).run()
    rig = load_rig(tmp_path / "rig.yaml")
    sizes = {name: (lens.width, lens.height) for name, lens in rig.cameras.items()}
    messages = read_observations(DATA / "wand.csv", sizes)
    result = calibrate(rig, load_wand(DATA / "wand.yaml"), messages, synchronous=True)
    assert len(result.rig.placed()) == 8
    assert len(np.unique(result.adjusted.problem.knot_s)) == 101
    assert np.sqrt(np.mean(result.adjusted.residuals[result.adjusted.used] ** 2)) < 0.45
