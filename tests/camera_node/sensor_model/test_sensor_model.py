# SPDX-License-Identifier: BSD-3-Clause
"""The sensor model agrees with exact projections, with the renderer and with the detector."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.detection.disc_pose import locate
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.sensor_model.imaging import Imaging
from camera_node.sensor_model.operational_space import (
    PAPER_D,
    Pattern,
    base_at,
    farthest_distance,
    image_size,
    nearest_distance,
    operational_space,
)
from camera_node.sensor_model.precision import predict_precision
from camera_node.sensor_model.threshold import MAX_DIAMETER_PX, MAX_SLANT_DEG, smallest_major_px, threshold_D
from camera_node.sensor_model.visibility import (
    detection_range,
    is_detected,
    is_in_image,
    outlines,
    project_discs,
)
from tests.benchmarks.detector.pictures import expose
from tests.camera_node.tracing import Sight, ellipse_of, trace

LENS = Lens(width=640, height=480, fx=700.0, fy=690.0, cx=319.5, cy=239.5)
BARREL = Lens(
    width=640, height=480, fx=500.0, fy=498.0, cx=322.0, cy=236.0, distortion=(-0.3, 0.09, 1e-3, -5e-4, 0.0)
)
PAPER = Pattern(0.14, 0.084, 0.18)


def turned(phi: float, psi: float) -> Array:
    """(3,) normal of a pattern turned by phi about the image's vertical and by psi about its horizontal axis."""
    return np.array([np.sin(phi), np.cos(phi) * np.sin(psi), -np.cos(phi) * np.cos(psi)])


@pytest.mark.parametrize(("phi", "psi"), [(0.0, 0.0), (0.7, 0.0), (0.0, 0.6)])
def test_the_image_size_is_that_of_the_projected_circle(phi: float, psi: float):
    """Up to perspective, which is of the order of (d_o / x)^2."""
    x = 2.0
    uv = outlines(LENS, PAPER.d_o, np.array([[0.0, 0.0, x]]), turned(phi, psi)[None])[0]
    extent = np.ptp(uv, axis=0)
    assert np.allclose(image_size(LENS, PAPER.d_o, x, phi, psi), extent, rtol=2 * (PAPER.d_o / x) ** 2)


def test_the_range_ends_where_the_pattern_fills_the_image_and_where_it_has_D_pixels():
    near, far = nearest_distance(LENS, PAPER.d_o), farthest_distance(LENS, PAPER.d_o, PAPER_D, 0.5)
    w_i, h_i = image_size(LENS, PAPER.d_o, near)
    assert max(w_i / LENS.width, h_i / LENS.height) == pytest.approx(1)
    assert min(image_size(LENS, PAPER.d_o, far, 0.5)) == pytest.approx(PAPER_D)


def test_a_pattern_anywhere_in_the_base_of_the_operational_space_is_in_the_image():
    """And one a margin of d_o beyond its corner is not. With the fractions as printed, neither would hold."""
    space = operational_space(LENS, PAPER.d_o)
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 5) * space.v_y, np.linspace(-0.5, 0.5, 5) * space.v_z)
    points = np.column_stack([y.ravel(), z.ravel(), np.full(y.size, space.v_max)])
    normals = np.tile([0.0, 0.0, -1.0], (len(points), 1))
    assert is_in_image(LENS, PAPER.d_o, points, normals).all()
    beyond = points[0] - [PAPER.d_o, PAPER.d_o, 0]
    assert not is_in_image(LENS, PAPER.d_o, beyond[None], normals[:1])[0]
    assert (base_at(LENS, PAPER.d_o, nearest_distance(LENS, PAPER.d_o)) >= 0).all()


@pytest.mark.parametrize("lens", [LENS, BARREL])
def test_axes_are_those_of_exactly_projected_circles(lens: Lens):
    rng = np.random.default_rng(3)
    uv = rng.uniform((60, 60), (580, 420), (50, 2))
    position = np.column_stack([lens.normalise(uv), np.ones(50)]) * rng.uniform(2, 5, (50, 1))
    normal = rng.normal(0, 0.5, (50, 3)) - [0, 0, 1.5]
    image = project_discs(lens, PAPER.d_o, position, normal)
    around = outlines(lens, PAPER.d_o, position, normal)
    # Half of the squared singular values of the centred points are the squared semi-axes.
    values = np.linalg.svd(around - around.mean(axis=1, keepdims=True), compute_uv=False)
    axes = 2 * np.sqrt(2 / around.shape[1]) * values
    assert np.allclose(image.axes_px, axes, rtol=0.01)
    assert np.allclose(image.uv, uv, atol=1e-6)


