# SPDX-License-Identifier: BSD-3-Clause
"""Modules of the programs and their imports, for `tests/test_architecture.py` and the benchmark of the structure."""

import ast
import gc
import itertools
import re
from collections import Counter
from collections.abc import Iterable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = ("camera_node", "calib", "fusion", "web", "roundel")
TARGET = re.compile(r"[a-z_0-9.]+:\w+$")  # of a command


def python_files(*folders: str) -> list[Path]:
    """All Python files of some top-level folders."""
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def name_of(path: Path) -> str:
    """The path from the root of the repository."""
    return path.relative_to(ROOT).as_posix()


def module_of(path: Path) -> str:
    """The dotted name of a Python file."""
    return name_of(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def parse(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    tree = ast.parse(path.read_text(), path)
    gc.freeze()  # all trees live to the end: to search them for garbage again and again takes longer than to parse
    return tree


def imports(path: Path) -> set[str]:
    """The modules that a file imports; of `from a import b` both a and a.b, since b may be a module.

    A table of commands imports the targets that it names, such as "calib.commands.check:check", when they run.
    """
    found: set[str] = set()
    for node in ast.walk(parse(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and TARGET.match(node.value):
            found.add(node.value.split(":")[0])
    return found


def import_graph(*folders: str) -> dict[str, set[str]]:
    """For each module of some folders, the modules of these folders that it imports; packages are left out."""
    files = {module_of(path): path for path in python_files(*folders) if path.name != "__init__.py"}
    return {module: (imports(path) & files.keys()) - {module} for module, path in files.items()}


def longest_chain(graph: dict[str, set[str]]) -> list[str]:
    """The modules of a longest chain of imports, the importing ones first."""

    @cache
    def chain(module: str) -> tuple[str, ...]:
        return (module, *max((chain(imported) for imported in sorted(graph[module])), key=len, default=()))

    return list(max((chain(module) for module in sorted(graph)), key=len))


def recurring_names(paths: Iterable[Path]) -> dict[str, list[str]]:
    """File names that occur in several folders, with their paths; __init__.py and __main__.py are Python's."""
    by_name = sorted((path.name, name_of(path)) for path in paths if not path.name.startswith("__"))
    groups = {
        name: [path for _, path in group] for name, group in itertools.groupby(by_name, lambda pair: pair[0])
    }
    return {name: group for name, group in groups.items() if len(group) > 1}


def count_importers(graph: dict[str, set[str]]) -> Counter[str]:
    """How many modules import each module."""
    counts = Counter(dict.fromkeys(graph, 0))
    counts.update(imported for modules in graph.values() for imported in modules)
    return counts


def code_lines(path: Path) -> int:
    """Lines of a Python or C++ file without blank lines, comments and docstrings."""
    lines = path.read_text().splitlines()
    if path.suffix == ".py":
        hidden = {number for span in _docstrings(parse(path)) for number in span}
        return sum(
            bool(line.strip()) and not line.lstrip().startswith("#") and number not in hidden
            for number, line in enumerate(lines, 1)
        )
    return sum(bool(line.strip()) and not line.lstrip().startswith(("//", "*", "/*")) for line in lines)


def _docstrings(tree: ast.Module) -> Iterable[range]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                yield range(first.lineno, (first.end_lineno or first.lineno) + 1)
