# SPDX-License-Identifier: BSD-3-Clause
"""A pose predicts itself for another time as the filter does, and claims what its robot may do until then."""

from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_wxyz
from fusion.model.robots import MOTIONS
from fusion.protocol.pose_messages import RobotPose
from tests.fusion.bridges.pose_server import moving_pose
from tests.fusion.synthetic import TRIANGLE, Arena, line
from tests.fusion.tracks import poses_of, track

pytestmark = pytest.mark.computed
SINGLE = msgspec.structs.replace(TRIANGLE, markers=((0.0, 0.0, 0.0),), diameter_m=0.09)
MOVING = Arena(
    {"a": TRIANGLE, "b": SINGLE},
    {
        "a": line((0.2, -0.3, 0.4), (0.9, 0.6, 0.1), turn=(0.2, 0.1, 1.0)),
        "b": line((-0.5, 0.4, 0.3), (0.3, 0, 0)),
    },
    sigma_px=0.1,
)
DENSITY = MOTIONS["ground"].densities


def at_rest(**fields) -> RobotPose:
    known = moving_pose("a", 10**12)
    none = {"velocity": (0.0, 0.0, 0.0), "angular_velocity": (0.0, 0.0, 0.0), "covariance": bytes(576)}
    return msgspec.structs.replace(
        known, **none | {"body_markers": 3, "acceleration_density": DENSITY} | fields
    )


@pytest.mark.parametrize("robot", ["a", "b"])
def test_a_coasting_robot_is_where_its_last_pose_predicts_it(robot: str):
    """With the same covariance, to the precision of its numbers, and with the age of what was seen last."""
    arena = replace(MOVING, hidden=lambda robot, marker, t: t > 0.6)
    poses = poses_of(track(arena, arena.frames(27)), robot)
    coasting = [pose for pose in poses if pose.state == "coasting" and pose.n_markers == 0]
    seen_ns = max(pose.t_ns for pose in poses if pose.n_markers)
    assert len(coasting) > 4
    for before, after in pairwise(coasting):
        predicted = before.at(after.t_ns)
        assert predicted.position == pytest.approx(after.position, abs=1e-9)
        assert predicted.quaternion_wxyz == pytest.approx(after.quaternion_wxyz, abs=1e-9)
        assert predicted.velocity == after.velocity
        size = np.sqrt(np.diag(after.covariance_matrix))
        error = (predicted.covariance_matrix - after.covariance_matrix) / size / size[:, None]
        assert error == pytest.approx(0, abs=1e-5)
        for pose in (predicted, after):
            assert pose.evidence_age_s == pytest.approx((after.t_ns - seen_ns) * 1e-9, abs=1e-9)


def test_a_robot_with_constant_velocities_is_predicted_exactly_both_ways():
    pose, h = at_rest(velocity=(1.0, -2.0, 0.5), angular_velocity=(0.0, 0.0, 2.0)), 0.1
    for sign in (1, -1):
        moved = pose.at(pose.t_ns + sign * 10**8)
        assert np.subtract(moved.position, pose.position) == pytest.approx(
            np.multiply(sign * h, pose.velocity)
        )
        turn = rotation_from_wxyz(moved.quaternion_wxyz) @ rotation_from_wxyz(pose.quaternion_wxyz).T
        assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(sign * 2.0 * h)
        back = moved.at(pose.t_ns)
        assert back.position == pytest.approx(pose.position)
        assert back.quaternion_wxyz == pytest.approx(pose.quaternion_wxyz)


@pytest.mark.parametrize("seconds", [0.1, -0.1])
def test_the_claim_is_that_of_random_accelerations(seconds: float):
    """Squared errors of position and velocity over their claim: chi-square with 6 degrees, mean 6 +- 4 sqrt(12 / N).
    With the wrong sign between both, at a time before the pose, it would be 42."""
    rng, n, steps = np.random.default_rng(1), 400, 200
    h = abs(seconds) / steps
    v = np.cumsum(rng.normal(0, np.sqrt(DENSITY[1] * h), (steps, n, 3)), axis=0)
    errors = np.concatenate([np.sign(seconds) * v.sum(axis=0) * h, v[-1]], axis=1)
    pose = at_rest()
    P = pose.at(pose.t_ns + round(1e9 * seconds)).covariance_matrix
    rows = [3, 4, 5, 9, 10, 11]
    squares = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(P[np.ix_(rows, rows)]), errors)
    assert squares.mean() == pytest.approx(6, abs=4 * np.sqrt(12 / n) + 6 / steps)


def test_what_can_not_be_predicted_is_refused():
    pose = at_rest()
    with pytest.raises(ValueError, match="update the server"):
        msgspec.structs.replace(pose, acceleration_density=None).at(pose.t_ns + 1)
    with pytest.raises(ValueError, match="30 s at most"):
        pose.at(pose.t_ns + 31 * 10**9)
    lost = at_rest(state="lost", velocity=(1.0, 0.0, 0.0))
    assert lost.at(lost.t_ns + 10**9).position == lost.position
