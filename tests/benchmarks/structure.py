# SPDX-License-Identifier: BSD-3-Clause
"""Size and structure of the repository: `python -m tests.benchmarks.structure [--root OTHER_CHECKOUT]`.

Lines of code are without blank lines, comments and docstrings. Constants are names in capitals that a module sets, and
`constexpr` of C++. Records are classes without methods of their own but properties and constructors.
"""

import argparse
import ast
import re
from pathlib import Path

from tests import source_tree
from tests.source_tree import PROGRAMS

CONSTANT_CPP = re.compile(r"^\s*(?:static |inline )*constexpr ", re.MULTILINE)


def constants(path: Path) -> int:
    """How many constants a file defines."""
    if path.suffix != ".py":
        return len(CONSTANT_CPP.findall(path.read_text()))
    names = [
        name.id
        for node in source_tree.parse(path).body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        for name in ast.walk(target)
        if isinstance(name, ast.Name)
    ]
    return sum(name.lstrip("_").isupper() for name in names)


def classes(path: Path) -> list[ast.ClassDef]:
    """All classes of a Python file."""
    return [node for node in ast.walk(source_tree.parse(path)) if isinstance(node, ast.ClassDef)]


def is_record(node: ast.ClassDef) -> bool:
    """Whether a class only holds values: every method is a property or makes an instance."""
    has_fields = any(isinstance(child, ast.AnnAssign) for child in node.body)
    methods = [child for child in node.body if isinstance(child, ast.FunctionDef)]
    return has_fields and all(
        {ast.unparse(d).split("(")[0] for d in m.decorator_list} & {"property", "classmethod"}
        for m in methods
    )


def programs_of(root: Path) -> tuple[str, ...]:
    """The folders of program code of a checkout; older ones have no package `roundel`."""
    return tuple(name for name in PROGRAMS if (root / name).exists())


def measure(folders: tuple[str, ...]) -> dict[str, object]:
    """The figures of some folders of program code."""
    suffixes = {".py", ".cpp", ".hpp"}
    files = [
        path
        for folder in folders
        for path in sorted((source_tree.ROOT / folder).rglob("*"))
        if path.suffix in suffixes
    ]
    python = [path for path in files if path.suffix == ".py"]
    graph = source_tree.import_graph(*folders)
    importers = source_tree.count_importers(graph)
    small = {m for m, n in importers.items() if n == 1 and _length(m) < 60}
    found = [node for path in python for node in classes(path)]
    return {
        "files": len(files),
        "lines": sum(len(path.read_text().splitlines()) for path in files),
        "lines of code": sum(source_tree.code_lines(path) for path in files),
        "constants": sum(constants(path) for path in files),
        "classes": len(found),
        "records": sum(map(is_record, found)),
        "longest import chain": len(source_tree.longest_chain(graph)),
        "recurring file names": len(source_tree.recurring_names(python)),
        "modules of < 60 lines with one importer": len(small),
    }


def _length(module: str) -> int:
    return len((source_tree.ROOT / (module.replace(".", "/") + ".py")).read_text().splitlines())


def main() -> None:
    """Print one row for each program, one for all, and the lines of tests."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, default=source_tree.ROOT, help="another checkout")
    source_tree.ROOT = parser.parse_args().root.resolve()
    programs = programs_of(source_tree.ROOT)
    columns = {name: measure((name,)) for name in programs} | {"all": measure(programs)}
    print(f"{'':42}" + "".join(f"{name:>13}" for name in columns))
    for row in columns["all"]:
        print(f"{row:42}" + "".join(f"{column[row]!s:>13}" for column in columns.values()))
    tests = source_tree.python_files("tests")
    print(f"tests: {len(tests)} files, {sum(len(p.read_text().splitlines()) for p in tests)} lines, ", end="")
    print(f"{sum(map(source_tree.code_lines, tests))} of code")


if __name__ == "__main__":
    main()
