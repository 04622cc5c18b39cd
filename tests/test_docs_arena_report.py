"""docs/arena_report.md: its sections, figures and numbers are those of the report."""

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("mujoco")

import pandas as pd

from qpavoid_bench.arena.report import comparable_results, report_lines
from qpavoid_bench.arena.scores import COLUMNS
from qpavoid_bench.arena.statistics import CONFIDENCE, duel, mean
from qpavoid_bench.arena.tables import COLUMNS as SHOWN
from qpavoid_bench.arena.tables import MORE

PAGE = (Path(__file__).parent.parent / "docs/arena_report.md").read_text(encoding="utf-8")


def rows_of(heading):
    table = PAGE[PAGE.index(heading) :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table]


def test_its_sections_are_those_of_the_report_in_their_order():
    blank = {"str": "", "int": 1, "float": 0.01, "bool": False}
    run = {name: blank[kind] for name, kind in COLUMNS.items()} | {"family": "…", "entrant": "qp"}
    lines = report_lines(comparable_results(pd.DataFrame([run]), Path()), {})
    titles = [line.removeprefix("## ") for line in lines if line.startswith("## ")]
    assert [name for name, _ in rows_of("| section |")] == titles


def test_its_figures_are_those_of_the_tables():
    kinds = {"rate": "share", "low": "5th percentile"}
    columns = [[column.heading, kinds.get(column.kind, column.kind), column.description] for column in (*SHOWN, *MORE)]
    assert rows_of("| figure |") == columns


def test_its_numbers_are_those_of_the_statistics():
    assert f"with {100 * CONFIDENCE:.0f} %" in PAGE
    assert f"p is not below {1 - CONFIDENCE:.2f}" in PAGE
    # five cases separate no two entrants, six do
    assert not duel(np.ones(5, dtype=bool), np.zeros(5, dtype=bool)).decided
    assert duel(np.ones(6, dtype=bool), np.zeros(6, dtype=bool)).decided
    draw = np.random.default_rng(0)
    held = [low <= 1.0 <= high for _, low, high in (mean(draw.exponential(size=6)) for _ in range(300))]
    assert 0.75 < np.mean(held) < 0.87  # about 8 times in 10
