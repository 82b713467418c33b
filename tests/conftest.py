# SPDX-License-Identifier: BSD-3-Clause
"""What several folders of tests need."""

from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data("arena_small")`: a recording that lies beside the checkout; skips where it is absent."""

    def find(name: str) -> Path:
        path = ROOT.parent / "shared" / "data" / name
        if not path.exists():
            pytest.skip(f"the recording {name} is not beside this checkout")
        return path

    return find
