# SPDX-License-Identifier: BSD-3-Clause
"""The table of commands, and how a command line is read and run.

Each program lists its commands as `Command` records in its folder `commands`; `roundel` joins the lists. A command's
module is imported when it runs: a camera's computer has neither GTSAM nor Viser, and lists of commands appear at once.
tyro reads the options; a mistake in them is one line instead of its box. What only mistakes need is imported where they
are reported: every command begins with this module.
"""

import contextlib
import functools
import inspect
import io
import logging
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

# Before NumPy is loaded: threads of a BLAS wait for each other longer than the products of small matrices take.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from camera_node.foundation.errors import ConfigError, most_similar
from camera_node.foundation.logs import set_up_logging

EDGE = re.compile(r"^[│╭╰]\s?|\s*[│╮╯]$", re.MULTILINE)  # of the boxes that tyro prints
RULE = re.compile(r"\n\s*─+\s*\n")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
ENTRY = re.compile(r"^ {4}(\S.*)\n((?: {5,}.*\n?)*)", re.MULTILINE)  # a missing option and its help
UNION = re.compile(r": no type matching .* '([^']*)' is not a number")
COUNT = re.compile(
    r": no type matching .* instantiated from \[(.*?)\].* did not match expected argument count (\d+).*"
)
NUMBER = re.compile(r"(?:invalid literal for int\(\) with base 10|could not convert string to float): (.*)")


@dataclass(frozen=True)
class Command:
    """One command, or a group of commands.

    Attributes:
        name: the word on the command line.
        summary: what it does, in one line.
        target: its dataclass with a method `run`, or its function, as `module:name`; or the commands of the group.
        examples: complete command lines.
        group: the heading under which it is listed.
        log_level: of its log on stderr.
    """

    name: str
    summary: str
    target: "str | tuple[Command, ...]"
    examples: tuple[str, ...] = ()
    group: str = ""
    log_level: int = logging.INFO

    def run(self, arguments: Sequence[str], prog: str) -> int | None:
        """Run it, or the command of the group that the arguments name.

        Args:
            arguments: the command line after this command.
            prog: this command's full name in its help and in errors.

        Raises:
            RoundelError: as the command does; ConfigError for a mistake in the command line or a missing package.
        """
        if not isinstance(self.target, str):
            return run_one_of(self.target, arguments, prog, functools.partial(self._list_group, prog))
        set_up_logging(self.log_level)
        module, name = self.target.split(":")
        try:
            return run_command(getattr(import_module(module), name), prog, arguments, self.examples)
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if (extra := _extra_of(package)) is None:
                raise
            raise ConfigError(
                f"{prog} needs {package}, which a camera's machine does not; pip install 'roundel[{extra}]'"
            ) from None

    def _list_group(self, prog: str) -> str:
        assert not isinstance(self.target, str)
        return list_commands(
            self.target, prog, f"{self.summary[0].upper()}{self.summary[1:]}.", self.examples
        )


def run_program(
    commands: Sequence[Command], arguments: Sequence[str], default: Command, prog: str
) -> int | None:
    """Run the command that the first argument names, or `default`, of the name `prog`, with all of them."""
    command = find_command(commands, arguments, "--help lists the options")
    if command is None:
        return default.run(arguments, prog)
    return command.run(arguments[1:], f"roundel {command.name}")


def run_one_of(
    commands: Sequence[Command], arguments: Sequence[str], prog: str, overview: Callable[[], str]
) -> int | None:
    """Run the command that the first argument names; return its exit code.

    Args:
        commands: to choose from.
        arguments: the command line without the program.
        prog: the program's name in help and in errors.
        overview: the text of `--help`.

    Raises:
        RoundelError: as the command does; ConfigError if there is none of that name.
    """
    if arguments and arguments[0] in ("-h", "--help"):
        print(overview())
        return 0
    remedy = f"{prog} --help lists the commands"
    if (command := find_command(commands, arguments, remedy)) is not None:
        return command.run(arguments[1:], f"{prog} {command.name}")
    if arguments:
        raise ConfigError(f"{arguments[0]} needs a command before it; {remedy}")
    raise ConfigError(f"{prog} needs a command, such as {commands[0].name}; {remedy}")


def find_command(commands: Sequence[Command], arguments: Sequence[str], remedy: str) -> Command | None:
    """The command that the first argument names; None where it is an option or missing.

    Raises:
        ConfigError: there is none of that name; the message has the most similar one, and the remedy.
    """
    if not arguments or arguments[0].startswith("-"):
        return None
    known = {command.name: command for command in commands}
    if arguments[0] in known:
        return known[arguments[0]]
    similar = most_similar(arguments[0], known)
    hint = f"did you mean {similar}?" if similar else f"the commands are {', '.join(known)}"
    raise ConfigError(f"there is no command '{arguments[0]}'; {hint} ({remedy})")


def list_commands(commands: Sequence[Command], prog: str, about: str, examples: Sequence[str] = ()) -> str:
    """The text of `--help` of a group: its commands under their headings, each with a summary."""
    width = max(len(command.name) for command in commands)
    lines = [f"usage: {prog} COMMAND [OPTIONS]", "", about]
    for group in dict.fromkeys(command.group for command in commands):
        rows = [f"  {c.name:{width}}  {c.summary}" for c in commands if c.group == group]
        lines += ["", f"{group}:", *rows]
    if examples:
        lines += ["", "Examples:", *(f"  {example}" for example in examples)]
    return "\n".join([*lines, "", f"{prog} COMMAND --help shows options and examples."])


def _extra_of(package: str) -> str | None:
    """The extra that installs a package; None if none does."""
    from importlib.metadata import requires

    for requirement in requires("roundel") or ():
        name, extra = re.match(r"[\w-]+", requirement), re.search(r"extra == ['\"](\w+)", requirement)
        if name and extra and name[0] == package:
            return extra[1]
    return None


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
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            return tyro.cli(target, prog=prog, description=_description(kind, examples), args=arguments)
    except SystemExit as end:
        if not end.code:  # of --help
            raise
    text = _fault(target, prog, arguments)
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


class _Box(io.StringIO):
    """tyro draws boxes where the output's encoding has them, and rows of dashes elsewhere, as with `LC_ALL=C`."""

    encoding = "utf-8"


def _fault(target: Any, prog: str, arguments: Sequence[str]) -> str:
    """The box that tyro prints for a mistake in a command line, whatever the terminal's encoding is."""
    box = _Box()
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(box), contextlib.redirect_stdout(box):
        tyro.cli(target, prog=prog, args=arguments)
    return box.getvalue()


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
            similar = most_similar(option, known)
            return f"there is no option {option}" + (f"; did you mean {similar}?" if similar else "")
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
    line = COUNT.sub(r" takes \2 values with a space between them, and got \1", line)
    return UNION.sub(r" '\1' is not a number", NUMBER.sub(r"\1 is not a number", line))


def _required(name: str, text: str) -> str:
    """A missing option by its name; a missing value without a name by the first words of its help."""
    about = " ".join(text.split()).split(";")[0].removesuffix("(required)").strip(" .")
    return name if name.startswith("--") or not about else f"{name} ({about})"