def test_axes_are_those_of_the_rendered_ellipse():
    for tilt, turn in ((0.0, 0.0), (0.6, 1.0), (1.1, 4.0)):
        sight = Sight(LENS, (500.0, 100.0), 3.0, PAPER.d_o, tilt, turn)
        image = project_discs(LENS, PAPER.d_o, sight.position[None], sight.normal[None])
        assert image.slant_rad[0] == pytest.approx(tilt, abs=1e-6)
        assert np.allclose(image.axes_px[0], ellipse_of(sight)[1], rtol=2e-3)


def test_a_pattern_behind_the_lens_reversed_or_too_slanted_is_not_detected():
    position = np.array([[0.0, 0.0, 1.5]])
    towards = np.array([[0.0, 0.0, -1.0]])
    assert is_detected(LENS, PAPER, position, towards)[0]
    assert not is_detected(LENS, PAPER, -position, towards)[0]
    assert not is_detected(LENS, PAPER, position, -towards)[0]
    slanted = turned(np.radians(MAX_SLANT_DEG + 1), 0.0)[None]
    assert not is_detected(LENS, PAPER, position, slanted)[0]
    assert not is_detected(LENS, PAPER, position, towards, Imaging(contrast=20.0))[0]


def test_points_beyond_the_field_of_view_are_not_projected_into_the_image():
    """The polynomial of a barrel lens folds back."""
    angles = np.radians(np.arange(0, 89))
    points = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    found = is_in_image(BARREL, 0.01, points, -points)
    assert found[0]
    assert np.count_nonzero(np.diff(found.astype(int))) == 1


def test_motion_and_blur_shorten_the_range():
    near = np.array([[0.0, 0.0, 1.5]])
    towards = np.array([[0.0, 0.0, -1.0]])
    exposed = Imaging(exposure_s=0.01)
    image = project_discs(LENS, PAPER.d_o, near, towards, np.array([[0.03, 0.0, 0.0]]))
    assert image.motion_px[0] == pytest.approx(LENS.fx * 0.03 / 1.5)
    assert is_detected(LENS, PAPER, near, towards, exposed, np.array([[3.0, 0.0, 0.0]]))[0]
    assert not is_detected(LENS, PAPER, near, towards, exposed, np.array([[30.0, 0.0, 0.0]]))[0]
    ranges = [detection_range(LENS, PAPER, imaging=Imaging(blur_px=b))[1] for b in (0.4, 0.7, 1.0, 2.0, 4.0)]
    assert ranges == sorted(ranges, reverse=True)
    assert ranges[3] / ranges[4] == pytest.approx(2, rel=1e-3)


def test_the_range_of_our_detector_is_the_papers_with_our_D():
    square = msgspec.structs.replace(LENS, fy=LENS.fx)
    v_min, v_max = detection_range(square, PAPER)
    assert v_max == pytest.approx(
        farthest_distance(square, PAPER.d_o, float(threshold_D(0.0, Imaging()))), rel=2e-3
    )
    assert v_min == pytest.approx(LENS.fx * PAPER.d_o / MAX_DIAMETER_PX, rel=2e-3)
    slanted = detection_range(square, PAPER, phi=np.radians(60))[1]
    assert slanted == pytest.approx(
        LENS.fx * PAPER.d_o / float(smallest_major_px(np.pi / 3, Imaging())), rel=2e-3
    )
    assert np.isnan(detection_range(square, PAPER, phi=1.5)).all()


@pytest.mark.parametrize("slant_deg", [0, 45, 60])
def test_the_detector_finds_patterns_at_v_max_and_not_far_beyond_it(slant_deg: int):
    """v_max agrees with rendered images: found one pixel above D; and not at two thirds of D."""
    pattern = Pattern.of(0.1)
    phi = np.radians(slant_deg)
    _, v_max = detection_range(LENS, pattern, phi)
    size = LENS.fx * pattern.d_o / v_max
    shares = [_share_found(size + 1, phi), _share_found(size * 2 / 3, phi)]
    assert shares[0] >= 0.95
    assert shares[1] <= 0.5


