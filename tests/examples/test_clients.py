# SPDX-License-Identifier: BSD-3-Clause
"""The example clients in Rust and C++: built as a user builds them, they read what a server publishes.

The C++ client needs Zenoh's C library, which no package registry has; its decoder is tested without it.
"""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from camera_node.protocol.messages import encode
from tests.conftest import ROOT, free_port
from tests.fusion.bridges.pose_server import ARENA, PoseServer, moving_pose
from tests.pages import page
from tests.waiting import DEADLINE_S

BUILD_S = 3000.0  # Zenoh has 250 crates; on a loaded machine of two cores
EXAMPLES = ROOT / "examples"
COUNT = 3
CARGO, CONFIGURE, *BUILD_CPP = page("clients.md")
JSON = any(Path(folder, "nlohmann/json.hpp").exists() for folder in ("/usr/include", "/usr/local/include"))

pytestmark = pytest.mark.slow


def cargo(*words: str) -> subprocess.CompletedProcess[str]:
    """The command of the page with other words for the program; built in `build/rust`, once."""
    command = [*shlex.split(CARGO.partition(" -- ")[0]), "--quiet", "--", *words]
    environment = {**os.environ, "CARGO_TARGET_DIR": str(ROOT / "build" / "rust")}
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=BUILD_S, check=False
    )


@pytest.fixture(scope="module")
def built() -> None:
    if shutil.which("cargo") is None:
        pytest.skip("this machine has no cargo")
    manifest = EXAMPLES / "rust" / "Cargo.toml"
    fetch = subprocess.run(["cargo", "fetch", "--quiet", "--manifest-path", manifest], timeout=BUILD_S)
    if fetch.returncode != 0:
        pytest.skip("the crates cannot be fetched here")
    first = cargo()
    assert first.returncode == 2, first.stderr


@pytest.mark.usefixtures("built")
def test_the_rust_client_reads_the_poses_of_one_robot():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with PoseServer(endpoint) as server:
        done = cargo(endpoint, ARENA, "rover", str(COUNT))
        assert done.returncode == 0, done.stderr
        lines = done.stdout.splitlines()
        assert len(lines) == COUNT
        for line in lines:
            t_ns, state, *numbers = line.replace("[", "").replace("]", "").replace(",", "").split()
            pose = server.published["rover", int(t_ns)]
            sigmas = np.sqrt(pose.covariance_matrix.diagonal()[3:6])
            assert state == pose.state
            assert [float(number) for number in numbers[:7]] == [*pose.position, *pose.quaternion_wxyz]
            np.testing.assert_allclose([float(number) for number in numbers[7:]], sigmas, rtol=1e-6)


@pytest.mark.usefixtures("built")
def test_the_rust_client_waits_for_its_server():
    """It is started first."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    program = ROOT / "build" / "rust" / "debug" / "roundel-poses"
    words = [program, endpoint, ARENA, "drone", "1"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as client, PoseServer(endpoint):
        try:
            output, _ = client.communicate(timeout=DEADLINE_S)
            assert client.returncode == 0
            assert " tracked " in output
        finally:
            client.kill()


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize(
    "words", [["tcp/127.0.0.1:1", "demo"], ["tcp/127.0.0.1:1", "demo", "rover", "three"]]
)
def test_wrong_words_are_a_usage_error(words: list[str]):
    assert cargo(*words).returncode == 2


def test_the_cpp_client_builds(tmp_path: Path):
    shutil.copytree(EXAMPLES / "cpp", tmp_path / "examples" / "cpp")
    configured = subprocess.run(
        shlex.split(CONFIGURE), cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    if "zenohc" in configured.stderr:
        pytest.skip("this machine has no zenoh-cpp")
    assert configured.returncode == 0, configured.stderr
    subprocess.run(shlex.split(BUILD_CPP[0]), cwd=tmp_path, timeout=BUILD_S, check=True)


@pytest.fixture(scope="module")
def cpp_decoder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("c++")
    if compiler is None or not JSON:
        pytest.skip("this machine has no C++ compiler, or not nlohmann-json3-dev")
    program = tmp_path_factory.mktemp("cpp") / "decode_pose"
    source = Path(__file__).with_name("decode_pose.cpp")
    options = ["-std=c++20", "-Wall", "-Wextra", "-Werror", f"-I{EXAMPLES / 'cpp'}"]
    subprocess.run([compiler, *options, source, "-o", program], check=True, timeout=BUILD_S)
    return program


def test_the_cpp_decoder_reads_every_number(cpp_decoder: Path):
    pose = moving_pose("rover", 1_700_000_000_123_456_789, state="coasting")
    done = subprocess.run(
        [cpp_decoder], input=encode(pose), capture_output=True, timeout=DEADLINE_S, check=True
    )
    robot, t_ns, state, *numbers = done.stdout.decode().split()
    assert (robot, int(t_ns), state) == (pose.robot, pose.t_ns, pose.state)
    expected = [*pose.position, *pose.quaternion_wxyz, *pose.velocity]
    assert [float(number) for number in numbers[:10]] == expected
    assert np.array(numbers[10:], "<f4").tobytes() == pose.covariance


@pytest.mark.parametrize("data", [b"", b"\xc1", encode(moving_pose("rover", 1))[:-9], b"\x81\xa7version\x02"])
def test_the_cpp_decoder_refuses_other_bytes(cpp_decoder: Path, data: bytes):
    done = subprocess.run([cpp_decoder], input=data, capture_output=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 1
    assert done.stderr


SOURCES = sorted(path for path in EXAMPLES.rglob("*") if path.suffix in (".rs", ".cpp", ".hpp"))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_an_example_is_short(path: Path):
    assert len(path.read_text().splitlines()) < 100
