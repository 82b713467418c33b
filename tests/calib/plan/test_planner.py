# SPDX-License-Identifier: BSD-3-Clause
"""The evaluation of a plan: properties of coverage and errors."""

import msgspec
import numpy as np
import pytest

from calib.plan.camera_kind import CameraKind
from calib.plan.catalogue import CATALOGUE
from calib.plan.description import ImageQuality, Plan, PlannedRobots
from calib.plan.expected_error import RoundelSensor, Uncertainty, combine_views, expected_errors
from calib.plan.planner import PlannedArena, evaluate, message_bytes
from calib.rig.camera import Camera
from calib.rig.triangulation import triangulate_point
from camera_node.foundation.config import load_yaml
from camera_node.sensor_model.operational_space import Pattern
from camera_node.sensor_model.visibility import is_detected, is_in_image
from tests.conftest import ROOT

PLAN = load_yaml(ROOT / "configs" / "plan.yaml", Plan)
KIND = CameraKind(width=1280, height=800, focal_px=900.0, fps=60.0)
RING = [(3.0, 0.0), (0.0, 3.0), (-3.0, 0.0), (0.0, -3.0)]
CAMERAS = {f"c{k}": KIND.placed((x, y, 3.0), (0.0, 0.0, 0.3)) for k, (x, y) in enumerate(RING)}
ROBOT = PlannedRobots(diameter_m=0.12, heights_m=(0.1, 0.8), speed_m_s=0.0)
ARENA = PlannedArena.of_cameras(Plan(area_m=(-1.5, -1.5, 1.5, 1.5), robots=ROBOT), CAMERAS, KIND)


def with_cameras(names: list[str]) -> PlannedArena:
    return PlannedArena.of_cameras(ARENA.plan, {name: CAMERAS[name] for name in names}, KIND)


def test_more_cameras_see_more_and_are_more_precise():
    """Adding a camera never decreases the number of views or increases the best estimate's error by more than the
    floor of the tracker's weights allows; where no second camera sees, no error is predicted."""
    points = ARENA.plan.volume(500).points
    two, four = with_cameras(["c0", "c1"]).errors_at(points), ARENA.errors_at(points)
    both = np.isfinite(two.position_mm)
    assert both.any()
    assert (four.cameras >= two.cameras).all()
    assert (four.position_mm[both] < two.position_mm[both] + 1e-9).all()
    assert (np.isinf(four.position_mm) == (four.cameras < 2)).all()


def test_a_camera_detects_what_the_sensor_model_says():
    """The views agree with `is_detected`, which projects every outline, except near a limit; they see cut discs too."""
    camera, sensor = CAMERAS["c0"], RoundelSensor.of(ARENA.plan, KIND)
    points = np.random.default_rng(1).uniform([-4, -4, 0], [4, 4, 2.5], (4000, 3))
    T = camera.matrix()
    local = (points - T[:3, 3]) @ T[:3, :3]
    normal = np.tile(T[2, :3], (len(points), 1))
    expected = is_detected(camera, Pattern.of(ROBOT.diameter_m), local, normal, sensor.imaging)
    found = np.isin(np.arange(len(points)), sensor.view(camera, points).rows)
    complete = is_in_image(camera, ROBOT.diameter_m, local, normal)
    assert 0.1 < found.mean() < 0.9
    assert (found != expected)[complete].mean() < 0.01
    cut = found & ~complete
    assert cut.any()
    uv = camera.project_world(points[cut])
    assert camera.sees(uv).all()


