# SPDX-License-Identifier: BSD-3-Clause
"""The wheel works outside of the checkout and contains the right files."""

import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from itertools import islice
from pathlib import Path

import pytest

from camera_node import _core
from tests.conftest import ROOT

PROBE = """
import pathlib, sys
import camera_node._core, camera_node.node.node, calib.rig.rig, fusion._core, roundel
from roundel import Arena, Detector, track
here = pathlib.Path(sys.argv[1])
for module in (camera_node, camera_node._core, calib, fusion, fusion._core, roundel):
    assert here in pathlib.Path(module.__file__).parents, module.__file__
from camera_node.foundation.config import example_file
assert here in example_file("demo/scene.yaml").parents
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built in the folder of `make setup`, so that only changed files are compiled."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [*(sys.executable, "-m", "pip", "wheel"), "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(folder), str(ROOT)], check=True, timeout=900)
    return next(folder.glob("roundel-*.whl"))


@pytest.mark.ci
def test_a_wheel_runs_outside_the_checkout(wheel: Path, tmp_path: Path):
    """The native modules and the demo's configs come from the wheel, not from the checkout.

    `-S` disables the import hook of the editable install; PYTHONPATH has the wheel first, then the dependencies.
    """
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    dependencies = next(path for path in sys.path if path.endswith("site-packages"))
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), dependencies])}
    probe = [sys.executable, "-S", "-c", PROBE, str(tmp_path)]
    subprocess.run(probe, check=True, timeout=60, cwd=tmp_path, env=env)
    # `roundel` and the programs that it starts work in the checkout too, where the sources have no native modules.
    command = [*probe[:2], "-P", "-c", "from web.roundel.command import main; main()"]
    picture = [*command, "detect", str(ROOT / "docs" / "detector_seen_refused.png")]
    subprocess.run(picture, check=True, timeout=60, cwd=ROOT, env=env, stdout=subprocess.DEVNULL)
    child = [sys.executable, "-S", "-m", "camera_node", "detect", "--help"]
    env["PYTHONSAFEPATH"] = "1"  # as `roundel` sets it
    subprocess.run(child, check=True, timeout=60, cwd=ROOT, env=env, stdout=subprocess.DEVNULL)


def test_a_wheel_contains_the_programs_only(wheel: Path):
    """With native modules, their stubs and the demo's configs; without C++ sources and tests."""
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {
        "camera_node",
        "calib",
        "fusion",
        "web",
        "roundel",
    }
    assert not [name for name in names if name.endswith((".cpp", ".hpp"))]
    assert {"camera_node/_core.pyi", "fusion/_core.pyi"} <= set(names)
    assert {"roundel/__init__.py", "roundel/py.typed"} <= set(names)
    assert "camera_node/configs/wand.yaml" in names


def test_the_native_module_computes():
    """A disc of 0.14 m whose major axis is 0.028 in the normalised image plane has a distance of 5 m."""
    assert abs(_core.distance_by_principal_axis(0.14, 0.028) - 5.0) < 1e-12


ABSENT_SERVER = "tcp/127.0.0.1:9"
ALONE = {
    "mavlink": ("fusion mavlink rover --to udp:127.0.0.1:9 --connect", "none answers at tcp/127.0.0.1:9"),
    "foxglove": ("fusion foxglove --port 0 --connect", "Foxglove at ws://127.0.0.1:"),
    "streams": (
        "camera_node --source rtsp://127.0.0.1:9/live --name north --connect",
        "rtsp://127.0.0.1:9/live",
    ),
}


def import_names(requirements: list[str]) -> set[str]:
    """The top-level modules of required distributions that are installed."""
    wanted = {re.split(r"[^A-Za-z0-9_.-]", text)[0].lower() for text in requirements}
    found = importlib.metadata.packages_distributions().items()
    return {name for name, owners in found if wanted & {owner.lower() for owner in owners}}


@pytest.mark.slow
@pytest.mark.parametrize("extra", ALONE)
def test_each_extra_works_without_the_packages_of_the_others(extra: str):
    """The program starts: it says what it serves, or that its server or camera does not answer."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    others = import_names([text for name, texts in extras.items() if name != extra for text in texts])
    absent = others - import_names([*project["dependencies"], *extras[extra]])
    assert {"gtsam", "scipy", "viser", "mcap"} <= absent
    line, expected = ALONE[extra]
    program, *words = [*line.split(), ABSENT_SERVER]
    code = (
        f"import sys; sys.modules |= dict.fromkeys({sorted(absent)}); "
        f"from {program}.__main__ import main; main()"
    )
    command = [sys.executable, "-c", code, *words]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        try:
            said = next((line for line in islice(process.stdout, 4) if expected in line), "")
        finally:
            process.kill()
    assert said
    assert "pip install" not in said


def test_constraints_fix_one_version_of_each_requirement_and_name_no_address():
    """But of picamera2, which the camera's system has; `make constraints` writes the file."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = content["project"]
    lists = (
        content["build-system"]["requires"],
        project["dependencies"],
        *project["optional-dependencies"].values(),
    )
    requirements = {re.split(r"[\[><=;]", word)[0] for words in lists for word in words} - {
        "roundel",
        "picamera2",
    }
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pinned = [re.fullmatch(r"([a-z0-9-]+)==[\w.]+(?: ; [\w.'<>= ]+)?", line) for line in lines]
    assert all(pinned), [line for line, match in zip(lines, pinned, strict=True) if not match]
    names = {match[1] for match in pinned if match}
    assert requirements <= names, requirements - names
