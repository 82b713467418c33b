# SPDX-License-Identifier: BSD-3-Clause
"""The measured distance of two cameras: the scale for a wand of one marker, a check of other wands."""

from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from calib.__main__ import execute
from calib.commands.check import split_halves
from calib.errors import CalibrationError
from calib.live.trials import WandSession, compute_trial
from calib.rig.rig import load_rig, save_rig
from calib.wand.calibrate import calibrate
from calib.wand.conclusion import compare_distance
from calib.wand.quality.agreement import CameraPoses, compare_calibrations
from calib.wand.scale import Distance
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.sources.recorded_detections import write_observations
from tests.calib.recordings import WandScenario
from tests.calib.recordings import record as record_wave
from tests.calib.synthetic import EXACT, OLD, Arena, assert_near, record, ring, roughly

LIGHT = Body(diameter_m=0.1)


def true_distance(arena: Arena, a: str, b: str) -> float:
    first, second = (arena.truth.cameras[name].matrix()[:3, 3] for name in (a, b))
    return float(np.linalg.norm(first - second))


def test_a_distance_gives_a_light_its_scale():
    """Noise of 0.1 px at 2.6 m and f = 520 px is 0.5 mm across a ray, and less over a hundred frame sets; the limit is
    2 mm. The standard deviation of the measured distance is added to all distances, as the same part of each."""
    arena = ring(wand=LIGHT)
    messages = record(arena, 12.0, sigma_px=0.1, sized=False)
    true = true_distance(arena, "cam0", "cam2")
    exact, rough = (
        calibrate(arena.intrinsics, LIGHT, messages, Distance("cam0", "cam2", true, sigma))
        for sigma in (0.0, 0.02)
    )
    assert exact.report.metric
    assert_near(exact.rig, arena.truth, 2e-3, 1e-3)
    for a, b in combinations(exact.names, 2):
        wanted = Distance(a, b, true_distance(arena, a, b), 0.0)
        small, large = (compare_distance(wanted, result.names, result.adjusted) for result in (exact, rough))
        assert small is not None
        assert large is not None
        added = np.sqrt(large.sigma_m**2 - small.sigma_m**2)
        assert added == pytest.approx(0.02 * small.by_wand_m / true, rel=1e-3)
    assert rough.report.as_dict()["distance"]["metres"] == true
    sized = record(arena, 12.0, sigma_px=0.1)  # the distance overrides a size that is 10 % off
    wrong = Body(diameter_m=0.11)
    by_tape = calibrate(arena.intrinsics, wrong, sized, Distance("cam0", "cam2", true))
    assert_near(by_tape.rig, arena.truth, 5e-3, 2e-3)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("off", "seeds"),
    [(OLD, (21,)), *(pytest.param(off, (20, 21, 23), marks=pytest.mark.slow) for off in (EXACT, OLD))],
)
def test_halves_of_a_light_are_compared_by_their_shape(
    off: tuple[float, float, float], seeds: tuple[int, ...]
):
    """Each half sets its two farthest cameras 1 m apart, not the same ones in both: the scales are aligned before the
    test. Chi-square, summed over recordings, is below its 99.9 % quantile."""
    found = [compare_calibrations(*halves(seed, off)) for seed in seeds]
    assert all(agreement.degrees == 6 * 4 - 7 for agreement in found)
    assert sum(a.chi2 for a in found) < chi2.ppf(0.999, sum(a.degrees for a in found))


def test_a_camera_of_a_light_that_moved_is_named():
    """One camera moved by 2 cm between the halves of the recording."""
    first, second = halves(21, OLD)
    cameras = second.cameras.copy()
    cameras[2, :3, 3] += 0.02 / 6 * np.array([1.0, 0.0, 0.0])  # the scale: 6 m are 1 here
    agreement = compare_calibrations(first, replace(second, cameras=cameras))
    assert not agreement.holds
    assert agreement.moved == "cam02"


@cache
def halves(seed: int, off: tuple[float, float, float]) -> list[CameraPoses]:
    """Calibrate the halves, of 6 s each, of a recording of a light."""
    scenario = WandScenario(
        cameras=4, seconds=12, rate_hz=30, sized=False, both_sides=True, wand=LIGHT, seed=seed
    )
    recorded = record_wave(scenario)
    rig = roughly(recorded.intrinsics, off, seed=seed)
    return [
        CameraPoses.of_calibration(calibrate(rig, LIGHT, half)) for half in split_halves(recorded.messages)
    ]


