# SPDX-License-Identifier: BSD-3-Clause
"""A graph of one value of a robot or a camera over the last half minute."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from viser import uplot

from fusion.model.states import POSITION
from fusion.protocol.pose_messages import CameraHealth, RobotPose
from web.colours import CAMERA, MASK, WAND_TRAIL, css
from web.state.feed import ArenaState
from web.tables import heading_degrees
from web.widgets import set_property

LENGTH_S = 30.0
PLOT_PX = 180
PLOT_INTERVAL = 6  # drawings of the scene from one plot to the next
MAX_SAMPLES = 2048  # of 30 s at twice the rate of drawings
NOTHING = "nothing"
COLOURS = tuple(
    css(colour) for colour in (MASK, WAND_TRAIL, CAMERA)
)  # of x, y and z, as of axes in the scene


@dataclass(frozen=True)
class Quantity:
    """What a message says of a robot or a camera: up to three numbers, NaN where unknown."""

    name: str
    series: tuple[str, ...]
    read: Callable[[Any], Sequence[float | None]]


def _sigmas_mm(pose: RobotPose) -> list[float]:
    return (1e3 * np.sqrt(np.diag(pose.covariance_matrix)[POSITION])).tolist()


ROBOT: tuple[Quantity, ...] = (
    Quantity("position, m", ("x", "y", "z"), lambda pose: pose.position),
    Quantity("velocity, m/s", ("x", "y", "z"), lambda pose: pose.velocity),
    Quantity("heading, degrees", ("heading",), lambda pose: [heading_degrees(pose)]),
    Quantity(
        "angular velocity, degrees/s",
        ("x", "y", "z"),
        lambda pose: np.degrees(pose.angular_velocity).tolist(),
    ),
    Quantity("standard deviation of the position, mm", ("x", "y", "z"), _sigmas_mm),
    Quantity("residual, px", ("residual",), lambda pose: [pose.residual_px]),
    Quantity("used", ("markers", "cameras"), lambda pose: [pose.n_markers, len(pose.cameras)]),
    Quantity("latency, ms", ("latency",), lambda pose: [pose.latency and pose.latency.total_ms]),
)
CAMERA_HEALTH: tuple[Quantity, ...] = (
    Quantity("frames a second", ("frames",), lambda health: [health.fps]),
    Quantity("lateness, ms", ("lateness",), lambda health: [health.lateness_ms]),
    Quantity("residual, px", ("residual",), lambda health: [health.residual_px]),
    Quantity("detections", ("assigned", "unassigned"), lambda health: [health.assigned, health.unassigned]),
)


def latest(state: ArenaState, subject: str) -> tuple[int, RobotPose | CameraHealth] | None:
    """The newest message about a robot or a camera, and its time, ns; None without one."""
    if (timed := state.poses.get(subject)) is not None:
        return timed.message.t_ns, timed.message
    status = state.status.message if state.status else None
    return (status.t_ns, status.cameras[subject]) if status and subject in status.cameras else None


class GraphPanel:
    """The folder "Graph": a robot or a camera, one of its values, and the plot.

    The panel must be updated with each drawing of the scene; it has a sample of each message that was drawn.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        self._samples: deque[tuple[int, Any]] = deque(maxlen=MAX_SAMPLES)
        self._drawings = 0
        with gui.add_folder("Graph", expand_by_default=False):
            self._subject = gui.add_dropdown("Of", [NOTHING])
            self._quantity = gui.add_dropdown("Value", [NOTHING])
            self._plot = gui.add_uplot(
                _no_data(),
                _labels(()),
                scales={"x": uplot.Scale(time=False, range=(-LENGTH_S, 0.0))},
                height=PLOT_PX,
                visible=False,
            )
        self._subject.on_update(lambda _: self._samples.clear())

    def update(self, state: ArenaState) -> None:
        """Add the newest message, and draw the plot from time to time."""
        self._drawings += 1
        subject = str(self._subject.value)
        if (found := latest(state, subject)) is not None:
            self._add(*found)
        if self._drawings % PLOT_INTERVAL == 0:
            self._offer(state)
            self._draw(ROBOT if subject in state.poses else CAMERA_HEALTH if found else ())

    def _add(self, t_ns: int, message: RobotPose | CameraHealth) -> None:
        if self._samples and t_ns < self._samples[-1][0]:
            self._samples.clear()  # a recording was started again
        if not self._samples or t_ns > self._samples[-1][0]:
            self._samples.append((t_ns, message))

    def _offer(self, state: ArenaState) -> None:
        cameras = state.status.message.cameras if state.status else ()
        subjects = (NOTHING, *sorted(state.poses), *sorted(cameras))
        if subjects != tuple(self._subject.options):
            self._subject.options = subjects

    def _draw(self, quantities: Sequence[Quantity]) -> None:
        set_property(self._plot, "visible", bool(quantities))
        names = tuple(quantity.name for quantity in quantities) or (NOTHING,)
        if names != tuple(self._quantity.options):
            self._quantity.options = names
        shown = next((quantity for quantity in quantities if quantity.name == self._quantity.value), None)
        if shown is None:
            return
        set_property(self._plot, "title", f"{self._subject.value}: {shown.name}")
        set_property(self._plot, "series", _labels(shown.series))
        self._plot.data = graph(list(self._samples), shown)


def graph(samples: Sequence[tuple[int, Any]], quantity: Quantity) -> tuple[np.ndarray, ...]:
    """Seconds before the newest sample (N,), at most `LENGTH_S`, and three columns (N,), NaN where unknown."""
    recent = [(t_ns, m) for t_ns, m in samples if samples[-1][0] - t_ns <= LENGTH_S * 1e9]
    if len(recent) < 2:
        return _no_data()
    seconds = np.array([(t_ns - recent[-1][0]) * 1e-9 for t_ns, _ in recent])
    values = np.full((len(recent), 3), np.nan)
    for row, (_, message) in zip(values, recent, strict=True):
        numbers = quantity.read(message)
        row[: len(numbers)] = [np.nan if number is None else number for number in numbers]
    return seconds, *values.T.copy()


def _no_data() -> tuple[np.ndarray, ...]:
    return np.array([-LENGTH_S, 0.0]), *np.full((3, 2), np.nan)


def _labels(names: tuple[str, ...]) -> tuple[uplot.Series, ...]:
    lines = [
        uplot.Series(label=name, stroke=colour, width=1.5, show=bool(name))
        for name, colour in zip([*names, "", "", ""][:3], COLOURS, strict=True)
    ]
    return uplot.Series(label="s"), *lines
