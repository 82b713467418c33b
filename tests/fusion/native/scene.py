# SPDX-License-Identifier: BSD-3-Clause
"""Bodies and detections of some cameras that have nothing to do with each other: for equations, not for tracking."""

import numpy as np

from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import rotation_from_vector
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray, DetectionTable, Discs, MatchedObservations
from fusion.model.states import States
from tests.fusion.synthetic import ring

CAMERAS = ring()
ARRAY = CameraArray(CAMERAS)
BODIES, EACH = 7, 60


def scene(seed: int = 2) -> tuple[States, MatchedObservations]:
    """Rotating bodies near the centre, and unrelated detections; one body is not visible."""
    random = np.random.default_rng(seed)
    n = len(CAMERAS) * EACH
    states = States(
        rotation_from_vector(random.normal(size=(BODIES, 3))),
        random.uniform(-0.8, 0.8, (BODIES, 3)),
        random.normal(size=(BODIES, 3)),
        random.normal(size=(BODIES, 3)),
        np.tile(np.eye(12), (BODIES, 1, 1)),
    )
    states.p[0] = 2 * ARRAY.centres[0]  # behind a camera
    frames = [frame(name, random) for name in CAMERAS]
    discs = Discs(
        frame=np.repeat(np.arange(len(frames)), EACH),
        body=random.integers(0, BODIES, n),
        marker=np.arange(n),
        position=random.uniform(-0.2, 0.2, (3, n)),
        normal=unit_vectors(n, np.random.default_rng(seed + 1)),
        radius=random.uniform(0.02, 0.1, n),
    )
    return states, MatchedObservations.of_discs(DetectionTable.of(FrameSet(0, tuple(frames)), ARRAY), discs)


def unit_vectors(n: int, random: np.random.Generator) -> np.ndarray:
    """(3, n) random directions."""
    v = random.normal(size=(3, n))
    return v / np.linalg.norm(v, axis=0)


def frame(name: str, random: np.random.Generator) -> CalibratedFrame:
    """A frame up to 20 ms from the time of the frame set."""
    root = random.normal(size=(EACH, 2, 2))
    axes = np.sort(random.uniform(10, 30, (EACH, 2)))[:, ::-1]
    none, level = np.full(EACH, -1, np.int32), np.ones(EACH)
    uv, angle = random.uniform(100, 500, (EACH, 2)), random.uniform(-1.5, 1.5, EACH)
    roundels = Roundels(uv, root @ root.transpose(0, 2, 1), axes, angle, level, level, none, none)
    return CalibratedFrame.measure(
        name, int(random.integers(-20_000_000, 20_000_000)), roundels, CAMERAS[name]
    )
