# SPDX-License-Identifier: BSD-3-Clause
"""Every machine sees the same: the module with its vectors, and a build without them, agree to the last bit."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from camera_node import _core
from tests.camera_node.rendering import Disc, expose, render
from tests.conftest import ROOT
from tests.native import build

NATIVE = ROOT / "camera_node" / "native"
CPU = Path("/proc/cpuinfo")


def chooses_when_loaded(binary: Path | str) -> bool:
    """Whether a binary has functions of which the processor decides the variant (ifuncs)."""
    done = subprocess.run(["readelf", "-rW", binary], capture_output=True, text=True, check=True, timeout=60)
    return "IRELATIV" in done.stdout


def frames() -> list[np.ndarray]:
    """Roundels of 9 to 60 px, frontal to 60 degrees, whole, clipped and cut by the border, and one that moves; two
    frames each."""
    rng, made = np.random.default_rng(9), []
    for diameter in (9, 12, 16, 21, 34, 60):
        for tilt in (0.0, 0.6, 1.05):
            discs = [Disc((80.2, 60.7), diameter, tilt, tilt), Disc((4.0, 100.0), 20, 0.2)]
            clean = render(discs, bright=rng.choice([150, 190, 262]), ground=rng.choice([60, 120, 190]))
            made += [expose(clean, 3, rng) for _ in range(2)]
    moving = np.mean([render([Disc((60.2 + t, 50.7), 32)]) for t in range(-10, 11)], axis=0)
    return [*made, *(expose(moving, 3, rng) for _ in range(2))]


@pytest.mark.skipif(
    not CPU.exists() or " avx2 " not in CPU.read_text(), reason="this machine has one variant only"
)
def test_vectors_and_none_agree_to_the_last_bit(tmp_path: Path):
    scalar = build(NATIVE, Path(__file__).with_name("scalar.cpp"), tmp_path)
    images = frames()
    assert chooses_when_loaded(_core.__file__)
    assert not chooses_when_loaded(scalar)
    fed = b"".join(b"%d %d\n" % image.shape[::-1] + image.tobytes() for image in images)
    done = subprocess.run([scalar], input=fed, capture_output=True, check=True, timeout=60)
    without = [[float.fromhex(word) for word in line.split()] for line in done.stdout.decode().splitlines()]
    detector = _core.Detector([0.6, 0.41], 0.08, 8, 400, 25, 1, False)
    with_vectors = np.vstack([detector.detect(image) for image in images])
    assert len(with_vectors) > len(images) / 2
    assert np.array_equal(with_vectors, np.array(without))
