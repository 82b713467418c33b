# SPDX-License-Identifier: BSD-3-Clause
"""The wheel, as a stranger installs it."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROBE = """
import pathlib, sys
import camera_node._core, camera_node.node.node, calib.rig.rig, fusion._core, fusion.client.arena
here = pathlib.Path(sys.argv[1])
for module in (camera_node, camera_node._core, calib, fusion, fusion._core):
    assert here in pathlib.Path(module.__file__).parents, module.__file__
from web.demo import default_scene
assert here in default_scene().parents, default_scene()
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built where `make setup` built, so that only what changed since is compiled."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [*(sys.executable, "-m", "pip", "wheel"), "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(folder), str(ROOT)], check=True, timeout=300)
    return next(folder.glob("roundel-*.whl"))


def test_a_wheel_runs_outside_the_checkout(wheel: Path, tmp_path: Path):
    """Installed without the checkout, the native cores and the demo's configs are its own.

    `-S` keeps the editable install's import hook out; the dependencies come by PYTHONPATH, after the wheel.
    """
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    dependencies = next(path for path in sys.path if path.endswith("site-packages"))
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), dependencies])}
    probe = [sys.executable, "-S", "-c", PROBE, str(tmp_path)]
    subprocess.run(probe, check=True, timeout=60, cwd=tmp_path, env=env)


def test_a_wheel_holds_what_runs_and_nothing_else(wheel: Path):
    """The four programs, the native modules with their stubs, the configs of the demo; no C++ sources and no tests."""
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {
        "camera_node",
        "calib",
        "fusion",
        "web",
    }
    assert not [name for name in names if name.endswith((".cpp", ".hpp"))]
    assert {"camera_node/_core.pyi", "fusion/_core.pyi"} <= set(names)
    assert "web/configs/wand.yaml" in names
