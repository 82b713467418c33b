# SPDX-License-Identifier: BSD-3-Clause
"""What `import roundel` gives, on a machine with and without the packages of the server."""

import ast
import subprocess
import sys

import pytest

import roundel
from tests.conftest import ROOT

HEAVY = ("numpy", "cv2", "zenoh", "gtsam", "scipy", "viser", "mcap")
SERVER_PACKAGES = ("gtsam", "scipy", "viser", "mcap", "psutil", "reportlab", "websockets")
LIGHT = ("Arena", "Detector", "Rig", "Robots", "RoundelError")
CONTRACT = {"Arena", "Detector", "Rig", "Robots", "Recording", "track", "simulate"} | {
    "calibrate_intrinsics",
    "calibrate_wand",
}


def run_python(code: str) -> str:
    """What a new interpreter prints."""
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True
    ).stdout.strip()


def test_the_import_loads_nothing_else():
    code = f"import sys, roundel; dir(roundel); print([name for name in {HEAVY} if name in sys.modules])"
    assert run_python(code) == "[]"


def test_the_public_names():
    """All of them are listed, and have a docstring; another name is an ordinary error of Python."""
    assert set(roundel.__all__) >= CONTRACT
    assert set(dir(roundel)) >= set(roundel.__all__)
    assert all(getattr(roundel, name).__doc__ for name in roundel.__all__)
    with pytest.raises(AttributeError, match="wander"):
        _ = roundel.wander  # type: ignore[attr-defined]
    with pytest.raises(ImportError, match="wander"):
        exec("from roundel import wander")


def test_type_checkers_see_what_python_imports():
    """The names under TYPE_CHECKING come from the modules that are imported when a name is used."""
    tree = ast.parse((ROOT / "roundel" / "__init__.py").read_text())
    (guarded,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {
        alias.name: node.module
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == roundel._MODULES
    assert set(seen) == set(roundel.__all__)
    assert (ROOT / "roundel" / "py.typed").exists()


def test_a_machine_without_the_server_extra():
    """It has the names that a camera or a client needs; the others say what to install."""
    code = (
        f"import sys; sys.modules |= dict.fromkeys({SERVER_PACKAGES}); import roundel\n"
        f"light = [getattr(roundel, name) for name in {LIGHT}]\n"
        f"for name in sorted({CONTRACT} - {set(LIGHT)}):\n"
        "    try:\n"
        "        exec(f'from roundel import {name}')\n"
        "    except roundel.RoundelError as error:\n"
        "        print(name, type(error).__name__, error)\n"
    )
    lines = run_python(code).splitlines()
    assert {line.split()[0] for line in lines} == CONTRACT - set(LIGHT)
    assert all(
        " ConfigError " in line and line.endswith("; pip install 'roundel[server]'") for line in lines
    ), lines
