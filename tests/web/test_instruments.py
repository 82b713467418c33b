# SPDX-License-Identifier: BSD-3-Clause
"""The graph and the ruler of the tab Robots, in a real browser."""

from collections import deque
from collections.abc import Iterator
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_vector, wxyz_from_rotation
from fusion.protocol.pose_messages import CameraHealth, Markers, RobotPose
from tests.waiting import repeating, wait_for
from tests.web.arena import LiveArena
from tests.web.browser import browsing, value_of
from web.page import Shortcuts, add_instruments
from web.tabs.graph_panel import CAMERA_HEALTH, LENGTH_S, ROBOT, Quantity, graph, label_lines
from web.tabs.robot_selection import RobotSelection
from web.tabs.ruler import Ruler, describe_distance
from web.view import View

POSE = RobotPose(
    robot="rover",
    t_ns=10**18,
    state="tracked",
    position=(1.0, 2.0, 3.0),
    quaternion_wxyz=tuple(wxyz_from_rotation(rotation_from_vector(np.array([0, 0, np.radians(30)])))),
    velocity=(0.1, 0.2, 0.3),
    angular_velocity=(0.0, 0.0, np.radians(90)),
    covariance=np.diag([0.0] * 3 + [1e-6, 4e-6, 9e-6] + [0.0] * 6).astype("<f4").tobytes(),
    n_markers=3,
    cameras=("north", "east"),
)
SENT = [(0.5, 0.1, 0.1), (0.5, -0.1, 0.1), (0.4, 0.0, 0.1)]


def test_the_graph_has_the_values_of_the_messages():
    later = msgspec.structs.replace(POSE, t_ns=POSE.t_ns + 10**9)
    expected = {
        "position, m": [1, 2, 3],
        "velocity, m/s": [0.1, 0.2, 0.3],
        "heading, degrees": [30],
        "angular velocity, degrees/s": [0, 0, 90],
        "standard deviation of the position, mm": [1, 2, 3],
        "residual, px": [np.nan],
        "used": [3, 2],
        "latency, ms": [np.nan],
    }
    assert [quantity.name for quantity in ROBOT] == list(expected)
    for quantity in ROBOT:
        seconds, *columns = graph([deque((pose.t_ns, pose) for pose in (POSE, later))], quantity)
        np.testing.assert_allclose(seconds, [-1, 0])
        np.testing.assert_allclose([column[1] for column in columns], expected[quantity.name], rtol=1e-6)
    health = CameraHealth(
        fps=60, lateness_ms=4, residual_px=0.1, assigned=5, unassigned=6, late=0, calibrated=True
    )
    found = [graph([deque([(0, health), (1, health)])], quantity)[1][1] for quantity in CAMERA_HEALTH]
    assert found == [60, 4, 0.1, 5]


def test_the_graph_ends_with_the_newest_and_begins_half_a_minute_before():
    samples = deque((int(s * 1e9), SimpleNamespace(x=s)) for s in range(100))
    seconds, values = graph([samples], Quantity("x", ("x",), lambda sample: [sample.x]))
    np.testing.assert_allclose(seconds, np.arange(-LENGTH_S, 1))
    np.testing.assert_allclose(values, 99 + seconds)


def test_two_robots_are_plotted_over_one_time():
    """The second one's stamps lie between the first one's; before its first sample it is unknown."""
    t0 = 10**18
    first = deque((t0 + k * 10**8, SimpleNamespace(x=float(k))) for k in range(5))
    second = deque((t0 + k * 10**8 + 5 * 10**7, SimpleNamespace(x=10.0 * k)) for k in range(1, 4))
    seconds, *columns = graph([first, second], Quantity("x", ("x",), lambda sample: [sample.x]))
    np.testing.assert_allclose(seconds, [-0.4, -0.3, -0.25, -0.2, -0.15, -0.1, -0.05, 0.0], atol=1e-9)
    np.testing.assert_allclose(columns[0], [0, 1, 1.5, 2, 2.5, 3, 3.5, 4], rtol=1e-6)
    np.testing.assert_allclose(columns[1], [np.nan, np.nan, 10, 15, 20, 25, 30, np.nan], rtol=1e-6)
    assert [line.get("label") for line in label_lines(("a", "b"), ("x", "y"))] == ["a x", "a y", "b x", "b y"]


def test_the_distance_has_the_variance_along_it():
    """Two markers 300 mm apart along x, 3 and 4 mm along x: 5 mm; their other variances do not count."""
    C = np.array([np.diag([9e-6, 1.0, 1.0]), np.diag([16e-6, 1.0, 1.0])])
    markers = Markers(
        t_ns=0,
        robots=(),
        camera_names=(),
        position=np.array([[0, 0, 0], [0.3, 0, 0]], "<f8").tobytes(),
        covariance=C.astype("<f4").tobytes(),
        normal=b"",
        robot=b"",
        marker=b"",
        cameras=b"",
    )
    assert describe_distance(markers, 0, 1) == "300.0 mm ± 5.0 (x 300.0, y 0.0, z 0.0)"


@pytest.fixture
def instruments(arena: LiveArena, view: View) -> Iterator[Ruler]:
    """A page with the instruments, whose arena sends."""

    def send() -> None:
        arena.status(("north",))
        arena.pose("rover", (0.5, 0.0, 0.1))
        arena.markers(SENT)

    ruler = add_instruments(view, RobotSelection(view.server.gui), Shortcuts(view.server.gui))
    with repeating(send, 0.05):
        yield ruler


def test_a_value_is_plotted_and_a_distance_measured(instruments: Ruler, view: View):
    with browsing(view) as page:
        page.get_by_text("Graph", exact=True).click()
        for label, choice in (("Of", "rover"), ("Value", "velocity, m/s")):
            wait_for(lambda label=label: value_of(view, label) is not None)
            page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]").locator(
                "input"
            ).first.click()
            page.get_by_role("option", name=choice).click()
        page.get_by_text("rover: velocity, m/s").wait_for()
        page.get_by_role("button", name="Measure a distance").click()
        page.get_by_text("click two markers in the scene").wait_for()
        for place in SENT[:2]:  # from above, as the click handler does
            instruments.select(np.add(place, (0.0, 0.0, 2.0)), np.array((0.0, 0.0, -1.0)))
        page.get_by_text("200.0 mm ± 0.0").wait_for()
        page.get_by_role("button", name="Stop measuring").click()