def test_a_roundel_that_the_border_cuts_is_less_precise():
    camera, sensor = CAMERAS["c0"], RoundelSensor.of(ARENA.plan, KIND)
    places = np.column_stack([np.zeros(400), np.linspace(0.0, 3.0, 400), np.full(400, 0.3)])
    view = sensor.view(camera, places)
    sigma = np.sqrt(np.trace(view.noise, axis1=1, axis2=2))
    last, uv = view.rows[-1], camera.project_world(places[view.rows])
    assert last < 399
    assert sigma[-1] > 3 * sigma[len(sigma) // 2]
    assert (np.diff(np.abs(uv[:, 0] - camera.cx)) > 0).all()  # the path leaves the image sideways


def test_predicted_errors_are_those_of_triangulation():
    """Gauss-Newton on noisy pixels of equal weight has the predicted root mean square error.

    150 trials of two or more degrees of freedom determine it to 1 / sqrt(2 * 150 * 2) = 4 %; the bound is four times
    that.
    """
    rng, sigma, n = np.random.default_rng(2), 0.3, 150
    image = ImageQuality(noise=0.01, sigma_px=sigma)
    arena = PlannedArena.of_cameras(msgspec.structs.replace(ARENA.plan, image=image), CAMERAS, KIND)
    point = np.array([[0.4, -0.3, 0.5]])
    predicted = arena.errors_at(point).position_mm[0]
    cameras = list(CAMERAS.values())
    uv = np.array([camera.project_world(point)[0] for camera in cameras])
    noisy = uv + sigma * rng.standard_normal((n, *uv.shape))
    errors = [1e3 * (triangulate_point(cameras, one) - point[0]) for one in noisy]
    assert np.sqrt(np.mean(np.sum(np.square(errors), 1))) == pytest.approx(predicted, rel=0.16)


def test_orientation_needs_three_roundels_and_improves_with_their_distance():
    points = np.array([[0.0, 0.0, 0.5]])
    sums = combine_views(CAMERAS, ARENA.sensors(), points, Uncertainty(0.1, 0.0))
    triangle = np.array([[0.1, 0, 0], [-0.05, 0.08, 0], [-0.05, -0.08, 0]])
    single, small, wide = (expected_errors(sums, m) for m in (triangle[:1] * 0, triangle, 2 * triangle))
    assert np.isnan(single.orientation_deg).all()
    assert wide.orientation_deg[0] == pytest.approx(small.orientation_deg[0] / 2, rel=1e-3)
    # Three roundels around the origin average three independent positions.
    assert small.position_mm[0] == pytest.approx(single.position_mm[0] / np.sqrt(3), rel=1e-3)


def test_errors_of_capture_times_grow_with_speed_and_do_not_average_over_roundels():
    """Stamps off by 10 ms at 1 m/s: their common error, v sigma_t, dominates."""
    late = CameraKind(width=1280, height=800, focal_px=900.0, fps=30.0, stamp_sigma_ms=10.0)
    errors = []
    for markers in (((0.0, 0.0, 0.0),), ((0.1, 0, 0), (-0.05, 0.08, 0), (-0.05, -0.08, 0))):
        robots = msgspec.structs.replace(ROBOT, speed_m_s=1.0, markers=markers)
        plan = msgspec.structs.replace(ARENA.plan, robots=robots)
        errors.append(PlannedArena.of_cameras(plan, CAMERAS, late).errors_at(np.array([[0, 0, 0.5]])))
    single, three = (error.position_mm[0] for error in errors)
    assert 2 < single < 10  # four cameras with independent stamps average
    assert three == pytest.approx(single, rel=0.01)


def test_uncertain_camera_poses_of_a_rig_add_to_the_errors():
    covariance = tuple(map(tuple, np.diag([1e-6] * 3 + [1e-6] * 3).tolist()))
    loose = {name: msgspec.structs.replace(c, covariance=covariance) for name, c in CAMERAS.items()}
    point = np.array([[0.2, 0.1, 0.4]])
    exact = ARENA.errors_at(point).position_mm[0]
    uncertain = PlannedArena.of_cameras(ARENA.plan, loose, KIND).errors_at(point).position_mm[0]
    # 1 mrad at 4 m is 4 mm for each camera, to first order independent.
    assert 2 < uncertain < 6
    assert exact < 0.5


def test_blind_spots_are_the_places_without_two_cameras():
    small = msgspec.structs.replace(ARENA.plan, robots=msgspec.structs.replace(ROBOT, diameter_m=0.05))
    cameras = {name: CAMERAS[name] for name in ("c0", "c1")}
    report = evaluate(PlannedArena.of_cameras(small, cameras, KIND), 2000)
    blind = 1 - report.covered.mean()
    assert 0.05 < blind < 0.95
    assert sum(region.share for region in report.blind) == pytest.approx(blind, abs=0.01)
    points = report.volume.points[~report.covered]
    inside = np.zeros(len(points), bool)
    for region in report.blind:
        inside |= ((points >= region.low - 1e-9) & (points <= region.high + 1e-9)).all(axis=1)
    assert inside.mean() > 0.98


def test_the_load_grows_with_robots_and_a_plan_sums_it():
    assert message_bytes(20) - message_bytes(10) == pytest.approx(
        10 * 54, rel=0.05
    )  # columns of `Detections`
    report = evaluate(ARENA, 500)
    assert report.network.total_bit_s == pytest.approx(sum(report.network.camera_bit_s.values()))
    assert report.network.fastest_hz == 60.0


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_camera_of_the_catalogue_sees_roundels(name: str):
    """3 m below it, in the middle of its image; the field of view is plausible."""
    kind = CameraKind(model=name)
    camera: Camera = kind.placed((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    assert len(RoundelSensor.of(ARENA.plan, kind).view(camera, [[0.0, 0.0, 0.1]]).rows) == 1
    half = camera.width / 2 / camera.fx
    assert 40 < 2 * np.degrees(half if camera.model == "fisheye" else np.arctan(half)) < 135


def test_the_shipped_plan_is_sufficient():
    report = evaluate(PlannedArena.of(PLAN), 2000)
    assert report.is_sufficient
    assert report.median_mm < report.quantile_mm(0.95) < 1.0
