# SPDX-License-Identifier: BSD-3-Clause
"""The distance of two cameras: the scale of a wand of one marker, and a check of all others."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from calib.__main__ import execute
from calib.commands.check import placed, split
from calib.errors import CalibrationError
from calib.live.wand_session import WandSession, compute_trial
from calib.rig.rig import load_rig, save_rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.agreement import Agreement
from calib.wand.quality.agreement import compare as compare_rigs
from calib.wand.scale import Distance, compare
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.sources.observations import write_observations
from tests.calib.synthetic import EXACT, OLD, Arena, assert_near, record, ring, roughly
from tests.calib.wave import Wave
from tests.calib.wave import record as record_wave

LIGHT = Body(diameter_m=0.1)


def apart(arena: Arena, a: str, b: str) -> float:
    first, second = (arena.truth.cameras[name].matrix()[:3, 3] for name in (a, b))
    return float(np.linalg.norm(first - second))


def test_a_light_and_a_distance_give_metres_as_well_as_is_known():
    """0.1 px at 2.6 m, f = 520 px, is 0.5 mm across a ray, over the root of some hundred moments: 2 mm is far beyond.
    The distance's own deviation comes on top: of any two cameras' distance it is the same part."""
    arena = ring(wand=LIGHT)
    messages = record(arena, 20.0, sigma_px=0.1, sized=False)
    true = apart(arena, "cam0", "cam2")
    exact, rough = (
        calibrate(arena.intrinsics, LIGHT, messages, Distance("cam0", "cam2", true, sigma))
        for sigma in (0.0, 0.02)
    )
    assert exact.report.metric
    assert_near(exact.rig, arena.truth, 2e-3, 1e-3)
    for a, b in combinations(exact.names, 2):
        wanted = Distance(a, b, apart(arena, a, b), 0.0)
        sure, loose = (compare(wanted, told.names, told.adjusted) for told in (exact, rough))
        assert sure is not None
        assert loose is not None
        added = np.sqrt(loose.sigma_m**2 - sure.sigma_m**2)
        assert added == pytest.approx(0.02 * sure.by_wand_m / true, rel=1e-3)
    assert rough.report.as_dict()["distance"]["metres"] == true
    sized = record(arena, 12.0, sigma_px=0.1)  # a roundel's size, a tenth off, gives way
    wrong = Body(diameter_m=0.11)
    by_tape = calibrate(arena.intrinsics, wrong, sized, Distance("cam0", "cam2", true))
    assert_near(by_tape.rig, arena.truth, 5e-3, 2e-3)


@pytest.mark.parametrize("off", [EXACT, OLD])
def test_halves_of_a_light_are_compared_by_their_shape(off: tuple[float, float, float]):
    """Each half sets its two farthest cameras 1 m apart, and these are not the same ones in both; and a distance that
    is exact changes, by the square of a turn, by more than its own deviation: it told 10^4 times too large a
    difference. Chi-square, summed over waves, lies below its 99.9 % quantile."""
    found = [shape_apart(seed, off) for seed in (20, 21, 23)]
    assert all(told.degrees == 6 * 4 - 7 for told in found)
    assert sum(told.chi2 for told in found) < chi2.ppf(0.999, sum(told.degrees for told in found))


def test_halves_of_a_light_that_differ_in_shape_are_told():
    """A camera that was moved by 2 cm between the halves of its wave."""
    wave = Wave(cameras=4, seconds=12, rate_hz=30, sized=False, both_sides=True, wand=LIGHT, seed=21)
    recorded = record_wave(wave)
    first, second = (calibrate(recorded.intrinsics, LIGHT, half) for half in split(recorded.messages))
    moved = placed(second)
    moved.cameras[2, :3, 3] += 0.02 / 6 * np.array([1.0, 0.0, 0.0])  # of 6 m, that are 1 here
    told = compare_rigs(placed(first), moved)
    assert not told.holds
    assert told.guilty == "cam02"


def shape_apart(seed: int, off: tuple[float, float, float]) -> Agreement:
    """How the halves of 6 s differ."""
    wave = Wave(cameras=4, seconds=12, rate_hz=30, sized=False, both_sides=True, wand=LIGHT, seed=seed)
    recorded = record_wave(wave)
    rig = roughly(recorded.intrinsics, off, seed=seed)
    return compare_rigs(*(placed(calibrate(rig, LIGHT, half)) for half in split(recorded.messages)))


def test_a_wand_that_knows_metres_is_compared():
    """A true distance is within three sigmas; one that is 2 % off is told, as a part of it, with its sign."""
    arena = ring()
    messages, true = record(arena, 6.0, sigma_px=0.1), apart(arena, "cam0", "cam1")
    plain = calibrate(arena.intrinsics, arena.wand, messages)
    for given, warned in ((true, False), (1.02 * true, True)):
        result = calibrate(arena.intrinsics, arena.wand, messages, Distance("cam0", "cam1", given))
        told = result.report.compared
        assert told is not None
        assert told.sentence().startswith("warning: ") == warned
        assert_near(result.rig, plain.rig, 1e-12, 1e-7)  # what rounding leaves
        assert told.off_m / given == pytest.approx(true / given - 1, abs=1e-3)


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
        ("cam0 cam3 3", "gives no scale, as camera 'cam3' has no place"),
    ):
        with pytest.raises(CalibrationError, match=fault):
            execute([*options, "--distance", *words.split()])
    with pytest.raises(ConfigError, match="exclude each other"):
        execute([*options, "--distance", "cam0", "cam1", "2", "--only", "cam0"])
    assert not (tmp_path / "out.yaml").exists()
    execute([*options, "--distance", "cam0", "cam1", "2"])
    places = [camera.matrix()[:3, 3] for camera in load_rig(tmp_path / "out.yaml").placed().values()]
    assert np.linalg.norm(places[0] - places[1]) == pytest.approx(2, abs=1e-6)


def test_a_check_and_the_trials_of_a_live_wave_know_the_distance(tmp_path: Path):
    """By a light and a distance both foretell millimetres; without it there are none."""
    arena = ring(3, wand=LIGHT)
    messages, true = record(arena, 20.0, sigma_px=0.1, sized=False), apart(arena, "cam0", "cam1")
    told = Distance("cam0", "cam1", true)
    sessions = [WandSession(rig=arena.intrinsics, wand=LIGHT, distance=d) for d in (told, None)]
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
