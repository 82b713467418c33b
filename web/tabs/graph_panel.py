# SPDX-License-Identifier: BSD-3-Clause
"""A graph of one value of a robot, a camera or the selected robots over the last half minute."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from viser import uplot

from fusion.model.states import POSITION
from fusion.protocol.pose_messages import CameraHealth, RobotPose
from web.colours import CAMERA, MASK, WAND_TRAIL, css, robot_colour
from web.state.feed import ArenaState
from web.tables import heading_degrees
from web.tabs.robot_selection import RobotSelection
from web.widgets import inside, set_property

LENGTH_S = 30.0
PLOT_PX = 180
PLOT_INTERVAL = 6  # drawings of the scene from one plot to the next
MAX_SAMPLES = 2048  # of 30 s at twice the rate of drawings
NOTHING, SELECTED = "nothing", "the selected robots"
DASHES = ((), (8, 4), (2, 3))  # pixels, of x, y and z
Samples = deque[tuple[int, Any]]  # times, ns, and messages
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
    """The folder "Graph": a robot, a camera or the selected robots, one of their values, and the plot.

    The panel must be updated with each drawing of the scene; it has a sample of each message that was drawn.
    """

    def __init__(self, gui: viser.GuiApi, selection: RobotSelection) -> None:
        self._gui, self._selection = gui, selection
        self._samples: dict[str, Samples] = {}
        self._drawings = 0
        self._folder = gui.add_folder("Graph", expand_by_default=False)
        with self._folder:
            self._subject = gui.add_dropdown("Of", [NOTHING])
            self._quantity = gui.add_dropdown("Value", [NOTHING])
        self._plot: viser.GuiUplotHandle | None = None

    def update(self, state: ArenaState) -> None:
        """Add the newest messages, and draw the plot from time to time."""
        self._drawings += 1
        chosen = str(self._subject.value)
        subjects = self._selection.names if chosen == SELECTED else (chosen,)
        self._samples = {name: self._samples.get(name, deque(maxlen=MAX_SAMPLES)) for name in subjects}
        found = [self._add(name, *newest) for name in subjects if (newest := latest(state, name))]
        if self._drawings % PLOT_INTERVAL == 0:
            self._offer(state)
            self._draw(
                ROBOT if chosen == SELECTED or chosen in state.poses else CAMERA_HEALTH if found else ()
            )

    def _add(self, name: str, t_ns: int, message: RobotPose | CameraHealth) -> None:
        samples = self._samples[name]
        if samples and t_ns < samples[-1][0]:
            samples.clear()  # a recording was started again
        if not samples or t_ns > samples[-1][0]:
            samples.append((t_ns, message))

    def _offer(self, state: ArenaState) -> None:
        cameras = state.status.message.cameras if state.status else ()
        set_property(self._subject, "options", (NOTHING, SELECTED, *sorted(state.poses), *sorted(cameras)))

    def _draw(self, quantities: Sequence[Quantity]) -> None:
        set_property(self._quantity, "options", tuple(each.name for each in quantities) or (NOTHING,))
        shown = next((each for each in quantities if each.name == self._quantity.value), None)
        drawn = {name: samples for name, samples in self._samples.items() if len(samples) > 1}
        lines = label_lines(tuple(drawn), shown.series) if shown is not None else ()
        if self._plot is not None and self._plot.series[1:] != lines:
            self._plot.remove()  # a plot has a fixed number of lines
            self._plot = None
        if shown is None or not drawn:
            return
        data, title = graph(list(drawn.values()), shown), f"{self._subject.value}: {shown.name}"
        if self._plot is not None:
            self._plot.data, self._plot.title = data, title
            return
        scales = {"x": uplot.Scale(time=False, range=(-LENGTH_S, 0.0))}
        with inside(self._folder):
            self._plot = self._gui.add_uplot(
                data, (uplot.Series(label="s"), *lines), title=title, scales=scales, height=PLOT_PX
            )


def graph(subjects: Sequence[Samples], quantity: Quantity) -> tuple[np.ndarray, ...]:
    """Seconds before the newest sample (N,), at most `LENGTH_S`, and a column (N,) for each value of each subject.

    Between the samples of one subject, of which there are two or more, its values are interpolated; NaN where unknown.
    """
    t_ns = np.unique([t for samples in subjects for t, _ in samples])
    t_ns = t_ns[t_ns >= t_ns[-1] - LENGTH_S * 1e9]
    columns: list[np.ndarray] = []
    for samples in subjects:
        own_ns = np.array([t for t, _ in samples])
        rows = np.array([quantity.read(message) for _, message in samples], float)  # None becomes NaN
        columns += [_interpolate(t_ns, own_ns, values) for values in rows.T]
    return (t_ns - t_ns[-1]) * 1e-9, *columns


def _interpolate(t_ns: np.ndarray, own_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    start = own_ns[0]  # nanoseconds since 1970 are too many digits for a float
    return np.interp((t_ns - start) * 1e-9, (own_ns - start) * 1e-9, values, np.nan, np.nan)


def label_lines(subjects: Sequence[str], series: Sequence[str]) -> tuple[uplot.Series, ...]:
    """The lines of a plot: one subject has the colours of the axes; several have their own, and dashes by value."""
    if len(subjects) == 1:
        return tuple(
            uplot.Series(label=name, stroke=colour, width=1.5)
            for name, colour in zip(series, COLOURS, strict=False)
        )
    return tuple(
        uplot.Series(
            label=f"{robot} {name}" if len(series) > 1 else robot,
            stroke=css(robot_colour(robot)),
            width=1.5,
            dash=dash,
        )
        for robot in subjects
        for name, dash in zip(series, DASHES, strict=False)
    )
