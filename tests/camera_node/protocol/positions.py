# SPDX-License-Identifier: BSD-3-Clause
"""Random relative positions for tests of their messages."""

import numpy as np

from camera_node.detection.roundels import LocatedRoundels
from camera_node.protocol.messages import RelativePositions

HEADER = {"camera": "cam0", "seq": 3, "t_ns": 1_700_000_000_000_000_000, "diameter_m": 0.1}


def random_positions(n: int, seed: int = 0) -> LocatedRoundels:
    rng = np.random.default_rng(seed)
    root, normals = rng.normal(size=(n, 3, 3)), rng.normal(size=(n, 2, 3))
    first = rng.uniform(0.5, 1, n)
    return LocatedRoundels(
        position=rng.normal((0, 0, 5), size=(n, 3)),
        cov=root @ root.mT + 1e-3 * np.eye(3),
        normals=normals / np.linalg.norm(normals, axis=2, keepdims=True),
        probability=np.stack([first, 1 - first], axis=1),
        normal_sigma=rng.uniform(0, 1, (n, 2)),
        axis_distance=rng.uniform(1, 9, n),
        id=np.full(n, -1, np.int32),
        track=np.arange(n, dtype=np.int32),
    )


def pack_random(n: int, camera: str = "cam0") -> RelativePositions:
    """A message of `n` of them."""
    return RelativePositions.pack(random_positions(n), **(HEADER | {"camera": camera}))
