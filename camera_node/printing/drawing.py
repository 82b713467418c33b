# SPDX-License-Identifier: BSD-3-Clause
"""Pages of filled circles, rectangles, lines and texts in millimetres, written as SVG and PDF at true scale.

x points right and y down, from the page's upper left corner.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError, unwritable
from camera_node.foundation.extras import require

POINT_MM = 25.4 / 72  # PDF's unit
LINE_MM = 0.15
TEXT_MM = 3.2  # height of the letters' bodies
GREY = 0.6  # of lines: visible for scissors, without contrast for the detector


@dataclass(frozen=True)
class Circle:
    """A disc of a grey level (0 black, 1 white), or its outline where `grey` is None."""

    x: float
    y: float
    radius: float
    grey: float | None = None


@dataclass(frozen=True)
class Box:
    """A black rectangle, by its upper left corner."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Polygon:
    """A black polygon, by its corners."""

    corners: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Stroke:
    """A thin line; `grey` as of a circle."""

    x0: float
    y0: float
    x1: float
    y1: float
    grey: float = 0.0


@dataclass(frozen=True)
class Label:
    """A text, by the left end of its base line."""

    x: float
    y: float
    text: str
    size: float = TEXT_MM


Shape = Circle | Box | Polygon | Stroke | Label


@dataclass
class Page:
    """A page and its shapes, drawn in their order."""

    width: float
    height: float
    shapes: list[Shape] = field(default_factory=list)


def write_pages(pages: Sequence[Page], path: Path) -> list[Path]:
    """Write pages as PDF, or as SVG with one file a page; return the files.

    Raises:
        ConfigError: the suffix is another one, the folder is not writable, or a package for PDF is missing.
    """
    if path.suffix.lower() == ".svg":
        paths = [path] if len(pages) == 1 else [_numbered(path, k) for k in range(1, len(pages) + 1)]
        for page, file in zip(pages, paths, strict=True):
            write_atomically(file, svg_of(page))
        return paths
    if path.suffix.lower() != ".pdf":
        raise ConfigError(f"{path} has no format that is known; name a file that ends with .pdf or .svg")
    _write_pdf(pages, path)
    return [path]


def _numbered(path: Path, k: int) -> Path:
    return path.with_name(f"{path.stem}-{k}{path.suffix}")


def svg_of(page: Page) -> str:
    """The page as SVG text."""
    size = f'width="{page.width:g}mm" height="{page.height:g}mm" viewBox="0 0 {page.width:g} {page.height:g}"'
    shapes = "\n".join(_svg_shape(shape) for shape in page.shapes)
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>\n{shapes}\n</svg>\n'


def _svg_shape(shape: Shape) -> str:
    if isinstance(shape, Circle):
        paint = (
            f'fill="none" stroke="{_svg_grey(GREY)}" stroke-width="{LINE_MM}"'
            if shape.grey is None
            else f'fill="{_svg_grey(shape.grey)}"'
        )
        return f'<circle cx="{shape.x:.4f}" cy="{shape.y:.4f}" r="{shape.radius:.4f}" {paint}/>'
    if isinstance(shape, Box):
        return f'<rect x="{shape.x:.4f}" y="{shape.y:.4f}" width="{shape.width:.4f}" height="{shape.height:.4f}"/>'
    if isinstance(shape, Polygon):
        return f'<polygon points="{" ".join(f"{x:.4f},{y:.4f}" for x, y in shape.corners)}"/>'
    if isinstance(shape, Stroke):
        ends = f'x1="{shape.x0:.4f}" y1="{shape.y0:.4f}" x2="{shape.x1:.4f}" y2="{shape.y1:.4f}"'
        return f'<line {ends} stroke="{_svg_grey(shape.grey)}" stroke-width="{LINE_MM}"/>'
    text = shape.text.replace("&", "&amp;").replace("<", "&lt;")
    font = f'font-size="{shape.size}" font-family="Helvetica, Arial, sans-serif"'
    return f'<text x="{shape.x:.3f}" y="{shape.y:.3f}" {font}>{text}</text>'


def _svg_grey(grey: float) -> str:
    return f"#{round(255 * grey):02x}" + 2 * f"{round(255 * grey):02x}"


def _write_pdf(pages: Sequence[Page], path: Path) -> None:
    canvas_module = require("reportlab.pdfgen.canvas", "server", "a PDF (an SVG does not)")
    canvas = canvas_module.Canvas(str(path), invariant=1)
    for page in pages:
        canvas.setPageSize((page.width / POINT_MM, page.height / POINT_MM))
        canvas.scale(1 / POINT_MM, 1 / POINT_MM)
        canvas.setLineWidth(LINE_MM)
        for shape in page.shapes:
            _pdf_shape(canvas, shape, page.height)
        canvas.showPage()
    try:
        canvas.save()
    except OSError as error:
        raise unwritable(path, error) from None


def _pdf_shape(canvas: Any, shape: Shape, height: float) -> None:
    if isinstance(shape, Circle):
        canvas.setStrokeGray(GREY)
        canvas.setFillGray(0.0 if shape.grey is None else shape.grey)
        is_outline = shape.grey is None
        canvas.circle(
            shape.x, height - shape.y, shape.radius, stroke=int(is_outline), fill=int(not is_outline)
        )
    elif isinstance(shape, Box):
        canvas.setFillGray(0.0)
        canvas.rect(shape.x, height - shape.y - shape.height, shape.width, shape.height, stroke=0, fill=1)
    elif isinstance(shape, Polygon):
        canvas.setFillGray(0.0)
        outline = canvas.beginPath()
        for k, (x, y) in enumerate(shape.corners):
            (outline.lineTo if k else outline.moveTo)(x, height - y)
        outline.close()
        canvas.drawPath(outline, stroke=0, fill=1)
    elif isinstance(shape, Stroke):
        canvas.setStrokeGray(shape.grey)
        canvas.line(shape.x0, height - shape.y0, shape.x1, height - shape.y1)
    else:
        canvas.setFillGray(0.0)
        canvas.setFont("Helvetica", shape.size)
        canvas.drawString(shape.x, height - shape.y, shape.text)
