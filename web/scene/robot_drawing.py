# SPDX-License-Identifier: BSD-3-Clause
"""Draws robots and their trails with batched Viser handles, which cost 1/20 of single ones."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from camera_node.geometry.pose import rotation_from_wxyz, rotation_with_z
from fusion.model.robots import Robot
from web.colours import BACKGROUND, CARD, CARD_UNSEEN, own_colours, robot_colours
from web.scene.bodies import FixedParts, Part, box_mesh, cylinder_mesh, enclosing_part, ring_mesh
from web.state.feed import ArenaState
from web.tables import robot_state

INNER_RATIO = 0.6  # of the white disc that is drawn in each black one
CARD_ABOVE_M, RING_ABOVE_M = 0.003, 0.006  # a print; so that neither body nor card hides what lies on it
SEEN_S = 0.5  # without a message about markers, after which none counts as seen
LABEL_OFFSET_M = np.array([0.0, 0.0, 0.16])
LABEL_SCALE = 0.8
LABEL_STEP_M = 0.01  # a label follows its robot in steps of so much
MAX_LABELS = 20  # moved in one slow drawing
LENGTH = 60  # positions of one trail
JUMP_M = 1.0  # a longer step is a jump, not motion: the trail restarts
FADE_EXPONENT = 1.5


class RobotDrawing:
    """Axes, bodies, prints and trails of all robots, one batched handle each, and one label per robot.

    A body is a plate, or a box if its markers are on several sides; its prints are where the robot declares them,
    bright while a camera sees them. Before the server has sent the declared markers, each robot is a plate.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.trails = Trails()
        self.is_shown: Callable[[str], bool] = bool  # of a robot's name
        self._names: list[str] = []
        self._declared: dict[str, Robot] = {}
        self._axes: Any = None
        self._plates = FixedParts(scene, "/robots/plates", cylinder_mesh(1.0, 1.0), opacity=0.75)
        self._boxes = FixedParts(scene, "/robots/boxes", box_mesh(), opacity=0.75)
        self.prints = Prints(scene)
        self._trail_lines: Any = None
        self._labels: dict[str, Any] = {}
        self._label_positions = np.empty((0, 3))
        self._next_label = 0

    def draw(self, state: ArenaState, is_slow: bool) -> None:
        """Draw the latest poses; labels and trails change in slow drawings only, which cost ten times as much."""
        names = sorted(filter(self.is_shown, state.poses))
        if names != self._names or state.declared is not self._declared:
            self._declared = state.declared
            self._create(names, *_poses(state, names))
        if not names:
            return
        positions, wxyzs = _poses(state, names)
        tracking = [robot_state(state, name) for name in names]
        self._axes.batched_positions, self._axes.batched_wxyzs = positions, wxyzs
        rotations = rotation_from_wxyz(wxyzs)
        for parts in (self._plates, self._boxes, *self.prints.layers):
            parts.move(positions.astype(float), rotations)
        if is_slow:
            colours = robot_colours(names, tracking)
            for parts in (self._plates, self._boxes):
                parts.paint(parts.of_robots(colours))
            self.prints.show_seen(state)
            self._draw_labels(names, positions, tracking)
            self._extend_trails(names, positions, tracking)

    def _draw_labels(self, names: list[str], positions: NDArray, tracking: list[str]) -> None:
        """Draw the labels that changed, at most `MAX_LABELS`, in turn: Viser has no batch of labels."""
        for name, robot in zip(names, tracking, strict=True):
            label, text = self._labels[name], name if robot == "tracked" else f"{name}: {robot}"
            if label.text != text:
                label.text = text
        wanted = positions + LABEL_OFFSET_M
        moved = np.flatnonzero(np.linalg.norm(wanted - self._label_positions, axis=1) > LABEL_STEP_M)
        first = np.searchsorted(moved, self._next_label)
        chosen = np.roll(moved, -first)[:MAX_LABELS]
        for k in chosen.tolist():
            self._labels[names[k]].position = wanted[k]
        self._label_positions[chosen] = wanted[chosen]
        self._next_label = int(chosen[-1]) + 1 if len(chosen) else 0

    def _extend_trails(self, names: list[str], positions: ArrayLike, tracking: list[str]) -> None:
        for name, position, robot in zip(names, np.asarray(positions), tracking, strict=True):
            if robot in ("tracked", "coasting"):
                self.trails.add(name, position)
        self._trail_lines.points = self.trails.segments(names)

    def _create(self, names: list[str], positions: NDArray, wxyzs: NDArray) -> None:
        """Create the handles; a batched handle can not change its number of robots."""
        for name in self._labels.keys() - set(names):
            self._labels.pop(name).remove()
            self.trails.remove(name)
        for handle in (self._axes, self._trail_lines):
            if handle is not None and not names:
                handle.remove()
        self._create_bodies(names)
        self._names = names
        self._label_positions, self._next_label = np.full((len(names), 3), np.inf), 0
        for name, position in zip(names, positions, strict=True):
            if name not in self._labels:
                self._labels[name] = self.scene.add_label(
                    f"/names/robots/{name}", name, anchor="bottom-center", font_screen_scale=LABEL_SCALE
                )
                self.trails.add(name, position)
        if names:
            self._create_batches(names, positions, wxyzs)

    def _create_bodies(self, names: list[str]) -> None:
        bodies = [self._declared.get(name) for name in names]
        enclosing, own = [enclosing_part(body) for body in bodies], own_colours(names)
        is_box = np.array([part.is_box for part in enclosing], bool)
        for parts, chosen in ((self._plates, np.flatnonzero(~is_box)), (self._boxes, np.flatnonzero(is_box))):
            parts.create(chosen, [enclosing[k] for k in chosen], own[chosen])
        self.prints.create(names, bodies)

    def _create_batches(self, names: list[str], positions: NDArray, wxyzs: NDArray) -> None:
        self._axes = self.scene.add_batched_axes(
            "/robots/axes", wxyzs, positions, axes_length=0.22, axes_radius=0.008
        )
        own = own_colours(names)
        self._trail_lines = self.scene.add_line_segments(
            "/robots/trails", self.trails.segments(names), fade(own, BACKGROUND), thickness=0.014
        )


