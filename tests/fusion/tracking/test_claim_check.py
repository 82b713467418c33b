# SPDX-License-Identifier: BSD-3-Clause
"""Residuals that contradict their claims name the camera or the robot at fault, or say that nothing decides."""

from collections.abc import Mapping
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calib.rig.camera import Camera
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.frames import CalibratedFrame
from fusion.model.robots import Robot
from fusion.protocol.arena_health import describe_contradiction
from fusion.protocol.pose_messages import Contradiction
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.claim_check import MAX_RATIO, _Equations
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, circle, ring

ROBOTS = {"a": TRIANGLE, "b": WIDE}
DEGREES = 0.1  # that a camera turns: its detections stay within their gates
FRAME_SETS = 180  # of which 22 are compared


def frames(n_cameras: int) -> list[CalibratedFrame]:
    """Of two robots that drive around, by cameras with their true poses."""
    phases = (0.0, 0.27, -0.41, 0.38, 0.1, -0.2)
    motions = {"a": circle(8, 0.8), "b": circle(-8, 1.3, 0.4)}
    return Arena(ROBOTS, motions, ring(n_cameras), phases, sigma_px=0.1).frames(FRAME_SETS)


@pytest.fixture(scope="module")
def of_four() -> list[CalibratedFrame]:
    return frames(4)


@pytest.fixture(scope="module")
def of_six() -> list[CalibratedFrame]:
    return frames(6)


def contradictions(
    seen: list[CalibratedFrame], cameras: dict[str, Camera], robots: Mapping[str, Robot] = ROBOTS
) -> tuple[Contradiction, ...]:
    """What a tracker with this rig and these robots finds."""
    tracker, synchronizer = Tracker(cameras, dict(robots)), FrameSynchronizer(PERIOD_NS)
    for frame in seen:
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            tracker.track(frame_set)
    return tracker.claims.contradictions()


def with_turned(cameras: dict[str, Camera], name: str, degrees: float = DEGREES) -> dict[str, Camera]:
    T = cameras[name].matrix().copy()
    T[:3, :3] = T[:3, :3] @ rotation_from_vector(np.radians([0.0, degrees, 0.0]))
    return cameras | {name: msgspec.structs.replace(cameras[name], T_world_cam=Pose.from_matrix(T))}


def test_nothing_contradicts_honest_claims(of_four: list[CalibratedFrame], of_six: list[CalibratedFrame]):
    assert contradictions(of_four, ring(4)) == ()
    assert contradictions(of_six, ring(6)) == ()


def test_one_wrong_detection_contradicts_nothing(of_four: list[CalibratedFrame]):
    """In one compared frame set a roundel of another is beside a marker; before, all cameras contradicted each
    other."""
    of_one = [k for k, frame in enumerate(of_four) if frame.camera == "cam1"][100:108]
    seen = list(of_four)
    for k in of_one:
        uv = seen[k].roundels.uv + np.outer(np.arange(len(seen[k].roundels)) == 0, (6.0, -3.0))
        roundels = replace(seen[k].roundels, uv=uv)
        seen[k] = CalibratedFrame.measure("cam1", seen[k].t_ns, roundels, ring(4)["cam1"])
    assert contradictions(seen, ring(4)) == ()


def test_a_turned_camera_among_six_is_named_with_its_error(of_six: list[CalibratedFrame]):
    """At 3 to 5 m, a tenth of a degree are 5 to 9 mm."""
    (found,) = contradictions(of_six, with_turned(ring(6), "cam1"))
    assert (found.kind, found.names) == ("camera", ("cam1",))
    assert 4 < found.size_mm < 10
    assert found.error_over_claim > 2
    assert describe_contradiction(found).startswith("camera cam1 contradicts the other cameras by ")


def test_of_four_cameras_the_turned_one_is_among_those_that_contradict_each_other(
    of_four: list[CalibratedFrame],
):
    """Its error and that of the camera opposite to it move the robots alike: no other one is blamed."""
    (found,) = contradictions(of_four, with_turned(ring(4), "cam1"))
    assert found.kind in ("camera", "undecided")
    assert "cam1" in found.names
    assert {"cam0", "cam2"}.isdisjoint(found.names)


@pytest.mark.ci
def test_of_three_cameras_none_is_named():
    """Two that turned together would look like the third."""
    (found,) = contradictions(frames(3), with_turned(ring(3), "cam1", 3 * DEGREES))
    assert (found.kind, found.names) == ("undecided", ("cam0", "cam1", "cam2"))


def test_a_displaced_marker_is_its_robot_s(of_four: list[CalibratedFrame]):
    """Of 10 mm; the other robot fits, so no camera is at fault."""
    (x, y, z), *others = TRIANGLE.markers
    bent = msgspec.structs.replace(TRIANGLE, markers=((x + 0.01, y, z), *others))
    (found,) = contradictions(of_four, ring(4), {"a": bent, "b": WIDE})
    assert (found.kind, found.names) == ("robot", ("a",))
    assert 2 < found.size_mm < 10
    assert "robots.yaml" in describe_contradiction(found)


def test_an_error_that_the_rig_s_covariance_states_is_no_contradiction(of_six: list[CalibratedFrame]):
    """The same turned camera, in a rig that claims no better."""
    sigma = np.array([np.radians(DEGREES)] * 3 + [1e-3] * 3)
    covariance = tuple(map(tuple, np.diag(sigma**2).tolist()))
    cameras = with_turned(ring(6), "cam1")
    stated = {name: msgspec.structs.replace(c, covariance=covariance) for name, c in cameras.items()}
    assert contradictions(of_six, stated) == ()


def test_lenses_that_are_all_wrong_blame_no_single_camera(of_four: list[CalibratedFrame]):
    cameras = {
        name: msgspec.structs.replace(c, fx=1.01 * c.fx, fy=1.01 * c.fy) for name, c in ring(4).items()
    }
    again = [
        CalibratedFrame.measure(frame.camera, frame.t_ns, frame.roundels, cameras[frame.camera])
        for frame in of_four
    ]
    (found,) = contradictions(again, cameras)
    assert found.kind == "undecided"
    assert len(found.names) == 4


def test_the_estimates_without_each_camera_are_those_of_its_detections_alone():
    """Batches of several choices of detections against one least-squares problem each."""
    rng = np.random.default_rng(5)
    A, nu, metres, rig = rng.normal(size=(9, 2, 12)), rng.normal(size=(9, 2)), rng.random(9), rng.random(9)
    root, moved = rng.normal(size=(12, 12)), rng.normal(size=12)
    used = np.array([np.ones(9, bool), np.arange(9) % 3 > 0, np.arange(9) > 6])
    samples, left_out_m2 = _Equations(A, nu, metres, rig).solve(used, root.T @ root, moved)
    for k, mine in enumerate(used):
        J = np.concatenate([A[mine].reshape(-1, 12), root])
        x = np.linalg.lstsq(J, np.concatenate([nu[mine].ravel(), -root @ moved]))[0]
        hat = J @ np.linalg.pinv(J)
        squares, redundancy = np.sum((nu - A @ x) ** 2, axis=1), 2 * mine.sum() - np.trace(hat[:-12, :-12])
        expected = (
            squares[mine].sum(),
            min(squares[mine].sum(), MAX_RATIO * redundancy),
            redundancy,
            redundancy * rig[mine].mean(),
            (squares * metres**2)[mine].sum(),
            mine.sum(),
        )
        assert samples[:, k] == pytest.approx(expected, rel=1e-6)
        assert left_out_m2[k] == pytest.approx((squares * metres**2)[~mine].sum(), rel=1e-6, abs=1e-12)
