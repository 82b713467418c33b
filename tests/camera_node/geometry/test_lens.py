# SPDX-License-Identifier: BSD-3-Clause
"""Lenses: projection, its inverse, and derivatives against finite differences."""

import numpy as np
import pytest

from camera_node.geometry.lens import Lens

SHAPE = {"width": 800, "height": 600, "fx": 620.0, "fy": 615.0, "cx": 402.3, "cy": 297.1}
LENSES = {
    "ideal": Lens(**SHAPE),
    "pinhole": Lens(**SHAPE, distortion=(-0.12, 0.03, 0.001, -0.0005, 0.002)),
    "rational": Lens(**SHAPE, distortion=(-0.1, 0.02, 0.0003, -0.0002, 0.001, 0.05, 0.01, 0.002)),
    "fisheye": Lens(**SHAPE, distortion=(0.02, -0.004, 0.001, -0.0003), model="fisheye"),
}
lenses = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


def points(n: int = 200) -> np.ndarray:
    """(n, 3) points in the field of view of all these lenses."""
    rng = np.random.default_rng(1)
    z = rng.uniform(0.5, 6, n)
    return np.column_stack([rng.uniform(-0.6, 0.6, n) * z, rng.uniform(-0.45, 0.45, n) * z, z])


@lenses
def test_the_jacobian_by_points_equals_finite_differences(lens: Lens):
    """Central differences have errors of h^2 f''' and rounding / h: below 1e-4 of 1000 px/m for h = 1e-5."""
    p, h = points(), 1e-5
    uv, J = lens.project_with_jacobian(p)
    np.testing.assert_allclose(uv, lens.project(p), atol=1e-9)
    for k in range(3):
        step = h * np.eye(3)[k]
        numeric = (lens.project(p + step) - lens.project(p - step)) / (2 * h)
        np.testing.assert_allclose(J[:, :, k], numeric, atol=1e-3)


@lenses
def test_the_jacobian_by_parameters_equals_finite_differences(lens: Lens):
    """The pixel is linear in all parameters except products of fx and k, which are smooth."""
    p, h = points(), 1e-5
    uv, _, J = lens.project_with_jacobians(p)
    assert J.shape == (len(p), 2, 4 + len(lens.distortion))
    for k, step in enumerate(h * np.eye(len(lens.parameters))):
        ahead, behind = (
            lens.with_parameters(lens.parameters + step),
            lens.with_parameters(lens.parameters - step),
        )
        np.testing.assert_allclose(J[:, :, k], (ahead.project(p) - behind.project(p)) / (2 * h), atol=1e-3)
    np.testing.assert_allclose(uv, lens.project(p), atol=1e-9)


def test_a_fisheye_lens_has_rays_up_to_88_degrees():
    """Projected rays are recovered, also where theta_d is above 90 degrees."""
    lens = Lens(**{**SHAPE, "fx": 300.0, "fy": 300.0}, distortion=(0.05, -0.01, 0.002, 0.0), model="fisheye")
    theta, phi = np.radians([[5, 40, 70, 85, 88]]), np.radians(np.arange(0, 360, 30))[:, None]
    away = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi]
    rays = np.stack(away, axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(lens.rays(lens.project(rays)), rays, atol=1e-9)


@lenses
def test_normalise_inverts_project(lens: Lens):
    """The inverse is iterative; 1e-6 of a focal length is 0.0006 px, far below the noise of any detector."""
    p = points()
    np.testing.assert_allclose(lens.normalise(lens.project(p)), p[:, :2] / p[:, 2:], atol=1e-6)


@lenses
def test_rays_point_at_the_points(lens: Lens):
    p = points()
    np.testing.assert_allclose(
        lens.rays(lens.project(p)), p / np.linalg.norm(p, axis=1, keepdims=True), atol=1e-6
    )


@lenses
def test_points_behind_the_camera_have_no_pixel(lens: Lens):
    uv, J = lens.project_with_jacobian([[0, 0, -1.0], [0, 0, 0], [0, 0, 1.0]])
    assert np.isnan(uv[:2]).all()
    assert np.isnan(J[:2]).all()
    np.testing.assert_allclose(uv[2], [lens.cx, lens.cy])


@lenses
def test_no_points_give_no_pixels(lens: Lens):
    assert lens.project(np.empty((0, 3))).shape == (0, 2)
    assert lens.normalise(np.empty((0, 2))).shape == (0, 2)
    assert lens.rays(np.empty((0, 2))).shape == (0, 3)


def test_pixels_outside_the_range_of_the_distortion_have_no_ray():
    """Barrel distortion has a largest radius; pixels beyond it are NaN."""
    lens = Lens(**SHAPE, distortion=(-0.3, 0.0, 0.0, 0.0))
    assert np.isnan(lens.normalise([[5000.0, 5000.0]])).all()


@pytest.mark.parametrize(
    "change", [{"fx": 0}, {"width": 0}, {"cx": float("nan")}, {"distortion": (0.1, 0.2)}], ids=str
)
def test_impossible_lenses_are_refused(change: dict):
    with pytest.raises(ValueError, match=r"focal|possible|finite|distortion"):
        Lens(**{**SHAPE, **change})


def test_impossible_parameters_are_refused():
    with pytest.raises(ValueError, match="focal"):
        LENSES["pinhole"].with_parameters([-1.0, 1.0, 1.0, 1.0, 0, 0, 0, 0, 0])
