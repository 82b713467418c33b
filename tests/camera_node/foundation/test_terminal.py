# SPDX-License-Identifier: BSD-3-Clause
"""Output that is not a terminal's: other programs read it, so it must not depend on a width."""

import pytest
from rich.table import Table

from camera_node.foundation.terminal import console, say, track

LONG = "a/path/of/many/folders/" * 20


@pytest.mark.parametrize("columns", ["40", "80", "200"])
def test_lines_and_tables_do_not_wrap_in_a_pipe(
    columns: str, monkeypatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", columns)
    table = Table("path")
    table.add_row(LONG)
    say(LONG)
    console().print(table)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == LONG
    assert sum(LONG in line for line in lines) == 2


def test_progress_is_silent_where_stderr_is_no_terminal(capsys: pytest.CaptureFixture[str]):
    assert list(track([1, 2, 3], "counting")) == [1, 2, 3]
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")
