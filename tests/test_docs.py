# SPDX-License-Identifier: BSD-3-Clause
"""The documentation site builds without a warning, and each command in it runs in a test."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import tyro
import yaml

from calib.rig.rig import load_rig
from calib.wand.quality.grade import LIMITS
from camera_node.commands.camera_command import JoinArena
from tests.calib.stick import LENGTH_M, write_stick
from tests.conftest import ROOT, free_port
from tests.pages import commands, page
from tests.source_tree import name_of, python_files
from tests.waiting import wait_for
from tests.web.roundel.programs import Program, roundel, roundel_command

# The tests that run the commands of a page which are not in the README.
TESTED = {
    "benchmark.md": "tests/fusion/recordings/test_record.py",
    "recordings.md": "tests/fusion/recordings/test_recordings_page.py",
    "clients.md": "tests/examples/test_clients.py",
    "bridges.md": "tests/fusion/bridges/test_bridges_page.py",
    "security.md": "tests/security/test_security_page.py",
    "relative.md": "tests/fusion/client/test_relative.py",
    "lab.md": "tests/test_docs.py",
    "import_export.md": "tests/test_docs.py",
    "network_cameras.md": "tests/test_docs.py",
    "cameras.md": "tests/camera_node/commands/test_camera_reports.py",
    **dict.fromkeys(
        ("calibration.md", "first_arena.md", "offline.md", "troubleshooting.md"), "tests/test_readme.py"
    ),
    "design/detector_seen_refused.md": "tests/test_docs.py",
}
PAGES = sorted(path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md"))
# They change the machine, or need a container engine; tests/test_lab.py checks the services.
NOT_RUN = (
    "useradd ",
    "cp configs/systemd",
    "install -D configs/systemd",
    "systemctl ",
    "pipx run cibuildwheel",
    "uv tool install ",
    "podman ",
)
BUILD = ("cargo ", "cmake ", "build/")  # of the example clients
PIP = (
    "python3 -m venv ",
    "/opt/roundel/bin/pip ",
    "pip wheel ",
    "uv tool install ",
)  # tests/test_packaging.py


def test_every_command_of_every_page_is_tested():
    """A page with commands of its own needs an entry in `TESTED`, and all commands are of `roundel` or of a shell."""
    readme = commands((ROOT / "README.md").read_text())
    own = {name: set(page(name)) - set(readme) for name in PAGES}
    assert {name for name, lines in own.items() if lines} == set(TESTED)
    shell = (*NOT_RUN, *PIP, *BUILD, "sh configs/", "cp configs/", "sed -i ")
    odd = [line for lines in own.values() for line in lines if not line.startswith(("roundel ", *shell))]
    assert odd == []
    assert all((ROOT / test).exists() for test in TESTED.values())


def test_no_page_has_commands_of_developers():
    """Users have the command `roundel`; only benchmarks are modules."""
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        found = re.findall(r"python -m (?:camera_node|calib|fusion|web)\b(?! \|)", path.read_text())
        assert not found, path.name


def test_import_and_export(tmp_path: Path):
    """The commands of the page, with a stick whose ends were clicked in Argus."""
    write_stick(tmp_path, "argus", "wand-xypts.csv")
    (tmp_path / "wand.yaml").write_text(f"markers: [[0, 0, 0], [{LENGTH_M}, 0, 0]]")
    for command in page("import_export.md"):
        roundel(*shlex.split(command)[1:], folder=tmp_path)
    assert len(load_rig(tmp_path / "rig.yaml").placed()) == 3
    assert {path.name for path in (tmp_path / "colmap").iterdir()} >= {"cameras.txt", "images.txt"}


def test_what_the_detector_refuses(tmp_path: Path):
    shutil.copy(ROOT / "docs" / "detector_seen_refused.png", tmp_path / "picture.png")
    (command,) = page("design/detector_seen_refused.md")
    assert "refused" in roundel(*shlex.split(command)[1:], folder=tmp_path)
    assert (tmp_path / "seen.png").exists()


def test_a_network_camera():
    """Its options exist; tests/camera_node/sources/test_network_stream.py reads streams."""
    (command,) = page("network_cameras.md")
    camera = tyro.cli(JoinArena, args=shlex.split(command)[2:])
    assert (camera.source[0].partition(":")[0], camera.name) == ("rtsp", "north")


@pytest.fixture
def zones(tmp_path: Path, endpoint: str) -> Iterator[tuple[Path, str]]:
    """The two servers of the page, on reserved ports."""
    text = (ROOT / "docs" / "lab.md").read_text()
    (arena,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    east = f"tcp/127.0.0.1:{free_port()}"
    arena = arena.replace("tcp/west.local:7447", endpoint).replace("tcp/east.local:7447", east)
    (tmp_path / "arena.yaml").write_text(arena.replace("arena: hall", "arena: arena"))
    shutil.copy(ROOT / "configs" / "robots.yaml", tmp_path)
    servers = [
        Program(roundel_command(*shlex.split(line)[1:]), tmp_path)
        for line in page("lab.md")
        if "--zone" in line
    ]
    try:
        for server in servers:
            server.until("INFO fusion")
        yield tmp_path, endpoint
    finally:
        assert [server.stop() for server in servers] == [0, 0]


@pytest.mark.ci
def test_a_lab(zones: tuple[Path, str]):
    """Health and doctor report that the cameras are missing; the bridge of another machine connects to both routers."""
    folder, endpoint = zones
    for line in page("lab.md"):
        words = shlex.split(line, comments=True)[1:]
        if line.startswith(("roundel health", "roundel doctor")):
            connect = () if "doctor" in line else ("--connect", endpoint)
            assert "camera" in roundel(*words, *connect, folder=folder, expected=1)
        elif line.startswith("roundel ros2 --connect"):
            words = [re.sub("tcp/(server|localhost):7447", endpoint, word) for word in words]
            bridge = Program(roundel_command(*words), folder)
            wait_for(lambda bridge=bridge: bridge.lines)
            assert bridge.process.poll() is None, bridge.text
            assert bridge.stop() == 0


@pytest.mark.ci
def test_the_site_builds_in_strict_mode(tmp_path: Path):
    """Every link and anchor between pages exists, and every page is in the navigation."""
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=ROOT, env=env, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    assert "not included" not in done.stderr, done.stderr
    assert (tmp_path / "first_arena.html").exists()


def test_the_calibration_page_has_the_limits_of_every_figure():
    """In a row of its table, in pixels or percent."""
    rows = re.findall(
        r"^\| [^|]+ \|((?: [0-9.]+ (?:px|%) \|){3})", (ROOT / "docs" / "calibration.md").read_text(), re.M
    )
    stated = {tuple(float(x) for x in re.findall(r"[0-9.]+", row)) for row in rows}
    shown = {
        tuple((1 if name.endswith("px") else 100) * x for x in limits) for name, limits in LIMITS.items()
    }
    assert sum(sorted(stated), ()) == pytest.approx(sum(sorted(shown), ()))


@pytest.mark.slow
def test_the_accuracy_page_has_the_table_of_its_script():
    script = [sys.executable, str(ROOT / "docs" / "accuracy_table.py")]
    done = subprocess.run(script, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout in (ROOT / "docs" / "accuracy.md").read_text()


def test_every_page_is_reached_from_the_overview():
    """By a link of the navigation in mkdocs.yml."""
    navigation = (ROOT / "mkdocs.yml").read_text()
    assert yaml.safe_load(navigation)["strict"] is True
    missing = [name for name in PAGES if f": {name}\n" not in navigation]
    assert missing == []


SOURCE_LINK = re.compile(r"\[`(\w+)`\]\(((?:\.\./)*[\w/]+\.(?:py|cpp|hpp))\)")
DEFINES = r"(?:def|class) {0}\b|\b{0}\([^;]*$"  # in Python; in C++


def test_an_idea_is_three_clicks_from_its_line():
    """README -> architecture -> the file, which defines the function that the link names."""
    architecture = ROOT / "docs" / "design" / "architecture.md"
    assert "](docs/design/architecture.md)" in (ROOT / "README.md").read_text()
    links = SOURCE_LINK.findall(architecture.read_text())
    assert {"distances_by_principal_axis", "find_candidates", "reprojection_errors"} <= {
        name for name, _ in links
    }
    for name, link in links:
        path = architecture.parent / link
        assert path.exists(), f"architecture.md links to {link}, which is not there"
        assert re.search(DEFINES.format(name), path.read_text(), re.MULTILINE), (
            f"{link} does not define {name}"
        )


@pytest.mark.parametrize(
    "page_path",
    ["CONVENTIONS.md", "DECISIONS.md", *(f"docs/{page}" for page in PAGES if page.startswith("design/"))],
)
def test_a_page_names_files_that_exist(page_path: str):
    """Files may be named without their first folders."""
    folders = ("calib", "camera_node", "examples", "fusion", "roundel", "tests", "web")
    known = [
        f"/{path.relative_to(ROOT).as_posix()}" for name in folders for path in (ROOT / name).rglob("*.*pp")
    ]
    known += [f"/{name_of(path)}" for path in python_files(*folders)]
    text = (ROOT / page_path).read_text()
    named = set(re.findall(r"`([\w/]+\.(?:py|cpp|hpp))`", text))
    assert [name for name in sorted(named) if not any(path.endswith(f"/{name}") for path in known)] == []
    packages = set(re.findall(rf"`((?:{'|'.join(folders)})/[\w/]+)`", text))
    assert [name for name in sorted(packages) if not (ROOT / name).exists()] == []
    modules = set(re.findall(r"`([a-z]+/[a-z_]+)`", text)) - packages if "/design/" in page_path else set()
    stems = {path.rpartition(".")[0] for path in known}
    assert [name for name in sorted(modules) if not any(path.endswith(f"/{name}") for path in stems)] == []


def test_decisions_are_few_and_have_an_index():
    """The site's check of anchors tests the links of the index. What refers to a decision names one that exists."""
    text = (ROOT / "DECISIONS.md").read_text()
    entries = re.findall(r"^### (\d+)\. (.+)$", text, re.MULTILINE)
    assert [int(number) for number, _ in entries] == list(range(1, len(entries) + 1))
    assert len(entries) <= 60
    assert [title for number, title in entries if f"[{number}. {title}](#" not in text] == []
    folders = ("calib", "camera_node", "docs", "fusion", "roundel", "tests", "web")
    files = [*python_files(*folders), *(ROOT / "docs").rglob("*.md")]
    named = {int(n) for path in files for n in re.findall(r"DECISIONS (\d+)", path.read_text())}
    assert named <= {int(number) for number, _ in entries}
