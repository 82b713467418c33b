# SPDX-License-Identifier: BSD-3-Clause
"""The least-squares pose of a disc: exact without noise, consistent with it, and better with a known lens."""

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.detection.disc_adjustment import adjust, covariance_through, shape_of
from camera_node.detection.disc_pose import locate
from camera_node.geometry.lens import Lens
from tests.camera_node.rendering import Disc, expose, render

LENS = Lens(width=160, height=120, fx=600, fy=600, cx=79.5, cy=59.5)
RADIUS = 0.05


def measured(position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(1, 7) the outline of a disc and the image of its centre, in the plane at distance one."""
    dual = np.outer(position, position) - RADIUS**2 * (np.eye(3) - np.outer(normal, normal))
    return np.concatenate([shape_of(dual), position[:2] / position[2]])[None]


def measured_covariance(diameter: float) -> np.ndarray:
    """(1, 7, 7) covariance of a detected roundel, in the plane at distance one."""
    image = expose(render([Disc((80.3, 60.6), diameter, 0.6, 1.0)]), 3, np.random.default_rng(1))
    (found,) = Detector().detect(image)
    ellipse = np.array([[*found.uv, *found.axes_px, found.angle_rad]])
    assert found.pose_cov is not None
    return covariance_through(LENS, ellipse, found.pose_cov[None])


@pytest.mark.parametrize("tilt", [0.05, 0.5, 1.0])
def test_without_noise_the_pose_is_recovered(tilt: float):
    """From an initial pose that is off by 2 % and 0.05 rad, within rounding."""
    position, normal = np.array([0.1, -0.2, 1.5]), np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    start = normal + np.array([0.02, 0.05, 0.0])
    start /= np.linalg.norm(start)
    seen, cov = measured(position, normal), measured_covariance(24)
    found = adjust(1.02 * position[None], start[None], RADIUS, seen, cov)
    assert found.position[0] == pytest.approx(position, rel=1e-6)
    assert found.normal[0] == pytest.approx(normal, abs=1e-5)
    assert found.chi2[0] < 1e-3


def test_the_residual_is_chi_square_distributed():
    """Seven measurements, five unknowns: mean 2; four standard deviations of the mean of 400 draws are 0.4."""
    position, normal = np.array([0.0, 0.0, 1.2]), np.array([np.sin(0.6), 0.0, -np.cos(0.6)])
    cov, n = measured_covariance(40), 400
    noise = np.random.default_rng(3).standard_normal((n, 7)) @ np.linalg.cholesky(cov[0]).T
    seen = measured(position, normal) + noise
    positions, normals = np.tile(position, (n, 1)), np.tile(normal, (n, 1))
    chi2 = adjust(positions, normals, RADIUS, seen, np.repeat(cov, n, axis=0)).chi2
    assert chi2.mean() == pytest.approx(2, abs=0.4)


def test_the_lens_improves_the_image_of_the_discs_centre():
    """Without it only the hole's position in the disc determines it. At 30 px the error is more than halved."""
    rng, disc, errors = np.random.default_rng(2), Disc((80.3, 60.6), 30, 0.6, 1.0), []
    clean = render([disc])
    for _ in range(40):
        (found,) = Detector().detect(expose(clean, 3, rng))
        poses = locate(found, LENS, 2 * RADIUS)
        assert poses is not None
        assert found.offset_px is not None
        errors.append([found.uv + found.offset_px - disc.uv, poses[0].centre_uv - disc.uv])
    detected, located = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 2)))
    assert located < 0.55 * detected
