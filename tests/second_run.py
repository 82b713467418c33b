# SPDX-License-Identifier: BSD-3-Clause
"""`--second-run`: a live test that failed runs once more, in a process of its own, after all others have ended.

Its result depends on real time, which a loaded machine does not always give. If it now passes, it is counted as
`unstable` in pytest's closing line, which makes no run red; the closing lines name it, and `build/unstable.txt`
collects its first failure. A test that only computes never gets a second run, and one that fails twice stays failed.
"""

import datetime
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

MAX_FAILURES = 10  # with more, the programs or the machine are broken, and no second run says otherwise
TIMEOUT_S = 4000.0  # more than pytest-timeout gives the slowest test
OUTPUT = 5000  # characters of a second failure that are shown


def _name(nodeid: str) -> str:
    """Without the group that pytest-xdist appends, as in `test_a.py::test_b[x@y]@live`."""
    return nodeid[: nodeid.rfind("@")] if nodeid.rfind("@") > nodeid.rfind("]") else nodeid


class SecondRun:
    """Plugin of the process that reports, with pytest-xdist and without."""

    def __init__(self, config: pytest.Config) -> None:
        self.root: Path = config.rootpath
        self.file = self.root / "build" / "unstable.txt"
        self.failures: dict[str, list[pytest.TestReport]] = {}
        self.unstable: list[str] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failures.setdefault(_name(report.nodeid), []).append(report)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session):
        """Pass over a run that ended early, by `-x` or Ctrl+C: that raises."""
        result = yield
        for name, reports in list(self.failures.items()) if len(self.failures) <= MAX_FAILURES else ():
            done = self._run_again(name)
            if done.returncode == pytest.ExitCode.OK:
                self._replace(session, name, reports)
            elif done.returncode == pytest.ExitCode.TESTS_FAILED:
                reports[0].sections.append(("second run, by itself", done.stdout[-OUTPUT:]))
        return result

    def _run_again(self, name: str) -> subprocess.CompletedProcess[str]:
        """Exit code 5, no test ran: it is not live."""
        words = ["-q", "-n", "0", "-p", "no:cacheprovider", "-m", "", "--live-only", name]
        return subprocess.run(
            [sys.executable, "-m", "pytest", *words],
            cwd=self.root,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=TIMEOUT_S,
        )

    def _replace(self, session: pytest.Session, name: str, reports: list[pytest.TestReport]) -> None:
        """Count a test as unstable, and no more as failed, or as passed before its fixtures failed."""
        self._collect(name, reports[0])
        terminal = session.config.pluginmanager.get_plugin("terminalreporter")
        stats = terminal.stats if terminal else {}
        for category in ("failed", "error", "passed"):
            remaining = [report for report in stats.pop(category, []) if _name(report.nodeid) != name]
            if remaining:
                stats[category] = remaining
        session.testsfailed -= len(reports)
        self.unstable.append(name)
        passed = pytest.TestReport(name, reports[0].location, {}, "passed", None, "call")
        session.config.hook.pytest_runtest_logreport(report=passed)

    def _collect(self, name: str, report: pytest.TestReport) -> None:
        commit = subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=self.root, capture_output=True, text=True
        ).stdout.strip()
        date = f"{datetime.datetime.now():%Y-%m-%d %H:%M}"
        self.file.parent.mkdir(exist_ok=True)
        with self.file.open("a") as file:
            file.write(f"{date} {commit or 'no commit'} {name}\n")
            file.write(textwrap.indent(report.longreprtext, "    ") + "\n\n")

    def pytest_report_teststatus(self, report: pytest.TestReport) -> tuple[str, str, tuple] | None:
        if report.nodeid in self.unstable:
            return "unstable", "U", ("UNSTABLE", {"yellow": True})
        return None

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self.unstable:
            terminalreporter.section("unstable: passed in a second run by itself", yellow=True)
            for name in self.unstable:
                terminalreporter.write_line(f"UNSTABLE {name}")
            terminalreporter.write_line(f"the first failures are in {self.file.relative_to(self.root)}")
