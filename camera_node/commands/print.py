# SPDX-License-Identifier: BSD-3-Clause
"""`roundel print`: roundels, wands, boards, L-frames and robots at true scale, as PDF or SVG, with the YAML that
belongs to them."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import tyro

from camera_node.foundation.config import dump_yaml, example_file, load_yaml, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from camera_node.geometry.body import Body, PrintedWand
from camera_node.geometry.codes import is_code, words
from camera_node.printing.drawing import Page, write_pages
from camera_node.printing.sheets import Card, board_page, body_page, card_pages, cards_for_page

EXAMPLES = {"wand": "wand.yaml", "l-frame": "l.yaml", "robot": "robots.yaml"}
DIAMETER_M = 0.09  # of all examples


class _Robots(msgspec.Struct):
    """The bodies in robots.yaml; what else it declares of a robot is not printed."""

    robots: dict[str, dict[str, object]]


@dataclass(frozen=True)
class Sheet:
    """Write something to print, at true scale, with cut marks and a ruler to check the printer.

    roundels: a page of roundels. wand, l-frame, robot: the roundels of a body, with its YAML beside the print. board: a
    ChArUco board for lens calibration.
    """

    what: Annotated[Literal["roundels", "wand", "board", "l-frame", "robot"], tyro.conf.Positional]
    """What to print."""
    out: Annotated[Path | None, tyro.conf.Positional] = None
    """The PDF or SVG file; the thing's name with .pdf unless given."""
    diameter: float | None = None
    """Outer diameter d_o of the black disc, metres; 0.09, or that of the file, unless given."""
    inner_ratio: float = 0.6
    """roundels: inner over outer diameter, d_i / d_o."""
    surround_ratio: float = 9 / 7
    """roundels: white card over outer diameter, d / d_o; increase it for dark floors and distant cameras."""
    codes: str | None = None
    """roundels: print those with these codes, such as 1-12 or 3,7,20-25; plain ones unless given.
    wand, l-frame, robot: one for each marker."""
    paper: str = "a4"
    """a4, a3, a2, letter or tabloid."""
    file: Path | None = None
    """wand, l-frame, robot: the YAML that describes it; an example unless given."""
    name: str | None = None
    """robot: its name in the file; the first one unless given."""
    columns: int = 5
    """board: squares in a row."""
    rows: int = 7
    """board: squares in a column."""
    square: float = 0.035
    """board: side of a square, metres."""

    def run(self) -> int:
        """Write the print and its YAML, and say what was written."""
        out = self.out or Path(f"{self.what}.pdf")
        if self.what == "board":
            pages, note = self._board()
        elif self.what == "roundels":
            pages, note = self._roundels()
        else:
            name, body = self._body()
            pages = self._body_pages(name, body)
            note = self._write_yaml(out.with_suffix(".yaml"), name, body)
        for path in write_pages(pages, out):
            say(f"wrote {path}")
        say(f"{note}; print at 100 %, then check the ruler")
        return 0

    def _board(self) -> tuple[list[Page], str]:
        spec = f"charuco:{self.columns}x{self.rows}:{self.square:g}"
        page = board_page(self.columns, self.rows, self.square, self.paper, f"--board {spec}")
        return [page], f"for the lens calibration: --board {spec}"

    def _roundels(self) -> tuple[list[Page], str]:
        numbers = parse_codes(self.codes) if self.codes is not None else []
        try:
            body = Body(
                diameter_m=DIAMETER_M if self.diameter is None else self.diameter,
                inner_ratio=self.inner_ratio,
                surround_ratio=self.surround_ratio,
                code=numbers[0] if numbers else (),
            )
        except ValueError as error:
            raise ConfigError(f"invalid sheet: {error}") from None
        size = f"d_o = {1e3 * body.diameter_m:g} mm"
        count = len(numbers) or cards_for_page(body, self.paper)
        cards = [Card(body, f"code {k}  {size}", k) for k in numbers]
        cards = cards or [Card(body, f"{k + 1}  {size}") for k in range(count)]
        roundels = "1 roundel" if count == 1 else f"{count} roundels"
        return card_pages(cards, self.paper, size), f"{roundels} of {size}; diameter_m: {body.diameter_m:g}"

    def _body(self) -> tuple[str, Body]:
        """The name and the body that the file describes."""
        path = self.file or example_file(EXAMPLES[self.what])
        if self.what != "robot":
            body = load_yaml(path, PrintedWand if self.what == "wand" else Body)
            return self.what, self._changed(body)
        robots = load_yaml(path, _Robots).robots
        name = self.name or next(iter(robots), "")
        if name not in robots:
            raise ConfigError(f"{path} has no robot '{name}'; it has {', '.join(robots) or 'none'}")
        fields = {key: value for key, value in robots[name].items() if key in Body.__struct_fields__}
        try:
            return name, self._changed(msgspec.convert(fields, Body))
        except (msgspec.ValidationError, ValueError) as error:
            raise ConfigError(f"{path}: robot {name}: {error}") from None

    def _changed(self, body: Body) -> Body:
        """The body with the diameter and the codes of the command line."""
        codes = self.codes and tuple(parse_codes(self.codes))
        given = {"--diameter": ("diameter_m", self.diameter), "--codes": ("code", codes)}
        for option, (field, value) in given.items():
            try:
                body = body if value is None else msgspec.structs.replace(body, **{field: value})
            except ValueError as error:
                raise ConfigError(f"{option}: {error}") from None
        return body

    def _body_pages(self, name: str, body: Body) -> list[Page]:
        """One page with the whole body where it fits, else a card for each roundel."""
        title = f"{name}, d_o = {1e3 * body.diameter_m:g} mm"
        if page := body_page(body, self.paper, name, title):
            return [page]
        places = [f"({_listed(1e3 * x for x in marker)}) mm" for marker in body.markers]
        if body.normals:
            faces = (_listed(round(x, 3) for x in normal) for normal in body.normals)
            places = [f"{place} facing ({face})" for place, face in zip(places, faces, strict=True)]
        marked = enumerate(zip(places, body.codes, strict=True), 1)
        cards = [Card(body, f"{name} {k}: {place}", code) for k, (place, code) in marked]
        return card_pages(cards, self.paper, title)

    def _write_yaml(self, path: Path, name: str, body: Body) -> str:
        """Write the body's YAML unless the file exists, which may be the one it was read from; return a note."""
        data = dump_yaml(_Robots({name: msgspec.to_builtins(body)}) if self.what == "robot" else body)
        if path.exists():
            return f"{path} exists and is unchanged; the print is {len(body.markers)} roundels of {body.diameter_m:g} m"
        write_atomically(path, data)
        return (
            f"wrote {path}, which describes the print: {len(body.markers)} roundels of {body.diameter_m:g} m"
        )


def parse_codes(text: str) -> list[int]:
    """The codes that a text such as 3,7,20-25 lists; raises ConfigError for another text and for unknown codes."""
    parts = [part.split("-") for part in text.split(",")]
    if not all(len(part) <= 2 and all(end.strip().isdecimal() for end in part) for part in parts):
        raise ConfigError(f"--codes {text} is no list of codes; give numbers and ranges such as 3,7,20-25")
    ends = [(int(part[0]), int(part[-1])) for part in parts]
    if bad := [end for pair in ends for end in pair if not is_code(end)]:
        raise ConfigError(f"--codes {text}: there is no code {bad[0]}; give 1 to {len(words())}")
    return [code for first, last in ends for code in range(first, last + 1)]


def _listed(numbers: Iterable[float]) -> str:
    return ", ".join(f"{x:g}" for x in numbers)
