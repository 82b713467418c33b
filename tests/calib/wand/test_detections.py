# SPDX-License-Identifier: BSD-3-Clause
"""Timestamps: frames with a larger clock error have less weight and do not disturb the rig."""

import math

import msgspec
import numpy as np
import pytest

from calib.wand.calibrate import calibrate
from calib.wand.detections import MAX_CLOCK_ERROR_S, stamp_sigmas
from camera_node.protocol.messages import Detections
from tests.calib.recordings import EPOCH_S, WandScenario, record
from tests.calib.synthetic import camera_errors

USUAL_US = 200.0


def delay(messages: list[Detections], seconds: int, bound_ms: float, seed: int) -> list[Detections]:
    """Return messages as from nodes that have just started: in the first seconds, the clock error of each camera is
    uniform within the bound that it reports, and changes every second."""
    rng, off_ms = np.random.default_rng([5, seed]), {}
    changed = []
    for message in messages:
        second = int(message.t_ns * 1e-9 - EPOCH_S + 1)
        off, bound_us = 0.0, USUAL_US
        if second < seconds:
            off = off_ms.setdefault((message.camera, second), rng.uniform(-bound_ms, bound_ms))
            bound_us = 1e3 * bound_ms
        t_ns = message.t_ns + round(1e6 * off)
        changed.append(msgspec.structs.replace(message, t_ns=t_ns, clock_error_us=bound_us))
    return changed


@pytest.mark.ci
@pytest.mark.parametrize("seconds", [6, 12])
def test_frames_with_uncertain_timestamps_do_not_disturb_the_rig(seconds: int):
    """A quarter, or most, of the timestamps is wrong by up to 15 ms, and all cameras are placed, within four reported
    standard deviations. Without the weights, 15 ms at 1 m/s are errors of up to 15 mm; and no camera moved where a
    node's clock is set."""
    scenario = WandScenario(cameras=5, seconds=20, rate_hz=20, seed=5)
    recording = record(scenario)
    messages = delay(recording.messages, seconds, 15.0, scenario.seed)
    result = calibrate(recording.intrinsics, scenario.wand, messages)
    assert result.jump is None
    assert not result.report.unplaced
    off_mm = 1e3 * camera_errors(result.rig, recording.truth)[0]
    assert (off_mm < 4 * np.array([camera.sigma_mm for camera in result.report.cameras])).all()


def test_the_smallest_bound_of_a_camera_belongs_to_its_offset():
    """The excess of a larger bound is the half width of a uniform distribution; no bound is the largest one."""
    camera = np.array([0, 0, 0, 1, 1])
    sigma = stamp_sigmas(camera, np.array([2e-4, 5e-4, math.nan, 9e-3, 9e-3]))
    assert np.allclose(sigma, np.array([0.0, 3e-4, MAX_CLOCK_ERROR_S - 2e-4, 0.0, 0.0]) / math.sqrt(3))
