# SPDX-License-Identifier: BSD-3-Clause
"""Where the markers of robots are on these, by windows of keyframes: a robot may be measured wrong.

docs/design/rig_graph.md has the model.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from camera_node.foundation.arrays import Array
from fusion.model.marker_places import PLACE_M, frame_covariance, motions
from fusion.model.observations import MarkerTable
from fusion.rig_graph.hypotheses import COMMON_SIGMA, FALSE_ALARM, FREE_SHAPE_M

Equations = tuple[Array, Array]  # H (3 m, 3 m) and y (3 m,) of H p = y, about displacements p of m markers
TOLERANCES_M = np.array([PLACE_M * 2.0**k for k in range(7)])  # of markers that are measured less well
# Powers with which a larger tolerance of all markers, and of one, is less probable: the least that keep the claims of
# robots of which windows show little below a millimetre.
RARER, RARER_ONE = 2, 3
ANY_MOTION = 1.0  # rad and m: of the frame of a robot against its markers
N_GAUGE = 7  # motions of a robot and its size, which show no displacement


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Of the m markers of a robot.

    Attributes:
        equations: of all windows, about displacements from the declared places.
        off: (m, 3) displacements, metres.
        frame: (6, 6) covariance of the robot's frame by errors of the places; see `frame_covariance`.
        exceeds: whether they are larger than the tolerance of a measurement explains.
        contradicts: equations of the last window, if it contradicts those before.
    """

    equations: Equations
    off: Array
    frame: Array
    exceeds: bool
    contradicts: Equations | None = None


class RobotShapes:
    """The shapes of the robots in `markers`, where their places are declared."""

    def __init__(self, markers: MarkerTable) -> None:
        self._markers, self._declared = markers, markers.position.copy()
        self._known: dict[int, Shape] = {}

    @property
    def displaced_m(self) -> dict[int, float]:
        """By row of each robot whose markers are displaced beyond the tolerance, the largest distance."""
        known = self._known.items()
        return {k: float(np.linalg.norm(s.off, axis=1).max()) for k, s in known if s.exceeds}

    def inherit(self, old: "RobotShapes", same: Mapping[int, int]) -> None:
        """Continue with the robots of another one, whose rows `same` has by row."""
        self._known = {row: old._known[k] for row, k in same.items() if k in old._known}

    def forget(self) -> None:
        """Forget the windows: they were judged by other cameras. The places in use stay until two windows contradict
        them."""
        for k, shape in self._known.items():
            H, y = shape.equations
            self._known[k] = replace(shape, equations=(0 * H, 0 * y), contradicts=None)

    def learned(self, windows: Mapping[int, Equations]) -> dict[int, Shape]:
        """The shapes of robots with what a window shows of each, about displacements from the places in use."""
        return {robot: self._learned(robot, *window) for robot, window in windows.items()}

    def use(self, shapes: Mapping[int, Shape]) -> bool:
        """Use these shapes of robots; whether a marker is elsewhere by more than the tolerance from now on.

        Robots within the tolerance stay as declared, which their claims contain: a live server judges later than a
        replay, and both have the same poses.
        """
        before = self._markers.position.copy()
        for robot, shape in shapes.items():
            places = self._places(robot)
            is_elsewhere = (self._used(robot) != places).any()
            if is_elsewhere or np.linalg.norm(shape.off, axis=1).max() > PLACE_M:
                self._markers.place(robot, places + shape.off, shape.frame)
        self._known |= shapes
        return bool(np.linalg.norm(self._markers.position - before, axis=0).max(initial=0.0) > PLACE_M)

    def _places(self, robot: int) -> Array:
        return self._declared[:, self._markers.robot == robot].T

    def _used(self, robot: int) -> Array:
        return self._markers.position[:, self._markers.robot == robot].T

    def _learned(self, robot: int, H: Array, y: Array) -> Shape:
        places = self._places(robot)
        H, y = _of_any_frame_and_size(places, H, y + H @ (self._used(robot) - places).ravel())
        known = self._known.get(robot)
        if known is not None:
            # Roundels under wrong numbers show another shape for a moment; a marker that was displaced, from now on.
            before = [known.equations, *([known.contradicts] if known.contradicts else [])]
            off = known.off.ravel()
            agreeing = next((equations for equations in before if _agree(equations, (H, y), off)), None)
            if agreeing is None:
                return replace(known, contradicts=(H, y))
            H, y = agreeing[0] + H, agreeing[1] + y
        off, covariance = posterior(H, y)
        return Shape((H, y), off, frame_covariance(places, covariance), _exceed_tolerance(H, y))


