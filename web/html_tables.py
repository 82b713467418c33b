# SPDX-License-Identifier: BSD-3-Clause
"""Tables, coloured texts, the style of the page and its script, as HTML. All texts are escaped."""

import base64
import gzip
import html
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from websockets.http11 import Response

from calib.rig.coverage import Coverage

COLOURS = {"ok": "#40c8aa", "warn": "#f0a63a", "bad": "#ef5b5b", "wait": "#9aa0ac"}  # by level
POINTS_PER_SHADE, SHADES = 8, 4  # of a cell, by the logarithm of its number of points
MARGIN_PX = 10
CELL = "padding:3px 6px 3px 0"
# On a phone Viser lays its panel, 20em wide, over the lower part of the scene. Here both are in one column: the scene
# has the height that the panel leaves, at least 45 %, and almost all once a tap on the title folds the panel.
PANEL = '[style*="position: fixed"][style*="width: 20em"]'
STYLE = f"""<style>
@media (max-width: 36em) {{
  [style*="width: 20em"] {{ width: 100vw !important }}
  div:has(> {PANEL}) {{ flex-direction: column }}
  div:has(> {PANEL}) > :not({PANEL}) {{ height: auto !important; min-height: 0 }}
  {PANEL} {{ position: relative !important; max-height: 55vh !important; flex: none }}
}}
th[title] {{ cursor: help; text-decoration: underline dotted #8886; text-underline-offset: 3px }}
.roundel-pictures {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(170px, 1fr)); gap: 6px;
  margin: 4px {MARGIN_PX}px 8px }}
.roundel-pictures figure {{ margin: 0; font-size: 11px }}
.roundel-pictures img {{ width: 100%; display: block; border-radius: 3px; background: #000; min-height: 60px }}
</style>"""
# The folders of Viser react to the pointer only. Here the title of each is a button: Tab reaches it, Enter and Space
# act as a click.
FOLDER = ".mantine-Paper-root:has(> .tabler-icon-chevron-down, > .tabler-icon-chevron-up)"
FOLDER_KEYS = f"""<script>
(() => {{
  const describe = title => {{
    title.tabIndex = 0;
    title.setAttribute("role", "button");
    title.setAttribute("aria-expanded", String(title.querySelector(".tabler-icon-chevron-up") !== null));
  }};
  const describeAll = () => document.querySelectorAll("{FOLDER}").forEach(describe);
  new MutationObserver(describeAll).observe(document, {{childList: true, subtree: true}});
  document.addEventListener("keydown", event => {{
    if (!["Enter", " "].includes(event.key) || !event.target.matches("{FOLDER}")) return;
    event.preventDefault();
    event.target.click();
  }});
}})();
</script>
"""
READ_ONLY_STYLE = """<style>
.mantine-Button-root, input, textarea, .mantine-Checkbox-root, .mantine-Slider-root, .mantine-Select-root {
  opacity: .45; pointer-events: none }
</style>"""


@dataclass(frozen=True)
class Column:
    """A column's title, its unit or "", and an explanation that is shown when the pointer is on the title."""

    title: str
    unit: str = ""
    explanation: str = ""

    def html(self) -> str:
        tip = f' title="{html.escape(self.explanation)}"' if self.explanation else ""
        unit = f"<br>{html.escape(self.unit)}" if self.unit else ""
        return f'<th style="{CELL};font-weight:500"{tip}>{html.escape(self.title)}{unit}</th>'


@dataclass(frozen=True)
class TableRow:
    """The cells of a row, its level (a key of `COLOURS`), a note, or "": a fault or an instruction; and the colour of
    its dot, if that is not the level's."""

    cells: tuple[str, ...]
    level: str
    note: str = ""
    dot: str = ""

    def html(self) -> str:
        """Return the row; the note has its own line, because a sentence does not fit beside figures."""
        cell = f'<td style="{CELL};white-space:nowrap">'
        texts = f"</td>{cell}".join(html.escape(text) for text in self.cells)
        dot = f'<span style="color:{self.dot or COLOURS[self.level]}">&#9679;</span> '
        row = f'<tr style="border-top:1px solid #8883">{cell}{dot}{texts}</td></tr>'
        style = f"white-space:normal;line-height:1.3;padding:0 0 4px 14px;color:{COLOURS[self.level]}"
        note = f'<tr><td colspan="{len(self.cells)}" style="{style}">{html.escape(self.note)}</td></tr>'
        return row + (note if self.note else "")


