"""One page of everything that a command ran: figures, tables and settings, beside the pictures that it shows."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from html import escape
from pathlib import Path

import yaml

from qpavoid.run.log import Log
from qpavoid.run.report import events, rows

FILE = "index.html"
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; margin: 0 auto; max-width: 1180px; padding: 0 1.5em 4em }
h1 { font-size: 1.5em } h2 { font-size: 1.25em; margin-top: 2.5em; border-bottom: 1px solid #ddd }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .25em .8em; text-align: right }
th { font-weight: 600; border-bottom: 1px solid #999; vertical-align: bottom }
td:first-child, th:first-child, td:last-child, th:last-child { text-align: left }
tr:nth-child(even) td { background: #f5f6f8 }
img { max-width: 100%; display: block; margin: .5em auto } pre { background: #f5f6f8; padding: 1em; overflow: auto }
summary { cursor: pointer; font-weight: 600; padding: .3em 0 } nav a { margin-right: 1.2em } .note { color: #555 }
"""


def write_index(logs: Sequence[Log], files: Sequence[Path], folder: Path) -> Path:
    """Write the page of some runs; it needs no server, and no file but the pictures beside it.

    Args:
        logs: the runs.
        files: their figures in `folder`, of `plot_run` and `plot_compare`.
        folder: of the page.
    """
    scenarios = list(dict.fromkeys(log.meta["scenario"] for log in logs))
    links = " ".join(f'<a href="#{escape(name)}">{escape(name)}</a>' for name in scenarios)
    pictures = [file.name for file in files if file.suffix == ".png"]
    sections = [_section([log for log in logs if log.meta["scenario"] == name], pictures) for name in scenarios]
    versions = ", ".join(f"{name} {version}" for name, version in logs[0].meta["versions"].items())
    path = folder / FILE
    own = [f"{log.meta['scenario']}_{log.meta['solver']}.npz".replace(":", "-") for log in logs]
    others = sorted({log.name for log in folder.glob("*.npz")} - set(own))
    text = f"Of {', '.join(own)}, written {datetime.now():%Y-%m-%d %H:%M}."
    text += f" In this folder, too, of other commands: {', '.join(others)}." if others else ""
    path.write_text(
        f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>qpavoid: {escape(", ".join(scenarios))}</title>'
        f"<style>{_STYLE}</style><h1>qpavoid: {len(logs)} run{'s' * (len(logs) > 1)}</h1>"
        f'<p class="note">{escape(text)}</p><nav>{links}</nav>'
        f'{"".join(sections)}<p class="note">{escape(versions)}</p></html>\n',
        encoding="utf-8",
    )
    return path


def _section(logs: Sequence[Log], pictures: Sequence[str]) -> str:
    """Return table, figures and settings of the runs of one scenario."""
    meta, metrics = logs[0].meta, [log.metrics() for log in logs]
    name = str(meta["scenario"])
    headings, cells = rows(metrics)
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in cells)
    parts = [
        f'<h2 id="{escape(name)}">{escape(name)}</h2><p>{escape(str(meta["title"]))} <span class="note">Robot: '
        f"{escape(str(meta['robot']))}. Distances are between surfaces.</span></p>",
        f"<table><tr>{head}</tr>{body}</table>",
        *(_image(f"{name}_compare_{figure}.png", pictures) for figure in ("path", "time")),
    ]
    for log, run in zip(logs, metrics, strict=True):
        solver = str(log.meta["solver"])
        stem = log.stem
        figures = "".join(
            _image(f"{stem}_{figure}.png", pictures)
            for figure in ("motion", "distances", "speeds", "joints", "torques", "contacts")
        )
        lines = "".join(f"<li>{escape(line)}</li>" for line in events(run))
        is_open = " open" * (log is logs[-1])
        parts.append(
            f"<details{is_open}><summary>{escape(name)}, {escape(solver)}</summary>{figures}"
            f"{f'<p>First events:</p><ul>{lines}</ul>' if lines else ''}</details>"
        )
    settings = escape(yaml.safe_dump(meta["config"], sort_keys=False, allow_unicode=True, width=100))
    parts.append(f"<details><summary>settings of {escape(name)}, {escape(str(meta['solver']))}</summary>")
    parts.append(f"<pre>{settings}</pre></details>")
    return "".join(parts)


def _image(file: str, pictures: Sequence[str]) -> str:
    return f'<img src="{escape(file)}" alt="{escape(file)}" loading="lazy">' if file in pictures else ""
