# SPDX-License-Identifier: BSD-3-Clause
"""Cost of the suite as `make test` runs it: `python -m tests.benchmarks.suite [options of pytest]`.

Prints core-seconds by folder and of the costliest tests, all core-seconds with those of collection, and the wall time,
which holds for a machine without other work. A child process counts at the test in which it is waited for, a fixture of
a module at its first test, the browser at the last test of the page.
"""

import os
import resource
import shlex
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
N_SHOWN = 40
PROPERTY = "core-seconds"
STARTED = pytest.StashKey[float]()
_costs: defaultdict[str, float] = defaultdict(float)


def core_seconds() -> float:
    """Of this process and of its children that ended."""
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """Hook of the processes that run tests: remember when a test starts."""
    item.stash[STARTED] = core_seconds()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo):
    """Send what a test cost with the report of its end."""
    report = yield
    if call.when == "teardown":
        report.user_properties.append((PROPERTY, core_seconds() - item.stash[STARTED]))
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Hook of the process that reports."""
    if report.when == "teardown":
        (cost,) = (value for name, value in report.user_properties if name == PROPERTY)
        _costs[report.nodeid] += float(str(cost))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    folders: defaultdict[str, float] = defaultdict(float)
    for name, cost in _costs.items():
        parts = Path(name.partition("::")[0]).parts
        folders["/".join(parts[:3]) if len(parts) > 3 else "/".join(parts[:2])] += cost
    for title, costs in (("folders", folders), ("tests", _costs)):
        terminalreporter.section(f"core-seconds of {title}")
        for name, cost in sorted(costs.items(), key=lambda entry: -entry[1])[:N_SHOWN]:
            terminalreporter.write_line(f"{cost:7.1f}  {name}")


def main() -> None:
    started_s = time.monotonic()
    words = shlex.join(["-p", "tests.benchmarks.suite", *sys.argv[1:]])
    code = subprocess.run(["make", "test", f"ARGS={words}"], cwd=ROOT, check=False).returncode
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{used.ru_utime + used.ru_stime:.0f} core-seconds in {time.monotonic() - started_s:.0f} s")
    sys.exit(code)


if __name__ == "__main__":
    main()
