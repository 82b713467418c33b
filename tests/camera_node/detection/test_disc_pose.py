# SPDX-License-Identifier: BSD-3-Clause
"""The two poses of a disc that explain one ellipse."""

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.detection.disc_pose import (
    adjust,
    covariance_through,
    distance_by_principal_axis,
    locate,
    locate_all,
)
from camera_node.detection.roundels import Roundel, Roundels
from camera_node.geometry.lens import Lens
from camera_node.geometry.outline import ellipses_of
from tests.benchmarks.detector.pictures import Card, outline_of, render, sight_of
from tests.camera_node.tracing import Sight, expose, pixels_across, trace

SMALL = Lens(width=160, height=120, fx=600, fy=600, cx=79.5, cy=59.5)
RADIUS = 0.05
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
    """Exact for a pinhole. A distorted image of a circle is not an ellipse: 0.1 % of 2 m for a disc of 0.1 m."""
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


def test_a_measured_offset_determines_the_normal():
    """At 60 px and 40 degrees the centres of the two poses are 2 px apart: many standard deviations."""
    for turn in (0.4, 2.0, 5.0):
        disc = Card((82, 61), 60, np.radians(40), turn)
        (found,) = Detector().detect(expose(render([disc]), 2, np.random.default_rng(3)))
        poses = locate(found, SMALL, 0.1)
        assert poses is not None
        assert poses[0].probability > 0.99
        assert poses[0].normal @ sight_of(disc, (160, 120)).normal > np.cos(np.radians(2))
        assert poses[0].position_m[2] == pytest.approx(0.1 / (60 / 600), rel=0.005)


def columns(roundels: list[Roundel]) -> Roundels:
    rows = [(r.uv, r.cov, r.axes_px, r.angle_rad, r.ratio, r.contrast, -1, -1) for r in roundels]
    return Roundels(*(np.array(column) for column in zip(*rows, strict=True)))


def test_locate_all_agrees_with_locate():
    """Within rounding. A roundel outside of the lens's field of view has no pose and does not affect the others."""
    normals = [np.array([s, 0.1, -np.sqrt(0.99 - s * s)]) for s in (0.0, 0.3, 0.8)]
    seen = [project_circle(WIDE, np.array([0.1, 0.2, 2.0]), n, 0.05) for n in normals]
    far = Roundel(np.array([9e4, 9e4]), np.eye(2), np.array([10.0, 9.0]), 0.0, 0.6, 100.0)
    together = locate_all(columns([seen[0], far, *seen[1:]]), WIDE, 0.1)
    assert together[1] is None
    for both, roundel in zip((together[0], together[2], together[3]), seen, strict=True):
        alone = locate(roundel, WIDE, 0.1)
        assert alone is not None
        assert both is not None
        for a, b in zip(alone, both, strict=True):
            assert a.position_m == pytest.approx(b.position_m, rel=1e-9)
            assert a.normal == pytest.approx(b.normal, abs=1e-9)
    assert len(locate_all(columns(seen).select(np.empty(0, int)), WIDE, 0.1)) == 0


DEMO = {"fx": 566.4, "fy": 566.1, "distortion": (-0.112, 0.031, 0.0004, -0.0003, 0.0)}  # camera north's


@pytest.mark.parametrize("at", [(322.0, 237.0), pytest.param((80.0, 80.0), marks=pytest.mark.ci)])
@pytest.mark.parametrize("tilt_deg", [20, 50])
def test_poses_through_the_demos_lens_are_unbiased(at: tuple[float, float], tilt_deg: float):
    """Distance within 0.05 % and the image of the disc's centre within 0.01 px, plus three sigmas of the mean.

    The images are ray-traced through the lens, at the centre and near a corner. At 40 px noise of one grey level makes
    errors of 0.01 % of the distance and 0.002 px of the centre.
    """
    rng, distance, centre = np.random.default_rng(4), [], []
    for turn in rng.uniform(0, 2 * np.pi, 6):
        cx, cy = (40 + c - a for c, a in zip((322.6, 237.1), at, strict=True))
        lens = Lens(width=80, height=80, cx=cx, cy=cy, **DEMO)
        uv = (40 + rng.uniform(-0.5, 0.5), 40 + rng.uniform(-0.5, 0.5))
        sight = Sight(lens, uv, pixels_across(lens, 0.1, 40), tilt=np.radians(tilt_deg), turn=turn)
        (found,) = Detector().detect(expose(trace(sight, 4), 1, rng))
        poses = locate(found, lens, 0.1)
        assert poses is not None
        assert poses[0].normal @ sight.normal > np.cos(np.radians(1))
        distance.append(np.linalg.norm(poses[0].position_m) / np.linalg.norm(sight.position) - 1)
        centre.append(poses[0].centre_uv - sight.uv)
        by_axis = distance_by_principal_axis(found, lens, 0.1) / np.linalg.norm(sight.position) - 1
        assert by_axis == pytest.approx(distance[-1], abs=1e-4)
    assert abs(np.mean(distance)) < 5e-4 + 3 * 1e-4 / np.sqrt(6)
    assert np.abs(np.mean(centre, axis=0)).max() < 0.01 + 3 * 0.002 / np.sqrt(6)


