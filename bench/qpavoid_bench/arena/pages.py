"""Report writers: Markdown with figures beside it, and one self-contained page of HTML."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from qpavoid_bench.arena.tables import Cell, Section


def write_markdown(folder: Path, title: str, sections: Sequence[Section]) -> list[Path]:
    """Write report.md and its figures."""
    paths, lines = [], [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for text in section.text:
            lines += [text, ""]
        lines += [f"- {point}" for point in section.points] + [""] * bool(section.points)
        for name, caption, figure in section.pictures:
            path = folder / f"report-{name}.png"
            figure.savefig(path, dpi=110)
            paths.append(path)
            lines += [f"![{caption}]({path.name})", ""]
        for table in section.tables:
            lines += [_markdown_row(table.headings), _markdown_row(["---"] * len(table.headings))]
            lines += [_markdown_row([_escape_cell(cell) for cell in row]) for row in table.rows] + [""]
    path = folder / "report.md"
    path.write_text("\n".join(lines), encoding="utf-8")
    return [path, *paths]


def _markdown_row(cells: Sequence[str]) -> str:
    """Return a row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def _escape_cell(cell: Cell) -> str:
    """Escape a cell's text so that a Markdown table shows it as it is."""
    text = " ".join(cell.text.split())
    if cell.code:
        return f"`{text.replace('|', chr(92) + '|')}`"
    text = re.sub(r"([\\`*_<>\[\]|~])", r"\\\1", text)
    return f"{text} ({cell.span})" if cell.span else text


def write_page(folder: Path, title: str, sections: Sequence[Section]) -> Path:
    """Write report.html, which needs no other file."""
    templates = Environment(loader=PackageLoader("qpavoid_bench.arena", "."), autoescape=True, trim_blocks=True)
    templates.filters["svg"] = _svg
    templates.filters["inline"] = _to_html
    page = templates.get_template("page.html.j2").render(title=title, sections=sections)
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _svg(figure: Any) -> Markup:
    """Return a figure as an SVG element of a page."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "qpavoid"}):  # the same picture, the same text
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return Markup(text[text.index("<svg") :])


def _to_html(text: str) -> Markup:
    """Convert text of the Markdown report with its `code` and **stress** to HTML."""
    pieces = text.split("`")
    return Markup("").join(
        Markup("<code>{}</code>").format(p) if i % 2 else _emphasize(p) for i, p in enumerate(pieces)
    )


def _emphasize(text: str) -> Markup:
    """Convert **stress** to HTML."""
    parts = text.split("**")
    return Markup("").join(
        Markup("<b>{}</b>").format(p) if i % 2 else Markup("{}").format(p) for i, p in enumerate(parts)
    )
