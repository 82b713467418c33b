# SPDX-License-Identifier: BSD-3-Clause
"""Grades follow their limits, and the sentence names the camera, the figure and the remedy."""

from dataclasses import replace

import numpy as np
import pytest

from calib.rig.coverage import Coverage
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import ADVICE, GRADES, LIMITS, CameraQuality, RigQuality, assess, grade
from calib.wand.wand_report import Validation
from tests.calib.synthetic import record, ring


def test_the_quality_of_a_calibration_with_little_noise():
    """With 0.1 px of noise and 10 s, only the coverage and the lenses, of unknown standard deviation, prevent an A:
    without the lenses, every pose has one. Points are known to millimetres."""
    arena = ring(4)
    quality = assess(calibrate(arena.intrinsics, arena.wand, record(arena, 10.0, sigma_px=0.1)), arena.wand)
    names = {camera.name for camera in quality.cameras}
    assert names == set(arena.truth.cameras)
    for camera in quality.cameras:
        below = {name for name, value in camera.figures.items() if grade(name, value) != "A"}
        assert below == {"unused", "pose_px"}
        assert grade("pose_px", camera.noise_px) == "A"
        assert camera.limiting_lens in names
        assert camera.figures["residual_px"] == pytest.approx(0.1 * np.sqrt(2), rel=0.3)
        assert camera.noise_ratio == pytest.approx(camera.noise_px / 0.1)
    assert quality.expected is not None
    assert 0.2 < quality.expected.typical_mm < 4
    entries = quality.as_dict()
    assert quality.held_out is not None
    assert quality.held_out.residual_px == pytest.approx(0.1 * np.sqrt(2), rel=0.3)
    assert max(camera.grade for camera in quality.cameras) == "C"
    assert entries["grade"] == "B"  # held-out detections deserve an A
    assert set(entries["quality"]) == names


def assessed(name: str, **figures: float) -> CameraQuality:
    """Return a camera of grade A but for the given figures."""
    good = {"residual_px": 0.1, "rejected": 0.0, "pose_px": 0.02, "unused": 0.1}
    return CameraQuality(name, Coverage(np.ones((4, 6), np.int64)), np.ones((4, 6), bool), good | figures)


@pytest.mark.parametrize(
    ("criterion", "fact"),
    [
        ("residual_px", "residual {:.2f} px"),
        ("rejected", "{:.0%}"),
        ("pose_px", "{:.2f} px"),
        ("unused", "{:.0%}"),
    ],
)
def test_a_camera_beyond_a_limit_is_named_with_its_figure(criterion: str, fact: str):
    for k, limit in enumerate(LIMITS[criterion]):
        value = 1.01 * limit
        quality = RigQuality([assessed("good"), assessed("bad", **{criterion: value})], {}, 1e-4, None)
        assert quality.grade == GRADES[k + 1]
        sentence = quality.sentence()
        assert f"grade {GRADES[k + 1]}" in sentence
        assert "'bad'" in sentence
        assert "'good'" not in sentence
        assert fact.format(value) in sentence
        assert ADVICE.get(criterion, "") in sentence


def test_the_grade_of_a_rig():
    """A camera without a pose, or with an unknown figure, is a D; so is a wrong wand."""
    assert RigQuality([assessed("a")], {}, 1e-4, None).grade == "A"
    unplaced = RigQuality([assessed("a")], {"b": "it never saw the wand"}, None, None)
    assert unplaced.grade == "D"
    for fact in ("grade D", "'b'", "it never saw the wand"):
        assert fact in unplaced.sentence()
    wrong_wand = RigQuality([assessed("a")], {}, 0.03, None)
    assert wrong_wand.grade == "D"
    assert "wand's length is 3.00%" in wrong_wand.sentence()
    assert RigQuality([assessed("a", pose_px=float("nan"))], {}, None, None).grade == "D"


def test_what_held_out_detections_show_to_be_precise_is_no_d():
    """0.6 mm at 2 m is 0.3 per mille: an A, or a B with the advice of its worst camera; 1 % stays a D."""
    precise = Validation(count=100, all_px=0.5, gross=0.0, residual_px=0.5, error_m=6e-4, range_m=2.0)
    bad = RigQuality([assessed("bad", residual_px=2.0)], {}, 1e-4, None, precise)
    assert bad.grade == "B"
    assert "held-out error 0.30 per mille" in bad.sentence()
    assert f"to improve it: {ADVICE['residual_px']}" in bad.sentence()
    assert RigQuality([assessed("good")], {}, 1e-4, None, precise).grade == "A"
    useless = replace(precise, error_m=0.02)
    assert RigQuality([assessed("good")], {}, 1e-4, None, useless).grade == "D"
    assert RigQuality([assessed("good")], {"b": "it never saw the wand"}, 1e-4, None, precise).grade == "D"


def test_a_lens_that_limits_poses_is_reported_once():
    """With the cameras that it limits, and the command that calibrates it."""
    cameras = [
        CameraQuality(name, Coverage(np.ones((4, 6), np.int64)), np.ones((4, 6), bool), figures, "c")
        for name, figures in (
            ("a", {"residual_px": 0.1, "pose_px": 0.5}),
            ("b", {"residual_px": 0.1, "pose_px": 0.4}),
            ("c", {"residual_px": 0.1, "pose_px": 0.05}),
        )
    ]
    (warning,) = RigQuality(cameras, {}, None, None).lens_warnings()
    assert "a and b" in warning
    assert "--camera c" in warning
