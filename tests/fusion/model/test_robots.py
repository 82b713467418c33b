# SPDX-License-Identifier: BSD-3-Clause
"""Symmetric constellations and robots that look alike are refused with a reason."""

import time

import numpy as np
import pytest

from camera_node.errors import ConfigError
from fusion.errors import FusionError
from fusion.model.robots import (
    MAX_ROBOTS,
    Robot,
    changed,
    load_robots,
    require_distinct,
    require_trackable,
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
        ("robots: {'a/b': {diameter_m: 0.1}}", "can't name a robot"),
    ],
)
def test_an_invalid_declaration_is_refused_with_a_reason(tmp_path, text, reason):
    path = tmp_path / "robots.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        load_robots(path)


@pytest.mark.parametrize("name", ["configs/robots.yaml", "configs/demo/robots.yaml"])
def test_the_examples_work(name):
    assert load_robots(ROOT / name)


def test_more_robots_than_can_be_tracked_are_refused_before_the_work():
    """Before: 3,000 robots took 14 s, in a request on the server's thread."""
    many = {f"r{k}": Robot(diameter_m=0.05, start_m=(float(k), 0.0, 0.0)) for k in range(3000)}
    begun = time.process_time()
    for check in (lambda: require_trackable(many, "robots.yaml"), lambda: changed({}, {}, (), many)):
        with pytest.raises(ConfigError, match=f"3000 robots .* at most {MAX_ROBOTS} robots"):
            check()
    assert time.process_time() - begun < 1.0


def test_the_comparison_of_seven_markers_is_fast():
    """Before: 17 ms a pair, 5,040 labelings of which few begin with equal distances."""
    rng = np.random.default_rng(3)
    shape = np.column_stack([rng.permuted(np.linspace(-0.4, 0.4, 7)), np.linspace(-0.4, 0.4, 7), np.zeros(7)])
    robots = {
        f"r{k}": Robot(diameter_m=0.04, markers=tuple(map(tuple, ((1 + 0.1 * k) * shape).tolist())))
        for k in range(25)
    }
    begun = time.process_time()
    require_distinct(robots)
    assert time.process_time() - begun < 2.0  # 0.1 s; it was 5 s
