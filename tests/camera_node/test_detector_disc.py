# SPDX-License-Identifier: BSD-3-Clause
"""Both poses of a disc, out of one ellipse."""

import numpy as np
import pytest

from camera_node.detector import Detector
from camera_node.disc import locate
from camera_node.lens import Lens
from camera_node.roundels import Roundel
from tests.camera_node.rendering import Disc, expose, outer_conic, render

PINHOLE = Lens(width=640, height=480, fx=600, fy=600, cx=320, cy=240)
WIDE = Lens(
    width=640, height=480, fx=500, fy=502, cx=318, cy=243, distortion=(-0.2, 0.05, 0.001, -0.001, 0.0)
)


def project_circle(lens: Lens, centre: np.ndarray, normal: np.ndarray, radius: float) -> Roundel:
    """The ellipse through the images of a circle's points."""
    a = np.cross(normal, [0.3, 1.0, 0.2])
    a /= np.linalg.norm(a)
    t = np.linspace(0, 2 * np.pi, 200, endpoint=False)[:, None]
    uv = lens.project(centre + radius * (np.cos(t) * a + np.sin(t) * np.cross(normal, a)))
    middle = uv.mean(axis=0)
    x, y = (uv - middle).T
    A, B, C, D, E = np.linalg.lstsq(np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)))[0]
    M = np.array([[A, B / 2], [B / 2, C]])
    shift = -np.linalg.solve(2 * M, [D, E])
    values, vectors = np.linalg.eigh(M / (1 + shift @ M @ shift))
    angle = float(np.arctan2(vectors[1, 0], vectors[0, 0]))
    return Roundel(middle + shift, np.eye(2), 2 / np.sqrt(values), angle, 0.6, 100.0)


@pytest.mark.parametrize(("lens", "tolerance_m"), [(PINHOLE, 1e-9), (WIDE, 2e-3)])
@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.0])
def test_one_of_the_two_is_the_true_pose(lens: Lens, tolerance_m: float, tilt: float):
    """Exact in a pinhole; a circle's image through distortion is no ellipse: 0.1 % of 2 m for a disc of 0.1 m."""
    for turn in (0.0, 1.0, 4.0):
        normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
        centre = np.array([0.3, -0.2, 2.0])
        poses = locate(project_circle(lens, centre, normal, 0.05), lens, 0.1)
        assert poses is not None
        best = min(poses, key=lambda pose: np.linalg.norm(pose.normal - normal))
        assert np.linalg.norm(best.position_m - centre) < tolerance_m
        assert np.linalg.norm(best.normal - normal) < (1e-6 if lens is PINHOLE else 0.1)
        assert best.centre_uv == pytest.approx(lens.project(centre)[0], abs=1e-6 if lens is PINHOLE else 0.02)
        assert all(pose.normal @ pose.position_m < 0 for pose in poses)
        assert sum(pose.probability for pose in poses) == pytest.approx(1)


def test_a_measured_offset_settles_the_normal():
    """At 60 px and 40 degrees the centres of the two poses are 2 px apart: many sigmas."""
    lens = Lens(width=160, height=120, fx=600, fy=600, cx=79.5, cy=59.5)
    for turn in (0.4, 2.0, 5.0):
        disc = Disc((82, 61), 60, np.radians(40), turn)
        detector = Detector()
        (found,) = detector.detect(expose(render([disc]), 2, np.random.default_rng(3)))
        offsets, covs = detector.disc_offsets()
        poses = locate(found, lens, 0.1, (offsets[0], covs[0]))
        assert poses is not None
        assert poses[0].probability > 0.99
        assert poses[0].normal @ disc.normal > np.cos(np.radians(2))
        assert poses[0].position_m[2] == pytest.approx(0.1 / (60 / 600), rel=0.005)


def test_an_ellipse_that_the_lens_can_not_see_has_no_pose():
    far = Roundel(np.array([9e4, 9e4]), np.eye(2), np.array([10.0, 9.0]), 0.0, 0.6, 100.0)
    assert locate(far, WIDE, 0.1) is None


def test_the_renderer_knows_its_ellipse():
    """A frontal disc on the axis is a circle of its diameter."""
    centre, axes = outer_conic(Disc((79.5, 59.5), 30), np.array([79.5, 59.5]))
    assert centre == pytest.approx([79.5, 59.5])
    assert axes == pytest.approx([30, 30])
