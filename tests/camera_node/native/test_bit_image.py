# SPDX-License-Identifier: BSD-3-Clause
"""The module with vector instructions and a build without them compute the same results to the last bit."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from camera_node import _core
from tests.benchmarks.detector.pictures import Card, render
from tests.camera_node.tracing import expose
from tests.conftest import ROOT
from tests.native import build

NATIVE = ROOT / "camera_node" / "native"
CPU = Path("/proc/cpuinfo")


def has_ifuncs(binary: Path | str) -> bool:
    """Whether a binary has functions whose variant the loader chooses."""
    done = subprocess.run(["readelf", "-rW", binary], capture_output=True, text=True, check=True, timeout=60)
    return "IRELATIV" in done.stdout


def frames() -> list[np.ndarray]:
    """Roundels of 9 to 60 px at 0 to 60 degrees, complete, overexposed or cut by the border, and a moving one; two
    frames each."""
    rng, made = np.random.default_rng(9), []
    for diameter in (9, 12, 16, 21, 34, 60):
        for tilt in (0.0, 0.6, 1.05):
            discs = [Card((80.2, 60.7), diameter, tilt, tilt), Card((4.0, 100.0), 20, 0.2)]
            clean = render(discs, bright=rng.choice([150, 190, 262]), ground=rng.choice([60, 120, 190]))
            made += [expose(clean, 3, rng) for _ in range(2)]
    moving = np.mean([render([Card((60.2 + t, 50.7), 32)]) for t in range(-10, 11)], axis=0)
    return [*made, *(expose(moving, 3, rng) for _ in range(2))]


def table(columns: "_core.FrameColumns") -> np.ndarray:
    """(N, 59) all columns side by side, as scalar.cpp prints them."""
    names = ("uv", "axes_px", "angle_rad", "ratio", "contrast", "offset_px", "pose_cov", "track")
    arrays = [np.asarray(columns[name], float) for name in names]
    return np.hstack([array.reshape(len(array), int(np.prod(array.shape[1:]))) for array in arrays])


@pytest.mark.slow  # compiles the library twice
@pytest.mark.skipif(
    not CPU.exists() or " avx2 " not in CPU.read_text(), reason="this machine has one variant only"
)
def test_builds_with_and_without_vectors_agree_to_the_last_bit(tmp_path: Path):
    scalar = build(NATIVE, Path(__file__).with_name("scalar.cpp"), tmp_path)
    images = frames()
    assert has_ifuncs(_core.__file__)
    assert not has_ifuncs(scalar)
    fed = b"".join(b"%d %d\n" % image.shape[::-1] + image.tobytes() for image in images)
    done = subprocess.run([scalar], input=fed, capture_output=True, check=True, timeout=60)
    without = [[float.fromhex(word) for word in line.split()] for line in done.stdout.decode().splitlines()]
    detector = _core.Detector(_core.RoundelLimits([0.6, 0.41], 0.08, 8, 400, 25), 1, False)
    with_vectors = np.vstack([table(detector.detect(image)) for image in images])
    assert len(with_vectors) > len(images) / 2
    assert np.array_equal(with_vectors, np.array(without))