def test_the_probability_of_the_normal_is_consistent():
    """Of normals with a probability above 0.99 one in a hundred may be wrong: 3 of 300, plus five sigmas."""
    rng, wrong = np.random.default_rng(5), 0
    lens = Lens(width=44, height=44, fx=600, fy=600, cx=60, cy=-20)
    for turn in rng.uniform(0, 2 * np.pi, 15):
        sight = Sight(
            lens,
            (21.7, 22.2),
            pixels_across(lens, 0.1, 13),
            tilt=rng.uniform(0.2, 0.9),
            turn=turn,
            ground=190.0,
        )
        clean = trace(sight)
        for _ in range(20):
            found = Detector().detect(expose(clean, 3, rng))
            assert len(found) == 1
            poses = locate_all(found, lens, 0.1)[0]
            assert poses is not None
            right, other = (pose.normal @ sight.normal for pose in poses)
            wrong += poses[0].probability > 0.99 and right < other
    assert wrong <= 3 + 5 * np.sqrt(3)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("diameter_m", [0.1, 0.6])
@pytest.mark.parametrize("place", [(0.0, 0.0, 2.0), (0.8, -0.5, 2.0)])
def test_distance_by_the_principal_axis(tilt: float, diameter_m: float, place: tuple):
    """The error is of fourth order in d_o / L at any slant and position, and of second order uncorrected."""
    centre = np.array(place)
    normal = np.array([0.6 * np.sin(tilt), 0.8 * np.sin(tilt), -np.cos(tilt)])
    roundel, L = project_circle(PINHOLE, centre, normal, diameter_m / 2), float(np.linalg.norm(centre))
    found = distance_by_principal_axis(roundel, PINHOLE, diameter_m)
    assert found / L == pytest.approx(1, abs=0.02 * (diameter_m / L) ** 4 + 1e-8)
    if place[0] == 0:
        uncorrected = diameter_m / (roundel.axes_px[0] / PINHOLE.fx)
        assert uncorrected / L - 1 == pytest.approx(
            -((diameter_m / L * np.sin(tilt)) ** 2) / 8, rel=0.1, abs=1e-9
        )


def test_an_ellipse_outside_of_the_field_of_view_has_no_pose():
    far = Roundel(np.array([9e4, 9e4]), np.eye(2), np.array([10.0, 9.0]), 0.0, 0.6, 100.0)
    assert locate(far, WIDE, 0.1) is None
    assert np.isnan(distance_by_principal_axis(far, WIDE, 0.1))


def test_the_renderers_ellipse():
    """A frontal disc on the axis is a circle of its diameter."""
    centre, axes = outline_of(Card((79.5, 59.5), 30))
    assert centre == pytest.approx([79.5, 59.5])
    assert axes == pytest.approx([30, 30])


def measured(position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(1, 7) the outline of a disc and the image of its centre, in the plane at distance one."""
    dual = np.outer(position, position) - RADIUS**2 * (np.eye(3) - np.outer(normal, normal))
    return np.concatenate([ellipses_of(dual), position[:2] / position[2]])[None]


def measured_covariance(diameter: float) -> np.ndarray:
    """(1, 7, 7) covariance of a detected roundel, in the plane at distance one."""
    image = expose(render([Card((80.3, 60.6), diameter, 0.6, 1.0)]), 3, np.random.default_rng(1))
    (found,) = Detector().detect(image)
    ellipse = np.array([[*found.uv, *found.axes_px, found.angle_rad]])
    assert found.pose_cov is not None
    return covariance_through(SMALL, ellipse, found.pose_cov[None])


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
    rng, disc, errors = np.random.default_rng(2), Card((80.3, 60.6), 30, 0.6, 1.0), []
    clean = render([disc])
    for _ in range(40):
        (found,) = Detector().detect(expose(clean, 3, rng))
        poses = locate(found, SMALL, 2 * RADIUS)
        assert poses is not None
        assert found.offset_px is not None
        errors.append([found.uv + found.offset_px - disc.uv, poses[0].centre_uv - disc.uv])
    detected, located = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 2)))
    assert located < 0.55 * detected
