# SPDX-License-Identifier: BSD-3-Clause
"""Reads the command lines of all programs with tyro, and states a mistake in them in one line instead of a box."""

import contextlib
import difflib
import functools
import inspect
import io
import re
from collections.abc import Callable, Sequence
from typing import Any

import tyro

from camera_node.foundation.errors import ConfigError

EDGE = re.compile(r"^[│╭╰]\s?|\s*[│╮╯]$", re.MULTILINE)  # of the boxes that tyro prints
RULE = re.compile(r"\n\s*─+\s*\n")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
ENTRY = re.compile(r"^ {4}(\S.*)\n((?: {5,}.*\n?)*)", re.MULTILINE)  # a missing option and its help
NUMBER = re.compile(r"(?:invalid literal for int\(\) with base 10|could not convert string to float): (.*)")


def parse(kind: Any, prog: str, arguments: Sequence[str], examples: Sequence[str] = ()) -> Any:
    """Build what a command line describes.

    Args:
        kind: a dataclass, a union of dataclasses for subcommands, or a function.
        prog: the command's name in its help and in errors.
        arguments: the command line without the command itself.
        examples: complete command lines that `--help` shows.

    Returns:
        An instance of the dataclass; for a function, the call to make, without arguments.

    Raises:
        ConfigError: an option is unknown, missing or has an invalid value; the message names it and a similar one.
    """
    target = _deferred(kind) if inspect.isfunction(kind) else kind
    boxes = io.StringIO()
    try:
        with contextlib.redirect_stderr(boxes):
            return tyro.cli(target, prog=prog, description=_description(kind, examples), args=arguments)
    except SystemExit as end:
        if not end.code:  # of --help
            raise
        text = boxes.getvalue()
    known = set(OPTION.findall(_help(target, prog, arguments)))
    raise ConfigError(
        f"{_unknown(arguments, known) or _summary(text)} ({prog} --help lists all options)"
    ) from None


def run_command(kind: Any, prog: str, arguments: Sequence[str], examples: Sequence[str] = ()) -> int | None:
    """Parse a command line, call the function or the `run` method of the dataclass, and return its result."""
    parsed = parse(kind, prog, arguments, examples)
    return parsed() if isinstance(parsed, functools.partial) else parsed.run()


def _deferred(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function for tyro, which calls it: so that it runs after parsing, and not within."""

    @functools.wraps(function)
    def defer(*arguments: Any, **options: Any) -> functools.partial:
        return functools.partial(function, *arguments, **options)

    return defer


def _description(kind: Any, examples: Sequence[str]) -> str | None:
    """The text of `--help`; None for tyro's own."""
    if not examples:
        return None
    text = inspect.getdoc(kind) or ""
    text = re.split(r"\n(?:Args|Attributes|Returns|Raises):\n", text)[0].strip()
    return "\n".join([text, "", "Examples:", *(f"  {example}" for example in examples)])


def _help(kind: Any, prog: str, arguments: Sequence[str]) -> str:
    """The help of the command, or of its subcommand if the command line names one."""
    subcommand = [word for word in arguments[:1] if not word.startswith("-")]
    for words in ([*subcommand, "--help"], ["--help"]):
        text = io.StringIO()
        with (
            contextlib.suppress(SystemExit),
            contextlib.redirect_stdout(text),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            tyro.cli(kind, prog=prog, args=words)
        if text.getvalue():
            break
    return text.getvalue()


def _unknown(arguments: Sequence[str], known: set[str]) -> str:
    """The first option that does not exist, with the most similar one; empty if all exist."""
    given = [word.split("=")[0].replace("_", "-") for word in arguments if re.match("--[A-Za-z]", word)]
    for option in given:
        if option not in known:
            similar = difflib.get_close_matches(option, known, 1)
            return f"there is no option {option}" + (f"; did you mean {similar[0]}?" if similar else "")
    return ""


def _summary(text: str) -> str:
    """What tyro's box states, without the help of the options, on one line."""
    rows = EDGE.sub("", text.strip()).split("\n", 1)[-1]  # without the title
    fault = RULE.split(rows)[0]
    if fault.lstrip().startswith("Missing from"):
        missing = [_required(*match) for match in ENTRY.findall(fault)]
        return f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
    line = " ".join(fault.split()).removeprefix("Error parsing ")
    line = re.sub(r"^Unrecognized options: (.*)", r"'\1' was not expected", line)
    return NUMBER.sub(r"\1 is not a number", line)


def _required(name: str, text: str) -> str:
    """A missing option by its name; a missing value without a name by the first words of its help."""
    about = " ".join(text.split()).split(";")[0].removesuffix("(required)").strip(" .")
    return name if name.startswith("--") or not about else f"{name} ({about})"
