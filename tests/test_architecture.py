# SPDX-License-Identifier: BSD-3-Clause
"""Rules of the source code that no linter checks. The layers are contracts of import-linter in pyproject.toml."""

import ast
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable

import pytest

from tests import source_tree
from tests.source_tree import PROGRAMS, imports, name_of, parse, python_files

# Modules, from the one that imports to the one that imports none of its program. The server's end in fusion/monitoring.
MAX_CHAIN = {"camera_node": 10, "calib": 10, "fusion": 13, "web": 10, "roundel": 10}
SMALL = 60  # lines: such a module with one importer belongs into it
SHARED_NAMES = {"errors.py", "detector.py"}  # each program's errors; `camera_node.detector` is a contract
COMMON_TYPES = {"Array", "Index", "Mask", "Grey"}  # camera_node/foundation/arrays.py defines them


def assert_none(violations: Iterable[str]) -> None:
    """Fail with one line per violation."""
    lines = sorted(violations)
    assert not lines, "\n".join(["", *lines])


def test_a_public_class_name_has_one_meaning():
    """Stubs of the native modules (.pyi) do not count: a Python class may wrap a native one of the same name."""
    modules = defaultdict(list)
    for path in python_files(*PROGRAMS):
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                modules[node.name].append(name_of(path))
    assert_none(f"{name}: {', '.join(paths)}" for name, paths in modules.items() if len(paths) > 1)


def test_no_constructor_receives_the_object_that_calls_it():
    """A part receives what it needs, not its owner."""
    assert_none(
        f"{name_of(path)}:{node.lineno}: {ast.unparse(node)[:60]}"
        for path in python_files(*PROGRAMS)
        for node in ast.walk(parse(path))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id.lstrip("_")[:1].isupper()
        and any(isinstance(argument, ast.Name) and argument.id == "self" for argument in node.args)
    )


@pytest.mark.parametrize("program", PROGRAMS)
def test_import_chains_are_short(program: str):
    """A reader of one value walks along the imports."""
    chain = source_tree.longest_chain(source_tree.import_graph(program))
    assert len(chain) <= MAX_CHAIN[program], " -> ".join(chain)


def test_a_small_module_has_several_importers():
    importers = source_tree.count_importers(source_tree.import_graph(*PROGRAMS))
    lengths = {source_tree.module_of(p): len(p.read_text().splitlines()) for p in python_files(*PROGRAMS)}
    assert_none(
        f"{module} has {lengths[module]} lines and one importer"
        for module, count in importers.items()
        if count == 1 and lengths[module] < SMALL
    )


def test_a_file_name_has_one_meaning():
    recurring = source_tree.recurring_names(python_files(*PROGRAMS))
    assert_none(
        f"{name}: {', '.join(paths)}" for name, paths in recurring.items() if name not in SHARED_NAMES
    )


def test_program_code_imports_no_tests():
    assert_none(
        name_of(p) for p in python_files(*PROGRAMS) if any(m.split(".")[0] == "tests" for m in imports(p))
    )


def test_tests_import_helpers_only():
    """Not test modules, and no conftest but tests.conftest."""

    def is_helper(module: str) -> bool:
        folders = module.split(".")
        return not any(part.startswith("test_") for part in folders[1:]) and (
            "conftest" not in folders or folders[:2] == ["tests", "conftest"]
        )

    modules = {name_of(path)[: -len(".py")].replace("/", ".") for path in python_files("tests")}
    assert_none(
        f"{name_of(path)} imports {module}"
        for path in python_files("tests")
        for module in imports(path) & modules
        if not is_helper(module)
    )


def test_array_types_are_defined_once():
    """In camera_node/foundation/arrays.py, which is also the only module that writes NDArray[np.float64]."""
    for path in python_files(*PROGRAMS, "tests"):
        nodes = list(ast.walk(parse(path)))
        targets = [t for node in nodes if isinstance(node, ast.Assign) for t in node.targets]
        names = {target.id for target in targets if isinstance(target, ast.Name)}
        spelled = any(isinstance(n, ast.Subscript) and ast.unparse(n) == "NDArray[np.float64]" for n in nodes)
        defines = bool(names & COMMON_TYPES) or spelled
        assert defines == (name_of(path) == "camera_node/foundation/arrays.py"), name_of(path)


@pytest.mark.parametrize("extra", ["gtsam", "viser", "scipy"])
def test_a_camera_node_runs_without_the_server_extra(extra: str):
    """A camera's computer does not have the packages of the extra."""
    code = (
        f"import sys; sys.modules[{extra!r}] = None\n"
        "import camera_node.__main__, camera_node.sources.v4l2_cameras, camera_node.node.node\n"
        "import camera_node.sources.recorded_detections\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_live_tests_share_one_process_of_the_suite(request: pytest.FixtureRequest):
    """In two processes at once they disturb each other; a pytest that pytest-xdist does not know ignores the groups."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        pytest.skip("the tests run in one process")
    assert request.node.nodeid.endswith(f"@{request.path}")