def posterior(H: Array, y: Array) -> tuple[Array, Array]:
    """Mean (m, 3) and covariance (3 m, 3 m) of displacements of which windows show H p = y, metres.

    Windows show a shape, and not where a robot's frame is in it. How well its places are measured is unknown, and how
    well that of one marker: a mixture of normal distributions, each as likely as it makes the windows.
    """
    n, t = len(y) // 3, TOLERANCES_M
    e, V = np.linalg.eigh(H)
    information = np.maximum(e, 0.0) + t[:, None] ** -2
    P = V / information[:, None, :] @ V.T
    means = P @ y
    cost = np.log(information * t[:, None] ** 2).sum(1) - means @ y + _rarity(t, RARER)

    # Each marker with a larger tolerance than the others: P + A B A^T, with its columns A of P.
    of_all, of_one = np.triu_indices(len(t), 1)
    A = P.reshape(len(t), 3 * n, n, 3).swapaxes(1, 2)
    less = (t[of_all] ** -2 - t[of_one] ** -2)[:, None, None, None]
    left = np.eye(3) - less * A.reshape(len(t), n, n, 3, 3)[of_all][:, range(n), range(n)]
    B, off = less * np.linalg.inv(left), means.reshape(-1, n, 3)[of_all]
    change = np.einsum("skab,skb->ska", B, off)
    larger = 6 * np.log(t[of_one] / t[of_all]) + _rarity(t[of_one], RARER_ONE) + cost[of_all]
    cost_of_one = larger[:, None] + np.linalg.slogdet(left)[1] - np.sum(off * change, axis=2)
    means_of_one = means[of_all, None] + np.einsum("skia,ska->ski", A[of_all], change)

    costs = np.concatenate([cost, cost_of_one.ravel()])
    shares = np.exp((costs.min() - costs) / 2)
    shares /= shares.sum()
    every = np.concatenate([means, means_of_one.reshape(-1, 3 * n)])
    mean = shares @ every
    share_of_one = shares[len(t) :].reshape(-1, n)
    share, added = shares[: len(t)].copy(), np.zeros((len(t), n, 3, 3))
    np.add.at(share, of_all, share_of_one.sum(1))
    np.add.at(added, of_all, share_of_one[:, :, None, None] * B)
    covariance = np.tensordot(share, P, 1) + np.tensordot(A @ added, A, axes=([0, 1, 3], [0, 1, 3]))
    return mean.reshape(n, 3), covariance + (every - mean).T @ (shares[:, None] * (every - mean))


def _rarity(tolerance_m: Array, power: int) -> Array:
    """Twice the negative logarithm of how probable tolerances are: that falls with this power."""
    return np.asarray(2 * power * np.log(tolerance_m / PLACE_M), float)


def _of_any_frame_and_size(places: Array, H: Array, y: Array) -> Equations:
    """The equations if a robot's frame is anywhere in its markers, and if its size is unknown, as the rig may have
    another one.

    What a window shows of a motion that all markers have in common is by the directions of prints, which are not free,
    and by what a linearization neglects. It is little, so that no window contradicts those before by it.
    """
    G = np.column_stack([motions(places), places.ravel()])
    HG, information = H @ G, np.diag([ANY_MOTION**-2] * 6 + [COMMON_SIGMA["size"] ** -2])
    eliminated = np.linalg.solve(information + G.T @ HG, np.column_stack([HG.T, G.T @ y]))
    return H - HG @ eliminated[:, :-1], y - HG @ eliminated[:, -1]


def _agree(known: Equations, window: Equations, off: Array) -> bool:
    """Whether a window shows what those before did; if these are forgotten, the displacements (3 m,) in use."""
    (H_known, y_known), (H, y) = known, window
    if not H_known.any():
        return not _exceed_tolerance(H, y - H @ off)
    least = np.eye(len(y)) / FREE_SHAPE_M**2
    P = np.linalg.inv(H_known + least)
    unexpected = y - H @ P @ y_known
    solved = np.linalg.solve(np.eye(len(y)) + H @ P, unexpected)
    cost = unexpected @ np.linalg.solve(H + least, solved)
    return bool(cost < chdtri(len(y), FALSE_ALARM))


def _exceed_tolerance(H: Array, y: Array) -> bool:
    """Whether displacements of which windows show H p = y are larger than the tolerance explains: a score test."""
    larger = np.linalg.solve(np.eye(len(y)) + PLACE_M**2 * H, y)
    cost = y @ np.linalg.solve(H + np.eye(len(y)) / FREE_SHAPE_M**2, larger)
    return bool(cost > chdtri(max(1, len(y) - N_GAUGE), FALSE_ALARM))
