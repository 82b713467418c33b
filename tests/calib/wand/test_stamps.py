# SPDX-License-Identifier: BSD-3-Clause
"""Frames whose stamps are unsure, and say so, weigh less; they do not move the rig."""

import math

import msgspec
import numpy as np

from calib.wand.calibrate import calibrate
from calib.wand.detections import UNKNOWN_S, stamp_sigmas
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import camera_errors
from tests.calib.wave import EPOCH_S, Wave, record

USUAL_US = 200.0


def unsure(messages: list[Detections], seconds: int, bound_ms: float, seed: int) -> list[Detections]:
    """Messages of nodes that have just started: for some seconds each camera's clock is off by anything within the
    bound that it tells, another by the second."""
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


def test_frames_with_unsure_stamps_do_not_move_the_rig():
    """A quarter of a wave is stamped wrong by up to 15 ms. Cameras stay within four of the standard deviations that
    are told of them, as they do without these frames; taken as sure they were 25 to 100 mm off."""
    wave = Wave(cameras=5, seconds=20, rate_hz=30, seed=5)
    recorded = record(wave)
    result = calibrate(recorded.intrinsics, wave.wand, unsure(recorded.messages, 6, 15.0, wave.seed))
    assert result.jump is None
    off_mm = 1e3 * camera_errors(result.rig, recorded.truth)[0]
    assert (off_mm < 4 * np.array([camera.sigma_mm for camera in result.report.cameras])).all()


def test_what_all_stamps_of_a_camera_share_is_its_offset():
    """The least bound of a camera counts for nothing, another with the deviation of what is anywhere in the rest."""
    camera = np.array([0, 0, 0, 1, 1])
    told = stamp_sigmas(camera, np.array([2e-4, 5e-4, math.nan, 9e-3, 9e-3]))
    assert np.allclose(told, np.array([0.0, 3e-4, UNKNOWN_S - 2e-4, 0.0, 0.0]) / math.sqrt(3))
