# SPDX-License-Identifier: BSD-3-Clause
"""Points under the wrong camera are left out, and the cameras and their share are reported."""

import numpy as np
import pytest

from calib.wand.calibrate import calibrate
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import repack
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import STICK, camera_errors, clock_errors_ms

LIGHT = Body(diameter_m=0.05)
SHARE, FRAMES = 0.2, 240


def waved(cameras: int, wand: Body, free_running: bool) -> SimulatedRecording:
    """Record for ten seconds, without other faults; clocks of free-running cameras differ by 20 ms."""
    return record(
        WandScenario(
            cameras=cameras,
            wand=wand,
            free_running=free_running,
            offset_ms=20.0 * free_running,
            seconds=FRAMES / 24,
            rate_hz=24,
            sigma_px=0.3,
            outliers=0.0,
            missing=0.03,
            arc=0.5,
            drift_ppm=0.0,
            numbered=True,
            sized=False,
            both_sides=True,
        )
    )


def exchange(messages: list[Detections], rotate: bool) -> list[Detections]:
    """In 20 % of the frames, swap the points of the first two cameras, or give each camera those of the next one."""
    rng, changed = np.random.default_rng(4), []
    frames: dict[int, list[Detections]] = {}
    for message in sorted(messages, key=lambda m: m.camera):
        frames.setdefault(message.seq, []).append(message)
    for _, row in sorted(frames.items()):
        points = [message.unpack() for message in row]
        if rng.random() < SHARE:
            first = 2 if not rotate else len(points)
            points = points[1:first] + points[:1] + points[first:]
        changed += [repack(message, seen) for message, seen in zip(row, points, strict=True)]
    return sorted(changed, key=lambda m: m.t_ns)


CASES = {
    "synchronous, swapped": (3, STICK, False, False),
    "synchronous, rotated": (4, LIGHT, False, True),
    "free-running, swapped": (4, STICK, True, False),
    "free-running, rotated": (4, STICK, True, True),
}
MARKS = {
    "synchronous, swapped": [pytest.mark.slow],
    "synchronous, rotated": [
        pytest.mark.ci
    ],  # with the other one: both wands, both kinds of clocks and of exchanges
    "free-running, rotated": [pytest.mark.slow],
}


@pytest.mark.parametrize("case", [pytest.param(case, marks=MARKS.get(case, [])) for case in CASES])
def test_exchanged_points_are_named_and_left_out(case: str):
    """Shares are those of a binomial distribution, and of the free-running cameras' points at least half is found: the
    rest is so near to where the own camera sees the marker that it cannot be attributed. Clocks are right to 4.5
    sigmas of their claims, but at least to 0.3 ms."""
    cameras, wand, free_running, rotate = CASES[case]
    recorded = waved(cameras, wand, free_running)
    result = calibrate(recorded.intrinsics, wand, exchange(recorded.messages, rotate))
    found = {(e.shown, e.of): e.share for e in result.report.exchanges}
    names, exchanged = sorted(recorded.truth.cameras), cameras if rotate else 2
    assert set(found) == {(names[k], names[(k + 1) % exchanged]) for k in range(exchanged)}
    low = SHARE / 2 if free_running else SHARE - 4 * np.sqrt(SHARE * (1 - SHARE) / FRAMES)
    assert min(found.values()) > low
    assert max(found.values()) < SHARE + 4 * np.sqrt(SHARE * (1 - SHARE) / FRAMES)
    assert len(result.names) == cameras
    assert result.jump is None
    if free_running:
        off_ms = np.abs(clock_errors_ms(result, recorded.truth))
        assert (off_ms < np.maximum(4.5 * result.time_sigma_ms, 0.3)).all()
    if wand is STICK:
        assert camera_errors(result.rig, recorded.truth)[0].max() < 0.005


@pytest.mark.ci
@pytest.mark.parametrize("free_running", [pytest.param(False, marks=pytest.mark.slow), True])
def test_other_outliers_are_no_exchanged_points(free_running: bool):
    """A tenth of the points is anywhere in the image: by chance, none of the pairs reaches 2 %."""
    recorded, rng = waved(4, STICK, free_running), np.random.default_rng(1)
    messages = []
    for message in recorded.messages:
        seen = message.unpack()
        wrong = rng.random(len(seen)) < 0.1
        seen.uv[wrong] = rng.uniform(0, [message.width, message.height], (int(wrong.sum()), 2))
        messages.append(repack(message, seen))
    assert calibrate(recorded.intrinsics, STICK, messages).report.exchanges == []
