# SPDX-License-Identifier: BSD-3-Clause
"""Symmetric constellations and robots that look alike are refused with a reason."""

import msgspec
import numpy as np
import pytest

from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import rotation_from_vector
from fusion.errors import FusionError
from fusion.model import likeness
from fusion.model.robots import (
    MAX_ROBOTS,
    Robot,
    changed,
    load_robots,
    require_distinct,
    require_trackable,
    save_robots,
)
from tests.conftest import ROOT

SQUARE = ((0.1, 0.1, 0.0), (-0.1, 0.1, 0.0), (-0.1, -0.1, 0.0), (0.1, -0.1, 0.0))
SCALENE = ((0.15, 0.0, 0.0), (-0.13, 0.14, 0.0), (-0.03, -0.14, 0.0))


def polygon(n: int) -> tuple:
    a = 2 * np.pi * np.arange(n) / n
    return tuple(map(tuple, np.column_stack([0.15 * np.cos(a), 0.15 * np.sin(a), 0 * a]).tolist()))


@pytest.mark.parametrize("markers", [polygon(3), SQUARE, polygon(5)])
def test_a_symmetric_constellation_is_refused(markers):
    with pytest.raises(FusionError, match=r"'a' is symmetric.*10 mm or more"):
        require_distinct({"a": Robot(diameter_m=0.1, markers=markers)})


def test_similar_robots_are_refused_unless_their_sizes_differ():
    a = Robot(diameter_m=0.1, markers=SCALENE)
    moved = tuple((x + 0.002, y, z) for x, y, z in SCALENE)
    with pytest.raises(FusionError, match="'a' and 'b' are too alike"):
        require_distinct({"a": a, "b": Robot(diameter_m=0.1, markers=moved)})
    require_distinct({"a": a, "b": Robot(diameter_m=0.14, markers=moved)})


def test_a_mirror_symmetry_is_accepted_because_the_print_faces_one_way():
    require_distinct({"a": Robot(diameter_m=0.1, markers=((0.2, 0, 0), (0, 0.1, 0), (0, -0.1, 0)))})


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("robots: {}", "declares no robot"),
        ("robots: {a: {diameter_m: 0.1, colour: red}}", "colour"),
        ("robots: {a: {diameter_m: 0.1, markers: [[0, 0, 0], [1, 0, 0]]}}", "third"),
        ("robots: {a: {diameter_m: 0.1, markers: [[0, 0, 0], [1, 0, 0], [2, 0, 0]]}}", "one line"),
        (
            "robots: {a: {diameter_m: 0.1, markers: [[0, 0, 0], [0.09, 0, 0], [0, 1, 0]]}}",
            "0 and 1 .* overlap",
        ),
        ("robots: {a: {diameter_m: 0.1, normals: [[0, 0, 1], [1, 0, 0]]}}", "2 normals for 1 markers"),
        ("robots: {a: {diameter_m: 0.1, normals: [[0, 0, 0]]}}", r"normal \[0.* has no direction"),
        ("robots: {a: {diameter_m: 0.1, normals: [[0, .nan, 1]]}}", "has no direction"),
        ("robots: {a: {diameter_m: 0.1, normals: [[1, 0, 0]]}}", "leave its normal out"),
        (
            "robots: {a: {diameter_m: 0.1, markers: [[0, 0, 0], [0, 0, -0.01], [0, 1, 0]], "
            "normals: [[0, 0, 1], [0, 0, -1], [0, 0, 1]]}}",
            "taken for one marker",
        ),
        ("robots: {'a/b': {diameter_m: 0.1}}", "can't name a robot"),
    ],
)
def test_an_invalid_declaration_is_refused_with_a_reason(tmp_path, text, reason):
    path = tmp_path / "robots.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        load_robots(path)


@pytest.mark.parametrize(
    "name", ["configs/robots.yaml", "configs/robots_cube.yaml", "configs/demo/robots.yaml"]
)
def test_the_examples_work(name):
    assert load_robots(ROOT / name)


CUBE_SIDES = [  # R_body_side of the six sides, and the third one turned by 90 degrees about its normal
    rotation_from_vector(np.radians(v))
    for v in ([0, 0, 0], [180, 0, 0], [90, 0, 0], [-90, 0, 0], [0, 90, 0], [0, -90, 0])
]


