"""Writes the sections of a report: Markdown with pictures beside it, and one page of HTML with everything in it."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from qpavoid.arena.tables import Cell, Section


def write_markdown(folder: Path, title: str, sections: Sequence[Section]) -> list[Path]:
    """Writes report.md and its pictures."""
    written, lines = [], [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for text in section.text:
            lines += [text, ""]
        lines += [f"- {point}" for point in section.points] + [""] * bool(section.points)
        for name, caption, figure in section.pictures:
            path = folder / f"report-{name}.png"
            figure.savefig(path, dpi=110)
            written.append(path)
            lines += [f"![{caption}]({path.name})", ""]
        for table in section.tables:
            lines += [_row(table.headings), _row(["---"] * len(table.headings))]
            lines += [_row([_markdown(cell) for cell in row]) for row in table.rows] + [""]
    path = folder / "report.md"
    path.write_text("\n".join(lines), encoding="utf-8")
    return [path, *written]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _markdown(cell: Cell) -> str:
    """Text that means what it says within a table."""
    text = " ".join(cell.text.split())
    if cell.code:
        return f"`{text.replace('|', chr(92) + '|')}`"
    text = re.sub(r"([\\`*_<>\[\]|~])", r"\\\1", text)
    return f"{text} ({cell.span})" if cell.span else text


def write_page(folder: Path, title: str, sections: Sequence[Section]) -> Path:
    """Writes report.html, which needs nothing but itself."""
    templates = Environment(loader=PackageLoader("qpavoid.arena", "."), autoescape=True, trim_blocks=True)
    templates.filters["svg"] = _svg
    templates.filters["inline"] = _inline
    page = templates.get_template("page.html.j2").render(title=title, sections=sections)
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _svg(figure: Any) -> Markup:
    """A figure as an element of a page."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "qpavoid"}):  # the same picture, the same text
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return Markup(text[text.index("<svg") :])


def _inline(text: str) -> Markup:
    """Text of the Markdown report with its `code` and **stress** as HTML."""
    pieces = text.split("`")
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else _stressed(p) for i, p in enumerate(pieces))


def _stressed(text: str) -> Markup:
    parts = text.split("**")
    return Markup("").join(
        Markup("<b>{}</b>").format(p) if i % 2 else Markup("{}").format(p) for i, p in enumerate(parts)
    )
