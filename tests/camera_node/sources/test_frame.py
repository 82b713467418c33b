# SPDX-License-Identifier: BSD-3-Clause
"""No output of a camera node contains the credentials of a stream."""

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.sources.frame import is_url, without_credentials
from tests.waiting import DEADLINE_S

SOURCES = (
    "rtsp://admin:s3cret@127.0.0.1:1/live",
    "http://admin:s3/cr?et@127.0.0.1:1/video",
    "http://127.0.0.1:1/video?token=s3cret",
    "admin:s3cret@camera",
)


@pytest.mark.parametrize("source", SOURCES)
def test_a_source_that_does_not_open_is_reported_in_one_line_without_credentials(source: str):
    command = [sys.executable, "-m", "camera_node", "--source", source, "--name", "cam0"]
    program = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert program.returncode in (2, 75)
    assert len(program.stderr.splitlines()) == 1
    assert "***" in program.stderr
    assert not any(secret in program.stdout + program.stderr for secret in ("s3", "cret", "admin"))


@given(st.text("ab:/@?#%", min_size=1), st.text("ab:/@?#%", min_size=1))
def test_whatever_the_password_contains_only_the_host_and_the_path_are_shown(user: str, password: str):
    assert without_credentials(f"rtsp://{user}:{password}@host/path") == "rtsp://***@host/path"


def test_sources_without_credentials_are_shown_as_they_are():
    for source in ("rtsp://host:554/live", "Arducam OV9281", "2", "/dev/video2"):
        assert without_credentials(source) == source
    assert [is_url(source) for source in ("rtsp://h", "http://h/p", "2", "C:/videos")] == [
        True,
        True,
        False,
        False,
    ]
