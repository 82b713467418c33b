# SPDX-License-Identifier: BSD-3-Clause
"""Estimates another robot's pose and velocity from relative positions, by an extended Kalman filter.

The state is the pose (x, y, heading) of the other robot in this one's frame and its velocity in its own frame. This
robot's motion between two frames comes from its odometry.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from camera_node.detection.roundels import LocatedRoundels
from camera_node.foundation.arrays import Array
from web.formation.planar import between, moved, wrap

ACCELERATION = np.array([0.4, 0.4, 0.6])  # of the other robot, as noise: m/s^2 and rad/s^2 per root hertz
SLIP = np.array([0.01, 0.01, 0.02])  # of this robot, as noise: m/s and rad/s per root hertz
POSITION_SIGMA_M, HEADING_SIGMA = (
    1e-3,
    5e-3,
)  # systematic errors: lens, diameter, mounting; added to the claimed ones
INITIAL_VELOCITY = np.array([0.3, 0.3, 0.3])  # standard deviations
GATE = 25.0  # squared Mahalanobis distance, three degrees of freedom
NUMERIC = 1e-6


@dataclass(frozen=True, slots=True)
class PlanarSighting:
    """A roundel seen by a robot, with one of both normals: T_robot_other (3,), covariance (3, 3), probability."""

    pose: Array
    cov: Array
    probability: float


def sightings(seen: LocatedRoundels) -> list[PlanarSighting]:
    """All roundels with both normals, projected to the floor. The camera's z is the robot's x, its x the robot's -y."""
    result = []
    for row, k in product(range(len(seen)), range(2)):
        (right, _, ahead), normal = seen.position[row], seen.normals[row, k]
        cov = np.zeros((3, 3))
        to_plane = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
        cov[:2, :2] = to_plane @ seen.cov[row] @ to_plane.T + POSITION_SIGMA_M**2 * np.eye(2)
        cov[2, 2] = seen.normal_sigma[row, k] ** 2 + HEADING_SIGMA**2
        pose = np.array([ahead, -right, np.arctan2(-normal[0], normal[2])])
        result.append(PlanarSighting(pose, cov, float(seen.probability[row, k])))
    return result


class RelativeEstimator:
    """Follows one other robot.

    Args:
        expected: its pose (3,) in this robot's frame at the start.
        sigma: standard deviations (3,) of that.

    Attributes:
        updated_s: the time of the last sighting; None before the first.
    """

    def __init__(self, expected: Array, sigma: Array) -> None:
        self._state = np.array([*expected, 0.0, 0.0, 0.0])
        self._cov = np.diag(np.array([*sigma, *INITIAL_VELOCITY]) ** 2)
        self._t_s: float | None = None
        self._odometry = np.zeros(3)
        self.updated_s: float | None = None

    def update(self, seen: LocatedRoundels, t_s: float, odometry: Array) -> None:
        """Take the roundels of a frame at `t_s`, when this robot's odometry was `odometry` (3,)."""
        if self._t_s is not None and t_s <= self._t_s:
            return
        self._state, self._cov = self._predict(t_s, odometry)
        self._t_s, self._odometry = t_s, odometry
        costs = [(self._cost(sighting), sighting) for sighting in sightings(seen)]
        cost, best = min(costs, key=lambda pair: pair[0], default=(np.inf, None))
        if best is not None and cost < GATE:
            self._correct(best)
            self.updated_s = t_s

    def predicted(self, t_s: float, odometry: Array) -> tuple[Array, Array]:
        """Pose (3,) and velocity (3,) of the other robot at `t_s`, when this robot's odometry is `odometry`."""
        state = self._predict(t_s, odometry)[0]
        return state[:3], state[3:]

    def _predict(self, t_s: float, odometry: Array) -> tuple[Array, Array]:
        if self._t_s is None:
            return self._state, self._cov
        dt_s = max(0.0, t_s - self._t_s)
        own = between(self._odometry, odometry)

        def transition(state: Array) -> Array:
            pose = moved(state[:3], state[3:], dt_s)
            return np.array([*between(own, pose), *state[3:]])

        state = transition(self._state)
        F = np.empty((6, 6))
        for k in range(6):
            step = np.zeros(6)
            step[k] = NUMERIC
            change = transition(self._state + step) - state
            change[2] = wrap(change[2])
            F[:, k] = change / NUMERIC
        noise = np.array([*SLIP, *ACCELERATION]) ** 2 * dt_s
        return state, F @ self._cov @ F.T + np.diag(noise)

    def _cost(self, sighting: PlanarSighting) -> float:
        """Squared Mahalanobis distance of a sighting, plus -2 log of the probability of its normal."""
        e = self._innovation(sighting)
        distance = float(e @ np.linalg.solve(self._cov[:3, :3] + sighting.cov, e))
        return distance - 2 * np.log(max(sighting.probability, 1e-9))

    def _innovation(self, sighting: PlanarSighting) -> Array:
        e = sighting.pose - self._state[:3]
        return np.array([e[0], e[1], wrap(e[2])])

    def _correct(self, sighting: PlanarSighting) -> None:
        gain = np.linalg.solve(self._cov[:3, :3] + sighting.cov, self._cov[:3, :]).T
        state = self._state + gain @ self._innovation(sighting)
        state[2] = wrap(state[2])
        keep = np.eye(6)
        keep[:, :3] -= gain
        self._state, self._cov = state, keep @ self._cov @ keep.T + gain @ sighting.cov @ gain.T