def cube(*shapes: np.ndarray) -> Robot:
    """A cube of 0.28 m with a shape (M, 2) on each side."""
    markers, normals = [], []
    for R, shape in zip(CUBE_SIDES, shapes, strict=False):
        points = np.column_stack([shape, np.full(len(shape), 0.14)]) @ R.T
        markers += map(tuple, np.round(points, 6).tolist())
        normals += [tuple(R[:, 2].tolist())] * len(shape)
    return Robot(diameter_m=0.05, markers=tuple(markers), normals=tuple(normals))


SIDE = np.array([[0.09, 0.0], [-0.08, 0.08], [-0.02, -0.05]])
OTHER_SIDE = np.array([[0.09, 0.03], [-0.05, 0.07], [-0.08, -0.09]])


@pytest.mark.parametrize("shapes", [(SIDE,) * 6, (SIDE, OTHER_SIDE, SIDE)])
def test_a_cube_with_sides_that_are_equal_by_rotation_is_refused(shapes):
    with pytest.raises(
        FusionError, match=r"'a' is ambiguous: the side of markers .* equals that of .* by rotation: .*10 mm"
    ):
        require_distinct({"a": cube(*shapes)})


def test_a_side_that_is_symmetric_is_refused_and_named():
    square = np.array(SQUARE)[:, :2]
    with pytest.raises(
        FusionError, match=r"'a' is symmetric under rotation on the side of markers 3, 4, 5, 6"
    ):
        require_distinct({"a": cube(SIDE, square)})


def test_a_cube_with_one_marker_on_each_side_is_symmetric():
    with pytest.raises(FusionError, match="'a' is symmetric under rotation: "):
        require_distinct({"a": cube(*(np.zeros((1, 2)),) * 6)})


def test_a_mirror_image_of_a_side_is_another_side():
    """No rotation takes one to the other: the normals differ."""
    require_distinct({"a": cube(SIDE, SIDE * [1, -1])})


def test_a_flat_robot_like_a_side_of_a_cube_is_refused():
    flat = Robot(diameter_m=0.05, markers=tuple((x, y, 0.0) for x, y in SIDE.tolist()))
    with pytest.raises(FusionError, match="'a' and 'b' are too alike"):
        require_distinct({"a": cube(OTHER_SIDE, SIDE), "b": flat})
    require_distinct({"a": cube(OTHER_SIDE, SIDE * [1, -1]), "b": flat})


def test_normals_are_scaled_and_saved_as_they_were(tmp_path):
    robot = cube(SIDE, OTHER_SIDE)
    scaled = msgspec.structs.replace(robot, normals=tuple(tuple(2 * x for x in n) for n in robot.normals))
    np.testing.assert_allclose(scaled.unit_normals, robot.unit_normals, atol=1e-15)
    for body in (robot, scaled):
        save_robots({"a": body}, tmp_path / "robots.yaml")
        assert load_robots(tmp_path / "robots.yaml") == {"a": body}
    up = Robot(diameter_m=0.1, markers=SCALENE, normals=((0, 0, 3.0),) * 3)
    assert up == Robot(diameter_m=0.1, markers=SCALENE)


def test_more_robots_than_can_be_tracked_are_refused_before_the_work():
    """Comparing 3,000 of them took 14 s, so that comparing these would outlast the time limit of a test."""
    many = {f"r{k}": Robot(diameter_m=0.05, start_m=(float(k), 0.0, 0.0)) for k in range(20_000)}
    for check in (lambda: require_trackable(many, "robots.yaml"), lambda: changed({}, {}, (), many)):
        with pytest.raises(ConfigError, match=f"20000 robots .* at most {MAX_ROBOTS} robots"):
            check()


@pytest.mark.parametrize("sizes", [(3, 3), (4, 4), (3, 5)])
def test_distances_that_do_not_match_in_order_have_no_labeling(sizes: tuple[int, int]):
    rng, refused = np.random.default_rng(4), 0
    for _ in range(300):
        few, many = (likeness.distances(rng.uniform(0, 0.12, (n, 3))) for n in sizes)
        if not likeness._may_match(*(sorted(D[np.triu_indices(len(D), 1)].tolist()) for D in (few, many))):
            refused += 1
            assert not len(likeness._labelings(few, many))
    assert refused > 50
