# SPDX-License-Identifier: BSD-3-Clause
"""Skips where openssl is missing."""

import shutil

import pytest


@pytest.fixture(scope="session", autouse=True)
def openssl() -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed; certificates.sh needs it")