def _share_found(diameter_px: float, phi: float) -> float:
    """The share of 24 roundels in images of their own that a new detector finds, on a ground as dark as the ink."""
    lens = Lens(width=48, height=48, fx=700.0, fy=700.0, cx=23.5, cy=23.5)
    rng, found = np.random.default_rng(int(diameter_px * 100)), 0
    for _ in range(24):
        uv = tuple(23.5 + rng.uniform(-0.5, 0.5, 2))
        sight = Sight(
            lens, uv, 70.0 / diameter_px, tilt=phi, turn=float(rng.uniform(0, 2 * np.pi)), ground=40.0
        )
        found += len(Detector().detect(expose(trace(sight, 4), 3.0, rng))) == 1
    return found / 24


@pytest.mark.parametrize(("diameter_px", "tilt", "noise"), [(20.0, 0.5, 3.0), (40.0, 1.0, 6.0)])
def test_predicted_precision_is_that_of_the_detector(diameter_px: float, tilt: float, noise: float):
    """Squared errors over predicted variances have the mean 1; of 3 x 40 the mean's sigma is 0.13. The detector's own
    excess over the bound is up to 1.2."""
    rng = np.random.default_rng(4)
    lens = Lens(width=96, height=96, fx=600.0, fy=600.0, cx=150.0, cy=-60.0)
    base = Sight(lens, (48.0, 47.0), 60.0 / diameter_px, tilt=tilt, turn=2.0)
    sights = [replace(base, uv=tuple(47.5 + rng.uniform(-0.5, 0.5, 2))) for _ in range(10)]
    squared = [e for sight in sights for e in _squared_errors(sight, noise, rng)]
    assert 1 - 3 * 0.13 < np.mean(squared) < 1.2 + 3 * 0.13


def _squared_errors(sight: Sight, noise: float, rng: np.random.Generator) -> list[float]:
    """Squared errors of four located positions over the predicted covariance, for each of three degrees of freedom."""
    clean, where = trace(sight, 4), (sight.position[None], sight.normal[None])
    cov = predict_precision(sight.lens, Pattern.of(0.1), *where, Imaging(noise=noise)).position_cov[0]
    squared = []
    for _ in range(4):
        found = Detector(inner_ratios=(0.6,)).detect(expose(clean, noise, rng))
        poses = locate(found[0], sight.lens, 0.1)
        assert poses is not None
        error = max(poses, key=lambda pose: pose.normal @ sight.normal).position_m - sight.position
        squared.append(float(error @ np.linalg.solve(cov, error)) / 3)
    return squared


def test_precision_scales_with_noise_contrast_and_distance():
    position, normal = np.array([[0.1, -0.2, 3.0]]), turned(0.6, 0.2)[None]
    base = predict_precision(LENS, PAPER, position, normal, Imaging(noise=5.0))
    louder = predict_precision(LENS, PAPER, position, normal, Imaging(noise=10.0))
    fainter = predict_precision(LENS, PAPER, position, normal, Imaging(noise=5.0, contrast=75.0))
    farther = predict_precision(LENS, PAPER, 2 * position, normal, Imaging(noise=5.0))
    # The prior on the ratio does not scale, so the factors are a little below those of a pure sum.
    assert louder.distance_sigma_m[0] / base.distance_sigma_m[0] == pytest.approx(2, rel=0.1)
    assert fainter.distance_sigma_m[0] == pytest.approx(louder.distance_sigma_m[0], rel=0.02)
    assert farther.distance_sigma_m[0] / base.distance_sigma_m[0] == pytest.approx(2**2.5, rel=0.15)
    moving = predict_precision(
        LENS, PAPER, position, normal, Imaging(noise=5.0, exposure_s=0.01), np.array([[4.0, 0.0, 0.0]])
    )
    ratio = moving.centre_cov_px[0] / base.centre_cov_px[0]
    assert ratio[0, 0] > 1.5 * ratio[1, 1] > 1.5  # motion along u blurs the edges that determine u


def test_precision_behind_the_camera_is_nan():
    predicted = predict_precision(
        LENS, PAPER, np.array([[0, 0, -1.0], [0, 0, 1.0]]), np.tile([0, 0, -1.0], (2, 1)), Imaging()
    )
    assert np.isnan(predicted.distance_sigma_m).tolist() == [True, False]


def test_a_pattern_with_impossible_diameters_is_refused():
    with pytest.raises(ValueError, match="0 < d_i < d_o <= d"):
        Pattern(0.1, 0.12, 0.2)
    with pytest.raises(ValueError, match="contrast above 0"):
        Imaging(contrast=0.0)
