# SPDX-License-Identifier: BSD-3-Clause
"""The centres of ellipses behind a lens with distortion, against what the detector finds in rendered pictures."""

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.outline import centre_shifts, half_axes_of
from camera_node.geometry.pose import look_at, rotation_from_vector
from camera_node.simulation.discs import place_discs
from camera_node.simulation.floor import plain_floor
from camera_node.simulation.renderer import ImageModel
from camera_node.simulation.scene import SceneCamera

RADIUS_M, DISTANCE_M = 0.06, 3.3
PLACES = np.array([(x, y) for x in np.linspace(-0.48, 0.48, 6) for y in (-0.3, -0.1, 0.1, 0.3)])
PICTURES = 8


def webcam() -> SceneCamera:
    """A webcam of 640 x 480 px as in the demo."""
    return SceneCamera(
        width=640,
        height=480,
        fx=566.0,
        fy=566.0,
        cx=322.0,
        cy=238.0,
        distortion=(-0.112, 0.031, 0.0, 0.0, 0.0),
        position_m=(0.0, 0.0, DISTANCE_M),
        look_at_m=(0.0, 0.1, 0.0),
        sensor="mild",
    )


def detected_errors(camera: SceneCamera) -> tuple[Array, Array, Array]:
    """Of frontal discs all over the picture: true centres (N, 2) in the image plane, their errors (N, 2), pixels, and
    radii (N,) in the image plane. The outlines of frontal discs have the discs' own centres."""
    rng, model = np.random.default_rng(8), ImageModel(camera, 5)
    ground = model.view(plain_floor(), look_at(camera.position_m, camera.look_at_m))
    body = Body(diameter_m=2 * RADIUS_M)
    rows = []
    for frame in range(PICTURES):
        light = ground.copy()
        xy = PLACES + rng.uniform(-0.01, 0.01, PLACES.shape)
        for at in xy:
            T = np.eye(4)
            T[:3, :3] = rotation_from_vector([np.pi, 0.0, 0.0])
            T[:3, 3] = DISTANCE_M * np.array([*at, 1.0])
            model.paint(light, place_discs(body, T))
        found = Detector().detect(model.expose(light, frame))
        expected = camera.project(np.column_stack([xy, np.ones(len(xy))]))
        for uv, at in zip(expected, xy, strict=True):
            off = found.uv - uv
            nearest = off[np.linalg.norm(off, axis=1).argmin()]
            rows += [(*at, *nearest)] if np.linalg.norm(nearest) < 2 else []
    table = np.array(rows)
    return table[:, :2], table[:, 2:], np.full(len(table), RADIUS_M / DISTANCE_M)


def radial_slope(camera: SceneCamera, xy: Array, errors: Array) -> tuple[float, float]:
    """By what share of the distance from the image's centre errors point away from it, and its standard deviation."""
    away = camera.project(np.column_stack([xy, np.ones(len(xy))])) - [camera.cx, camera.cy]
    slope = float((errors * away).sum() / (away**2).sum())
    return slope, float(np.std(errors - slope * away) / np.sqrt((away**2).sum()))


def test_centres_in_rendered_pictures_have_no_bias_towards_the_image_centre():
    """Distortion moves them by 1e-4 of the distance from there, by which a calibration would place cameras 0.4 mm too
    far away. The limits are four standard deviations by the scatter of the errors themselves."""
    camera = webcam()
    xy, errors, radius = detected_errors(camera)
    assert len(xy) > 0.9 * PICTURES * len(PLACES)
    before, sigma = radial_slope(camera, xy, errors)
    assert before < -10 * sigma
    shifts = centre_shifts(camera, xy, radius[:, None, None] * np.eye(2))
    after, sigma = radial_slope(camera, xy, errors - shifts)
    assert abs(after) < 4 * sigma


def test_radial_distortion_shifts_by_three_times_its_coefficient():
    """By 3 k1 r^2 x of a small disc near the axis, in the image plane."""
    camera = SceneCamera(
        width=640,
        height=480,
        fx=500.0,
        fy=500.0,
        cx=320.0,
        cy=240.0,
        distortion=(-0.1, 0.0, 0.0, 0.0),
        position_m=(0.0, 0.0, 1.0),
        look_at_m=(0.0, 0.1, 0.0),
    )
    xy, r = np.array([[0.05, -0.02], [0.01, 0.06]]), 0.02
    shifts = centre_shifts(camera, xy, np.tile(r * np.eye(2), (2, 1, 1)))
    assert shifts == pytest.approx(500 * 3 * -0.1 * r**2 * xy, rel=0.01)


def test_unknown_and_impossible_ellipses_have_no_shift():
    axes = np.array([[np.nan, np.nan], [1e30, 1e30], [np.inf, 1.0], [0.0, 0.0]])
    half_axes = half_axes_of(axes, np.zeros(4))
    assert centre_shifts(webcam(), np.zeros((4, 2)), half_axes) == pytest.approx(0)
    assert centre_shifts(webcam(), np.full((4, 2), np.nan), np.ones((4, 2, 2))) == pytest.approx(0)
