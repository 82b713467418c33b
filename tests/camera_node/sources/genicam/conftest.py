# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures of the tests that run Aravis's fake GigE cameras; they skip where Aravis or a C compiler is absent."""

import ctypes
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.camera_node.sources.genicam.fake_gige import FakeCamera, compile_library


@pytest.fixture(scope="session")
def fake_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        ctypes.CDLL("libaravis-0.8.so.0")
    except OSError:
        pytest.skip("libaravis-0.8-0 is not installed")
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler for the library that the fake camera needs")
    return compile_library(tmp_path_factory.mktemp("fake"))


@pytest.fixture
def fake_camera(fake_library: Path) -> Iterator[Callable[..., FakeCamera]]:
    """`fake_camera(number, lost=0.0, scene=None)` starts a camera, which ends with the test."""
    started: list[FakeCamera] = []

    def start(*arguments, **options) -> FakeCamera:
        started.append(FakeCamera(fake_library, *arguments, **options))
        return started[-1]

    yield start
    for camera in started:
        camera.stop()
