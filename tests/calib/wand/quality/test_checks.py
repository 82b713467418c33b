# SPDX-License-Identifier: BSD-3-Clause
"""Recordings and wand files that cannot be right are refused, with the figures that show it."""

import re

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.wand_report import WandCalibration
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from tests.calib.synthetic import WAND, Arena, record, ring

STICK_WITH_ROUNDELS = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))


def test_a_wand_at_rest_is_refused():
    arena = Arena(ring(3).truth, speed=0.0)
    with pytest.raises(CalibrationError, match=r"moved: by 0\.\d px .*'cam\d'"):
        calibrate(arena.intrinsics, arena.wand, record(arena, 5.0, sigma_px=0.1))


@pytest.mark.ci
def test_a_wand_file_with_a_wrong_spacing_is_refused():
    """The middle marker is 3 cm off in the file: the message has the distance of the file and the measured one, by
    0.2 mm, which is four of its standard deviations. With 6 cm, no two cameras fit."""
    arena = ring(4)
    wrong = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.17, 0.0, 0.0), (0.5, 0.0, 0.0)))
    messages = record(arena, 8.0, sigma_px=0.1, sized=False, numbered=True)
    with pytest.raises(CalibrationError, match=r"markers 0 and 1 .*0\.1700 m") as caught:
        calibrate(arena.intrinsics, wrong, messages)
    lengths = [float(length) for length in re.findall(r"(\d\.\d{4}) m", str(caught.value))]
    assert lengths == [0.17, pytest.approx(0.2, abs=2e-4), 0.5]
    far_off = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.14, 0.0, 0.0), (0.5, 0.0, 0.0)))
    with pytest.raises(
        CalibrationError, match=r"'cam\d' and 'cam\d' .* in \d+ frame sets.* measure the wand"
    ):
        calibrate(arena.intrinsics, far_off, messages)


ANGLE = Body(diameter_m=0.1, markers=((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.1, 0.25, 0.0)))
PLANE = msgspec.structs.replace(ANGLE, markers=(*ANGLE.markers, (0.33, 0.13, 0.0)))
SOLID = msgspec.structs.replace(ANGLE, markers=(*ANGLE.markers, (0.15, 0.1, 0.2)))


@pytest.mark.parametrize(
    ("wand", "marker", "to"),
    [
        pytest.param(WAND, 1, (0.199, 0.0, 0.0), marks=pytest.mark.ci),
        (WAND, 1, (0.19, 0.0, 0.0)),
        pytest.param(ANGLE, 2, (0.1, 0.254, 0.0), marks=pytest.mark.slow),
        pytest.param(ANGLE, 1, (0.404, 0.0, 0.0), marks=pytest.mark.slow),
        pytest.param(PLANE, 0, (0.004, 0.0, 0.0), marks=pytest.mark.slow),
        pytest.param(SOLID, 3, (0.15, 0.1, 0.204), marks=pytest.mark.ci),
    ],
)
def test_a_wand_that_was_measured_wrong_is_measured_by_the_cameras(
    wand: Body, marker: int, to: tuple[float, float, float]
):
    """By 1 to 10 mm, which displaced cameras by up to 180 mm. Their arrangement is as exact as with the true wand. Its
    size is as uncertain as the wand, and as exact where three other markers agree against the wrong one."""
    arena = ring(4, wand=wand)
    messages = record(arena, 8.0, sigma_px=0.1, sized=False, numbered=True)
    markers = (*wand.markers[:marker], to, *wand.markers[marker + 1 :])
    files = (wand, msgspec.structs.replace(wand, markers=markers))
    results = [calibrate(arena.intrinsics, file, messages) for file in files]
    assert "the wand differs" not in assess(results[0], wand).sentence()
    if np.linalg.norm(np.subtract(to, wand.markers[marker])) > 0.0015:
        sentence = assess(results[1], wand).sentence()
        assert re.search(
            "; the wand differs from its file: markers .* as the cameras measure it, .* correct", sentence
        )
    truth = np.array([camera.matrix()[:3, 3] for camera in arena.truth.cameras.values()])
    off_mm, claimed = [], []
    for result in results:
        found = np.array([camera.matrix()[:3, 3] for camera in result.rig.cameras.values()])
        sizes = [np.linalg.norm(points - points.mean(axis=0)) for points in (found, truth)]
        off_mm.append(1e3 * apart(found * sizes[1] / sizes[0], truth))
        claimed.append(np.sqrt(size_variance(result)))
        assert abs(sizes[0] / sizes[1] - 1) < 4 * claimed[-1]
    assert off_mm[1] < off_mm[0] + 0.5  # 0.1 px are 0.4 mm at 2 m
    assert (claimed[1] > 5 * claimed[0]) == (len(wand.markers) < 4)
    if claimed[1] > 0.02:  # the worst that is wrong with the calibration
        assert "the wand's size is known to" in assess(results[1], wand).sentence()


def apart(first: Array, second: Array) -> float:
    """The largest difference of the distances between the points of either set."""
    gaps = [np.linalg.norm(points[:, None] - points, axis=2) for points in (first, second)]
    return float(np.abs(gaps[0] - gaps[1]).max())


def size_variance(result: WandCalibration) -> float:
    """Of the size of a rig, as a share of it."""
    T = [camera.matrix() for camera in result.rig.cameras.values()]
    centre = np.mean([pose[:3, 3] for pose in T], axis=0)
    g = np.concatenate([np.append(np.zeros(3), pose[:3, :3].T @ (pose[:3, 3] - centre)) for pose in T])
    return float(g @ result.covariance @ g / (g @ g) ** 2)


@pytest.mark.parametrize("sigma_px", [pytest.param(0.1, marks=pytest.mark.slow), 0.4])
def test_a_length_of_6_percent_too_much_is_refused_by_the_sizes(sigma_px: float):
    """0.53 m for 0.50: two markers have no ratio, but their sizes have. The stated diameter reconciles both, and the
    true length too."""
    arena = ring(3, wand=STICK_WITH_ROUNDELS)
    messages = record(arena, 8.0, sigma_px=sigma_px, numbered=True)
    longer = msgspec.structs.replace(STICK_WITH_ROUNDELS, markers=((0.0, 0.0, 0.0), (0.53, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match=r"sizes disagree by 6%: .* is 0\.12[67]\d m across") as caught:
        calibrate(arena.intrinsics, longer, messages)
    across = float(re.findall(r"is (0\.\d+) m across", str(caught.value))[0])
    assert calibrate(arena.intrinsics, msgspec.structs.replace(longer, diameter_m=across), messages).names
    assert len(calibrate(arena.intrinsics, STICK_WITH_ROUNDELS, messages).names) == 3
