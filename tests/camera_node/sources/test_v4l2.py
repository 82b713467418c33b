# SPDX-License-Identifier: BSD-3-Clause
"""A V4L2 camera from the kernel's requests to frames, with a simulated driver; no camera was available.

OpenCV and the driver's own requests run unchanged in a process in which `ioctl` on one file is answered by
fake_v4l2.c, which is compiled with the kernel's header. The kernel and real drivers are not part of this test.
"""

import itertools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.waiting import DEADLINE_S

SOURCE = Path(__file__).with_name("fake_v4l2.c")
PROGRAM = """
import json, sys, time
from itertools import islice
from pathlib import Path
import msgspec
from camera_node.foundation.errors import ConfigError
from camera_node.sources.frame import SourceSettings
from camera_node.sources.v4l2_cameras import describe
from camera_node.sources.v4l2_cameras import open_v4l2

device = Path(sys.argv[1])
found = {"listed": msgspec.to_builtins(describe(device, "Fake Camera"))}
settings = SourceSettings(width=320, height=240, fourcc="GREY", exposure_us=1520, gain=8,
                          controls=("focus_automatic_continuous=false", "focus_absolute=30"))
source = open_v4l2(device, settings)
frames, before_ns = list(islice(source, 30)), time.time_ns()
found["shapes"] = [frame.image.shape for frame in frames]
found["levels"] = [int(frame.image[-1, -1]) for frame in frames]
found["ages_ms"] = [(before_ns - frame.t_ns) / 1e6 for frame in frames]
found["stamps"] = [frame.t_ns for frame in frames]
found["refused"] = []
for wanted in ({"focus_absolut": 1}, {"focus_absolute": 255}, {"focus_absolute": 7}, {"power_line_frequency": "70 Hz"}):
    try:
        source.adjust(controls=wanted)
    except ConfigError as error:
        found["refused"].append(str(error))
source.adjust(exposure_us=3000.0, controls={"power_line_frequency": "60 Hz"})
frame = next(f for f in source if f.image[0, 0] == 30)
found["exposure_us"] = frame.exposure_us
source.close()
found["after"] = {c.name: c.value for c in describe(device, "Fake Camera").controls}
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What a program with a simulated camera finds; skips where there is no compiler or no kernel header."""
    if shutil.which("cc") is None or not Path("/usr/include/linux/videodev2.h").exists():
        pytest.skip("there is no C compiler, or no header of the kernel")
    folder = tmp_path_factory.mktemp("v4l2")
    library, device = folder / "fake_v4l2.so", folder / "video0"
    build = ["cc", "-O1", "-shared", "-fPIC", str(SOURCE), "-o", str(library), "-ldl"]
    subprocess.run(build, check=True, timeout=DEADLINE_S)
    device.write_bytes(bytes(4 << 20))
    environment = {**os.environ, "LD_PRELOAD": str(library), "FAKE_V4L2": str(device)}
    command = [sys.executable, "-c", PROGRAM, str(device)]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_modes_and_controls_are_listed(found: dict):
    modes = [(mode["width"], mode["pixels"], mode["max_fps"]) for mode in found["listed"]["modes"]]
    assert modes == [(640, "GREY", 100.0), (320, "GREY", 100.0)]
    controls = {control["name"]: control for control in found["listed"]["controls"]}
    assert set(controls) == {
        *("brightness", "gain", "power_line_frequency", "auto_exposure", "exposure_time_absolute"),
        *("focus_absolute", "focus_automatic_continuous"),
    }
    focus = controls["focus_absolute"]
    assert (focus["kind"], focus["low"], focus["high"], focus["step"]) == ("integer", 0, 250, 5)
    assert controls["power_line_frequency"]["entries"] == ["Disabled", "50 Hz", "60 Hz"]
    assert controls["auto_exposure"]["value"] == "Aperture Priority Mode"


def test_frames_have_the_time_of_the_drivers_stamp(found: dict):
    """100 Hz; the stamp is the end of the exposure of 1520 us, and a frame is read soon after it."""
    assert {tuple(shape) for shape in found["shapes"]} == {(240, 320)}
    stamps = found["stamps"]
    remainders = [(later - earlier) % 10_000_000 for earlier, later in itertools.pairwise(stamps)]
    assert all(
        min(r, 10_000_000 - r) < 100_000 for r in remainders
    )  # the clocks' comparison; stamps are in us
    assert min(found["ages_ms"]) >= 0.76


def test_exposure_gain_and_controls_reach_the_driver(found: dict):
    """The exposure in units of 100 us is the grey level; automatic exposure is off, or the driver would refuse it."""
    assert set(found["levels"]) == {15}
    assert found["exposure_us"] == 3000.0
    after = found["after"]
    assert (after["gain"], after["auto_exposure"], after["exposure_time_absolute"]) == (8, "Manual Mode", 30)
    assert (after["focus_absolute"], after["focus_automatic_continuous"]) == (30, 0)
    assert after["power_line_frequency"] == "60 Hz"


def test_a_value_that_the_driver_does_not_offer_is_refused(found: dict):
    unknown, high, between, entry = found["refused"]
    assert "did you mean focus_absolute? known: auto_exposure, brightness" in unknown
    assert "focus_absolute=255: give a number from 0 to 250" in high
    assert "give 0 plus a multiple of 5" in between
    assert "give one of Disabled, 50 Hz, 60 Hz" in entry