@pytest.mark.ci
def test_a_distance_is_compared_with_the_wand():
    """The true distance agrees within three standard deviations; one that is 2 % off causes a warning with its size."""
    arena = ring()
    messages, true = record(arena, 6.0, sigma_px=0.1), true_distance(arena, "cam0", "cam1")
    plain = calibrate(arena.intrinsics, arena.wand, messages)
    for given, warned in ((true, False), (1.02 * true, True)):
        result = calibrate(arena.intrinsics, arena.wand, messages, Distance("cam0", "cam1", given))
        compared = result.report.compared
        assert compared is not None
        assert compared.sentence().startswith("warning: ") == warned
        assert_near(result.rig, plain.rig, 1e-12, 1e-7)  # rounding
        assert compared.difference_m / given == pytest.approx(true / given - 1, abs=1e-3)


def test_faults_are_named(tmp_path: Path):
    arena = ring()
    save_rig(arena.intrinsics, tmp_path / "rig.yaml")
    (tmp_path / "wand.yaml").write_text("diameter_m: 0.1\n")
    out = ("--out", str(tmp_path / "out.yaml"), "--wand", str(tmp_path / "wand.yaml"))
    options = [
        "wand",
        "--rig",
        str(tmp_path / "rig.yaml"),
        *out,
        "--observations",
        str(tmp_path / "light.csv"),
    ]
    few = [m for m in record(ring(wand=LIGHT), 6.0, sigma_px=0.1, sized=False) if m.camera != "cam3"]
    write_observations(tmp_path / "light.csv", few)
    for words, fault in (
        ("cam0 north 3.4", "names camera 'north', which is not in the rig; it has cam0, cam1, cam2, cam3"),
        ("cam0 cam1 0", "is 0 m; it must be above 0"),
        ("cam0 cam1 nan", "is nan m; it must be above 0"),
        ("cam0 cam0 1", "names camera 'cam0' twice"),
        ("cam0 cam1 2 --distance-sigma -1", "must be 0 or more"),
        ("cam0 cam3 3", "gives no scale, because camera 'cam3'"),
    ):
        with pytest.raises(CalibrationError, match=fault):
            execute([*options, "--distance", *words.split()])
    with pytest.raises(ConfigError, match="exclude each other"):
        execute([*options, "--distance", "cam0", "cam1", "2", "--only", "cam0"])
    assert not (tmp_path / "out.yaml").exists()
    execute([*options, "--distance", "cam0", "cam1", "2"])
    places = [camera.matrix()[:3, 3] for camera in load_rig(tmp_path / "out.yaml").placed().values()]
    assert np.linalg.norm(places[0] - places[1]) == pytest.approx(2, abs=1e-6)


@pytest.mark.ci
def test_check_and_the_trials_of_a_session_use_the_distance(tmp_path: Path):
    """Both predict errors in millimetres for a light with a distance, and none without."""
    arena = ring(3, wand=LIGHT)
    messages, true = record(arena, 20.0, sigma_px=0.1, sized=False), true_distance(arena, "cam0", "cam1")
    measured = Distance("cam0", "cam1", true)
    sessions = [WandSession(rig=arena.intrinsics, wand=LIGHT, distance=d) for d in (measured, None)]
    given, missing = (compute_trial(session, messages, 1.0) for session in sessions)
    assert given.expected_mm is not None
    assert missing.expected_mm is None
    save_rig(arena.intrinsics, tmp_path / "rig.yaml")
    (tmp_path / "wand.yaml").write_text("diameter_m: 0.1\n")
    write_observations(tmp_path / "light.csv", messages)
    files = {"rig": "rig.yaml", "wand": "wand.yaml", "observations": "light.csv", "out": "out.yaml"}
    options = [word for name, file in files.items() for word in (f"--{name}", str(tmp_path / file))]
    execute(["check", *options, "--distance", "cam0", "cam1", str(true)])
    said = load_rig(tmp_path / "out.yaml").calibration["check"]
    assert said["halves"]["agree"]
    assert said["expected_mm"]["median"] > 0
    with pytest.raises(CalibrationError, match="names camera 'north'"):
        execute(["check", *options, "--distance", "cam0", "north", "2"])