class Prints:
    """The declared prints of all robots: a white card and a black ring each."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._cards = FixedParts(scene, "/robots/cards", ring_mesh(0.0))
        self.layers = self._cards, FixedParts(scene, "/robots/rings", ring_mesh(INNER_RATIO))
        self._keys: list[tuple[str, int]] = []  # robot and marker of each print

    def create(self, names: list[str], bodies: list[Robot | None]) -> None:
        """Replace all prints by those of the named robots."""
        of = [(row, body, k) for row, body in enumerate(bodies) if body for k in range(len(body.markers))]
        self._keys = [(names[row], k) for row, _, k in of]
        rows = np.array([row for row, *_ in of], np.intp)
        rings = np.zeros((len(of), 3), np.uint8)
        cards = np.full_like(rings, CARD_UNSEEN)
        self.layers[0].create(
            rows, [_disc(body, k, body.card_ratio, CARD_ABOVE_M) for _, body, k in of], cards
        )
        self.layers[1].create(rows, [_disc(body, k, 1.0, RING_ABOVE_M) for _, body, k in of], rings)

    def show_seen(self, state: ArenaState) -> None:
        """Draw the cards of the markers that a camera sees bright, the other ones dark."""
        seen = seen_markers(state)
        is_seen = np.array([key in seen for key in self._keys], bool)
        self._cards.paint(np.where(is_seen[:, None], CARD, CARD_UNSEEN).astype(np.uint8))


def seen_markers(state: ArenaState) -> set[tuple[str, int]]:
    """Robot and number of the markers in the latest message about markers, if it is recent."""
    if state.markers is None or state.age_s(state.markers) > SEEN_S:
        return set()
    message = state.markers.message
    rows = zip(message.robot_index().tolist(), message.marker_index().tolist(), strict=True)
    return {(message.robots[robot], marker) for robot, marker in rows if robot >= 0}


def _disc(body: Robot, marker: int, ratio: float, above_m: float) -> Part:
    """A disc around a marker, as wide as `ratio` black discs, `above_m` the print."""
    normal, radius = body.unit_normals[marker], ratio * body.diameter_m / 2
    return Part(False, body.points[marker] + above_m * normal, rotation_with_z(normal), np.full(3, radius))


def _poses(state: ArenaState, names: list[str]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions (R, 3) and quaternions (R, 4) of the latest poses."""
    poses = [state.poses[name].message for name in names]
    positions = np.array([pose.position for pose in poses], np.float32).reshape(-1, 3)
    return positions, np.array([pose.quaternion_wxyz for pose in poses], np.float32).reshape(-1, 4)


class Trails:
    """The last `LENGTH` positions of each robot. A trail restarts where a robot jumps."""

    def __init__(self) -> None:
        self._points: dict[str, NDArray[np.float32]] = {}

    def add(self, robot: str, position: ArrayLike) -> None:
        """Append a position (3,), metres, and drop the oldest."""
        new = np.asarray(position, np.float32)
        points = self._points.get(robot)
        if points is None:
            self._points[robot] = np.tile(new, (LENGTH, 1))
        elif np.linalg.norm(new - points[-1]) > JUMP_M:  # moved by hand, or a replay that jumped
            points[:] = new
        else:
            points[:-1], points[-1] = points[1:].copy(), new

    def remove(self, robot: str) -> None:
        """Forget a robot."""
        self._points.pop(robot, None)

    def segments(self, robots: list[str]) -> NDArray[np.float32]:
        """Return the trails of robots that were added: (len(robots) * (LENGTH - 1), 2, 3), the oldest first."""
        lines = [np.stack([p[:-1], p[1:]], axis=1) for p in (self._points[robot] for robot in robots)]
        return np.concatenate(lines) if lines else np.empty((0, 2, 3), np.float32)


def fade(colours: NDArray[np.uint8], background: ArrayLike) -> NDArray[np.uint8]:
    """Return the segments' colours for R robots, (R * (LENGTH - 1), 2, 3), from the background to the robot's own."""
    share = np.linspace(0.0, 1.0, LENGTH) ** FADE_EXPONENT
    lines = colours[:, None] * share[:, None] + np.asarray(background, float) * (1 - share[:, None])
    pairs = np.stack([lines[:, :-1], lines[:, 1:]], axis=2)
    return pairs.reshape(-1, 2, 3).astype(np.uint8)