@dataclass(frozen=True)
class HtmlTable:
    """Rows under a header; `placeholder` stands for no rows."""

    columns: tuple[Column, ...]
    rows: list[TableRow]
    placeholder: str = "none"

    def html(self) -> str:
        """Return the table, with all texts escaped."""
        if not self.rows:
            return small(self.placeholder)
        head = "".join(column.html() for column in self.columns)
        body = "".join(row.html() for row in self.rows)
        size = f"width:calc(100% - {2 * MARGIN_PX}px);margin:0 {MARGIN_PX}px 6px"
        style = f"{size};border-collapse:collapse;font-size:11px;text-align:left"
        return (
            f'<table style="{style}"><tr style="opacity:.65;vertical-align:bottom;line-height:1.2">{head}</tr>'
            f"{body}</table>"
        )


def picture(text: str, jpeg: bytes) -> str:
    """A picture, and what it shows."""
    data = base64.b64encode(jpeg).decode()
    return f'<img alt="{html.escape(text)}" decoding="sync" src="data:image/jpeg;base64,{data}">'


def draw_cells(coverage: Coverage, text: str) -> str:
    """The cells of an image, brighter with more points, and what they show."""
    columns = coverage.counts.shape[1]
    shades = np.minimum(SHADES, np.ceil(np.log2(coverage.counts / POINTS_PER_SHADE + 1))) / SHADES
    style = f"display:grid;grid-template-columns:repeat({columns},1fr);gap:2px;margin:4px {MARGIN_PX}px"
    cells = "".join(
        f'<div style="height:12px;background:{COLOURS["ok"]}{round(20 + 235 * shade):02x}"></div>'
        for shade in shades.ravel()
    )
    return f'<div title="{html.escape(text)}" style="{style}">{cells}</div>'


def picture_grid(pictures: Iterable[tuple[str, str]]) -> str:
    """Pictures side by side: the HTML and the caption of each."""
    figures = "".join(
        f"<figure>{drawn}<figcaption>{html.escape(caption)}</figcaption></figure>"
        for drawn, caption in pictures
    )
    return f'<div class="roundel-pictures">{figures}</div>' if figures else ""


def small(text: str, level: str = "wait") -> str:
    """A small line of text."""
    style = f"margin:2px {MARGIN_PX}px 6px;font-size:11px;line-height:1.4;color:{COLOURS[level]}"
    return f'<div style="{style}">{html.escape(text)}</div>'


def status_line(level: str, text: str) -> str:
    """The line at the top of the page, in the colour of its level."""
    colour = COLOURS[level]
    style = (
        f"margin:6px {MARGIN_PX}px 10px;padding:6px 10px;border-left:4px solid {colour};background:{colour}22;"
        "font-size:13px;line-height:1.35;border-radius:2px"
    )
    return f'<div role="status" data-level="{level}" style="{style}">{html.escape(text)}</div>'


def add_folder_keys(response: Response) -> None:
    """Put the script into an HTML document that is about to be sent; other files stay as they are."""
    if response.status_code != 200 or "html" not in response.headers.get("Content-Type", ""):
        return
    response.body = _with_script(bytes(response.body), response.headers.get("Content-Encoding") == "gzip")
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=2)  # compressed or not; the document is the same for all browsers
def _with_script(document: bytes, is_compressed: bool) -> bytes:
    text = gzip.decompress(document) if is_compressed else document
    text = text.replace(b"</head>", FOLDER_KEYS.encode() + b"</head>", 1)
    return gzip.compress(text) if is_compressed else text
