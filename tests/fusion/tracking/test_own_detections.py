# SPDX-License-Identifier: BSD-3-Clause
"""A covered robot does not adapt to the roundels of others; one that a single camera still sees is tracked."""

from dataclasses import replace

import numpy as np
import pytest

from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import rotation_from_vector
from fusion.model.frames import CalibratedFrame
from fusion.model.states import POSITION
from fusion.protocol.pose_messages import RobotPose
from tests.benchmarks.trust import RIGHT, Case, run
from tests.fusion.synthetic import TRIANGLE, Arena, line
from tests.fusion.tracks import errors, poses_of, track

COVERED_S = 0.6  # from then on
MAX_SIGMAS = 5.0
SEEN = Arena({"a": TRIANGLE}, {"a": line((0.1, -0.2, 0.3), (0.4, 0.3, 0.0), turn=(0, 0, 0.5))}, sigma_px=0.1)
OTHERS = 30  # roundels elsewhere in each image, so that one near a marker is not improbable
FEW = 6  # so few that none of them is expected in a gate


def arena(hides_all: bool) -> Arena:
    """The same robot, covered from `COVERED_S` on or not at all."""
    return replace(SEEN, hidden=lambda robot, marker, t: hides_all and t > COVERED_S)


def with_roundel(frame: CalibratedFrame, visible: CalibratedFrame, shift_px: tuple[float, float]):
    """A frame with another roundel beside a marker that would be visible without the cover."""
    columns = {name: getattr(visible.roundels.select(np.array([0])), name) for name in Roundels.__slots__}
    columns["uv"] = columns["uv"] + shift_px
    both = [np.concatenate([getattr(frame.roundels, name), columns[name]]) for name in Roundels.__slots__]
    return CalibratedFrame.measure(frame.camera, frame.t_ns, Roundels(*both), SEEN.cameras[frame.camera])


def sigmas(pose: RobotPose, arena: Arena = SEEN) -> float:
    """The error of a position in its own standard deviations."""
    error = errors(arena, [pose])[0][3:]
    return float(np.sqrt(error @ np.linalg.solve(pose.covariance_matrix[POSITION, POSITION], error)))


@pytest.mark.parametrize("shift_px", [(-4.0, -2.0), (-3.0, 4.0), (5.0, -3.0)])
def test_one_roundel_of_another_is_not_the_robot(shift_px: tuple[float, float]):
    """Before, its pose was up to 175 mm or 51 of its standard deviations off in state tracked, for 0.1 s."""
    covered, visible = (replace(arena(is_covered), distractors=OTHERS) for is_covered in (True, False))
    frames, seen = covered.frames(30), visible.frames(30)
    first = next(k for k, f in enumerate(frames) if f.camera == "cam2" and SEEN.seconds(f.t_ns) > COVERED_S)
    clean = arena(False).frames(30)
    assert len(seen[first].roundels) > len(frames[first].roundels)
    frames[first] = with_roundel(frames[first], clean[first], shift_px)
    poses = poses_of(track(covered, frames), "a")
    late = [pose for pose in poses if SEEN.seconds(pose.t_ns) > COVERED_S - 0.1]
    assert any(pose.state != "tracked" for pose in late)
    assert all(sigmas(pose) < MAX_SIGMAS for pose in late if pose.state == "tracked")


def test_a_robot_that_one_camera_still_sees_is_tracked():
    """Its three markers there are no chance, although nine others are missing; before, it followed roundels of other
    cameras by 65 mm."""
    frames = replace(SEEN, distractors=OTHERS).frames(30)
    empty = replace(arena(True), distractors=OTHERS).frames(30)
    left = [f if f.camera == "cam1" else e for f, e in zip(frames, empty, strict=True)]
    late = [p for p in poses_of(track(SEEN, left), "a") if SEEN.seconds(p.t_ns) > COVERED_S + 0.05]
    assert len(late) > 5
    assert all(pose.state == "tracked" and pose.cameras == ("cam1",) for pose in late)
    assert all(sigmas(pose) < MAX_SIGMAS for pose in late)


@pytest.mark.parametrize("shift_px", [(4.0, 2.0), (-4.0, 2.0), (4.0, -1.0), (0.0, 5.0)])
def test_one_roundel_in_place_of_three_displaces_no_robot(shift_px: tuple[float, float]):
    """Frames of two cameras come late: of the others one shows all markers, and one a single roundel near where they
    would be. The velocity explains both exactly; before, poses were up to 10 of their standard deviations off.
    """
    seen, clean = replace(SEEN, distractors=FEW).frames(30), arena(False).frames(30)
    empty = replace(arena(True), distractors=FEW).frames(30)
    late = [SEEN.seconds(f.t_ns) > COVERED_S for f in seen]
    first = next(k for k, f in enumerate(seen) if late[k] and f.camera == "cam2")
    seen[first] = with_roundel(empty[first], clean[first], shift_px)
    frames = [f for k, f in enumerate(seen) if not late[k] or f.camera == "cam1" or k == first]
    poses = [p for p in poses_of(track(SEEN, frames), "a") if SEEN.seconds(p.t_ns) > COVERED_S - 0.05]
    assert len(poses) > 5
    assert all(pose.state == "tracked" and sigmas(pose) < MAX_SIGMAS for pose in poses)


def shaken(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Back and forth twice a second by 7 cm, which no prediction foresees."""
    way = 0.07 * np.sin(4 * np.pi * t)
    return rotation_from_vector((0.0, 0.0, 0.3 * t)), np.array([0.1 + way, -0.2 + 0.5 * way, 0.3])


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_in_clutter_displaces_no_robot(seed: int):
    """It shows a thousand other roundels and a third of the markers; the nearest detection often is another's. Before,
    poses of two of these four runs were up to 9 of their standard deviations off."""
    clear = replace(SEEN, motions={"a": shaken}, seed=seed)
    dense = replace(
        clear, distractors=1000, hidden=lambda robot, marker, t: (7 * marker + round(30 * t)) % 3 > 0
    )
    both = zip(clear.frames(45), dense.frames(45), strict=True)
    frames = [d if f.camera == "cam2" and clear.seconds(f.t_ns) > 0.2 else f for f, d in both]
    poses = [pose for pose in poses_of(track(clear, frames), "a") if clear.seconds(pose.t_ns) > 0.1]
    assert all(pose.state == "tracked" and sigmas(pose, clear) < MAX_SIGMAS for pose in poses)


@pytest.mark.ci
def test_a_first_view_of_few_markers_is_judged_by_the_other_views():
    """A camera is turned by 3 degrees from the start: now and then a marker's image is where another one is expected.
    One was usual from the first frame on; 15 px off, it changed the velocity by 0.9 m/s, which frames of different
    times determine badly. The robot was 0.5 m off within 0.2 s, with a claim of 8 mm, and two good cameras were
    excluded."""
    outcome = run(Case(kind="turned 3 deg", cameras=4, seed=2, robots=1, at_start=True))
    assert outcome.report == "right", outcome.lines
    assert max(outcome.ratios) < RIGHT
