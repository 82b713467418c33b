# SPDX-License-Identifier: BSD-3-Clause
"""Stationary roundels are found by place, and by number where they have one."""

import numpy as np

from calib.world.still_roundels import find_still_roundels
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections


def test_numbered_points_stay_apart_however_near_they_are():
    """1,716 points 1.5 px apart, nearer than the radius of one that stands still, ten frames with 0.1 px of noise."""
    rng = np.random.default_rng(0)
    column, row = np.divmod(np.arange(1716), 39)
    places = 100 + 1.5 * np.column_stack([column, row])
    frames = [places + 0.1 * rng.standard_normal(places.shape) for _ in range(10)]
    messages = [
        Detections.pack(
            Roundels.from_points(uv, 0.1, np.arange(1716, dtype=np.int32)),
            camera="cam0",
            seq=seq,
            t_ns=seq,
            width=640,
            height=480,
        )
        for seq, uv in enumerate(frames)
    ]
    found = {int(roundel.name): roundel.uv for roundel in find_still_roundels(messages)}
    assert sorted(found) == list(range(1716))
    assert np.abs(np.array([found[k] for k in range(1716)]) - places).max() < 0.2
