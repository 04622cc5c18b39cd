"""Tables of the reports: Markdown for people, CSV for programs, and the machine that the figures are of."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qpavoid.run.machine import cpu, versions

_OF_CHECKOUT = Path("bench") / "results"
RESULTS = _OF_CHECKOUT if _OF_CHECKOUT.is_dir() else Path("out") / "bench"
"""Folder of results below the working directory, if a command is given no other."""


def table(head: Sequence[str], rows: Iterable[Iterable[Any]], text_columns: int = 1) -> str:
    """Return a Markdown table; columns after the first `text_columns` are set to the right."""
    lines = [head, ["---"] * text_columns + ["---:"] * (len(head) - text_columns), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def number(value: float) -> str:
    """Return a number with three digits at most; `-` for NaN."""
    return "-" if np.isnan(value) else f"{value:.1f}" if abs(value) < 100.0 else f"{value:.0f}"


def describe_machine(*packages: str) -> str:
    """Return processor, cores, system, interpreter and installed packages in one line."""
    python = f"Python {platform.python_version()}"
    result = (f"{name} {number}" for name, number in versions(packages).items())
    return ", ".join((cpu(), f"{os.cpu_count()} CPUs", platform.system(), python, *result)) + "; one thread"


def write(folder: Path, name: str, sections: Iterable[str], rows: Sequence[Mapping[str, Any]] = ()) -> str:
    """Write NAME.md, and NAME.csv if there are rows; return the Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    markdown = "\n\n".join(section for section in sections if section) + "\n"
    (folder / f"{name}.md").write_text(markdown, encoding="utf-8")
    if rows:
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    return markdown
