"""The report of a results folder: what was compared, within which limits, and what came out."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from qpavoid.arena import figures
from qpavoid.arena.coverage import gaps
from qpavoid.arena.entrants import ENTRANTS
from qpavoid.arena.families import load_family
from qpavoid.arena.pages import write_markdown, write_page
from qpavoid.arena.results import Results, results_of
from qpavoid.arena.statistics import CONFIDENCE, duel, mean
from qpavoid.arena.store import read_failures, read_runs
from qpavoid.arena.suite import facts_of
from qpavoid.arena.tables import (
    COLUMNS,
    MORE,
    Cell,
    Section,
    Table,
    count_cell,
    interval_cell,
    score_tables,
    text_cell,
)
from qpavoid.errors import ConfigError, QpavoidError

LIMITS = (
    "Velocities are followed exactly: no delay, no tracking error of a drive, no dynamics. What a real arm adds is the "
    "same for all, and in none of the figures.",
    "All entrants of this library see the same problem, tick by tick: the same kinematics, distances, task gains, d1 "
    "and d2. What a law does with d1 and d2 is its own: `eq10` settles at about d2/2 when the tool itself is in the "
    "way, the QPs hold d1.",
    "Laws without limits of their own are scaled to the joints' limits by the controller. No entrant plans: a way that "
    "leads round by going back is out of reach for all, though a planner has shown that there is one.",
    "Other libraries are in their documented default use; nothing is tuned for or against them. Targets are given to "
    "them one period ahead, as a task of this library would have it; of obstacles they know where these are, not how "
    "they move.",
    "Times are those of whole ticks, from state to velocity, on the machine above, with that many processes at once. "
    "Ratios of less than 1.5 mean little; `bench/tick` is where libraries are timed side by side.",
    "Distances, contacts and limit violations are MuJoCo's, which plays the commanded velocities again with kinematics "
    "and distances of its own, at the ticks and between them.",
    "Not measured: drives, dynamics and forces; sensors, beyond the delay and noise of a family that says so; memory, "
    "and the time to set up; what a tick that comes late would do, for here every velocity is there in time.",
)


def write_report(folder: Path) -> list[Path]:
    """Writes report.md with its pictures, and report.html, into a folder of results.

    Raises:
        ConfigError: the folder holds no results, or none that all entrants have.
    """
    facts = _facts(folder)
    sections = tuple(report_of(read_runs(folder), facts, folder))
    title = f"Arena: {facts.get('title') or folder.name}"
    return [*write_markdown(folder, title, sections), write_page(folder, title, sections)]


def report_of(runs: pa.Table, facts: dict[str, Any], folder: Path = Path("DIR")) -> Iterator[Section]:
    """The report's sections.

    Args:
        runs: rows of `scores.Score`.
        facts: what suite.json says.
        folder: of the results, for the commands that run something again.

    Raises:
        ConfigError: no runs, or no case that all entrants have run.
    """
    if not len(runs):
        raise ConfigError(f"{folder}: there are no runs to report; `qpavoid bench run` makes some")
    results = results_of(runs, tuple(ENTRANTS))
    if not results.common.any():
        counts = [len(results.rows_of(i)) for i in range(len(results.entrants))]
        least = results.entrants[int(np.argmin(counts))]
        raise ConfigError(
            f"{folder}: no case was run by all of {', '.join(results.entrants)}, {least} has run the fewest "
            f"({min(counts)} of {len(results.cell)}); let the suite end first"
        )
    yield _made_on(results, runs, facts)
    yield Section("Limits of the comparison", points=LIMITS)
    yield _taking_part(results, facts)
    yield _definitions()
    yield _overall(results)
    yield _duels(results)
    for index, name in enumerate(results.families):
        yield _family(results, index, name)
    yield _worst(results, facts, folder)
    yield _failures(results)


def _facts(folder: Path) -> dict[str, Any]:
    """What suite.json says, and what the last sweep could not make or run."""
    try:
        facts = json.loads((folder / "suite.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        facts = {}
    return {**facts, "failures": read_failures(folder)}


def _made_on(results: Results, runs: pa.Table, facts: dict[str, Any]) -> Section:
    points = [
        f"{what.capitalize()}: " + ", ".join(f"{name} {value}" for name, value in facts[what].items()) + "."
        for what in ("versions", "machine")
        if facts.get(what)
    ]
    if "workers" in facts:
        points.append(f"Processes at once, in the last sweep: {facts['workers']}.")
    points.append(
        f"{len(runs)} runs: {len(results.entrants)} entrants, {len(results.families)} families, {len(results.cell)} "
        f"cases. All figures are of the {int(results.common.sum())} cases that every entrant has run."
    )
    points += gaps(results, facts)
    return Section("What this was made on", points=tuple(points))


def _taking_part(results: Results, facts: dict[str, Any]) -> Section:
    said = {**facts_of(ENTRANTS.values()), **facts.get("entrants", {})}
    rows = []
    for name, digest in zip(results.entrants, results.settings, strict=True):
        entry = said.get(digest, {"says": "", "settings": {}})
        settings = ", ".join(f"{key}: {_plain(value)}" for key, value in entry["settings"].items())
        rows.append((text_cell(name), text_cell(entry["says"]), text_cell(settings)))
    return Section("Who takes part", tables=(Table(("entrant", "what it is", "its own settings"), tuple(rows)),))


def _definitions() -> Section:
    text = (
        f"Ranges with figures hold the true value with {100 * CONFIDENCE:.0f} % over further seeds: of rates that of "
        "Wilson, of means the bootstrap's, of medians that of the sign test. A run that fails counts at its limit and "
        "is never left out: an entrant that raises is held for that tick, and its run goes on.",
        "**Ranking.** By the share of runs that succeed; where that is the same, by the mean tracking error. Whoever "
        "cannot be told from the first of a rank by McNemar's exact test over the same cases, at "
        f"{100 * (1 - CONFIDENCE):.0f} %, shares it. With few cases, little can be told apart.",
    )
    rows = tuple((text_cell(column.heading), text_cell(column.says)) for column in (*COLUMNS, *MORE))
    return Section("How it is scored", text, tables=(Table(("figure", "what it is"), rows),))


def _overall(results: Results) -> Section:
    both = "full points are beaten by nobody in both"
    pictures = (
        ("tracking", f"Safety against tracking: {both}.", figures.safety_against_tracking(results)),
        ("speed", f"Success against the time of a tick: {both}.", figures.success_against_time(results)),
        ("families", "Success by family.", figures.success_by_family(results)),
    )
    return Section("Overall", tables=score_tables(results), pictures=pictures)


def _family(results: Results, index: int, name: str) -> Section:
    text, robots = _about(name), np.unique(results.values("robot", 0, index).astype(str)).tolist()
    count = int(np.sum(results.common & (results.family == index)))
    if not count:
        return Section(f"Family: {name}", (*text, "No case that all have run."))
    text = (*text, f"{count} cases, on {', '.join(robots)}.")
    return Section(f"Family: {name}", text, tables=score_tables(results, index))


def _about(name: str) -> tuple[str, ...]:
    """What a family is about, where its file is still at hand."""
    try:
        config = load_family(name).config
    except QpavoidError:
        return ()
    return (f"{config.title}. {config.about}",)


def _duels(results: Results) -> Section:
    """Everybody against the first of the ranking."""
    success, tracking = results.table("success").astype(bool), results.table("tracking_error")
    first = next(iter(results.ranking()))
    best = results.entrants.index(first)
    rows = []
    for i, name in enumerate(results.entrants):
        if i != best:
            d = duel(success[:, best], success[:, i])
            more = interval_cell(mean(tracking[:, i] - tracking[:, best]), 1e3, 1)
            cells = count_cell(d.only_first), count_cell(d.only_second), Cell(f"{d.p:.2g}", d.p), more
            rows.append((text_cell(name), *cells))
    headings = ("entrant", f"only {first} succeeds", "only this one does", "p of no difference", "more tracking [mm]")
    text = (
        f"Case by case against {first}, first of the ranking: in how many cases only one of the two does, and how "
        "much larger the tracking error is.",
    )
    return Section("Beside the best", text, tables=(Table(headings, tuple(rows)),) if rows else ())


_LISTED = 3


def _worst(results: Results, facts: dict[str, Any], folder: Path) -> Section:
    rows, told = [], facts.get("entrants", {})
    for entrant, name in enumerate(results.entrants):
        file = told.get(results.settings[entrant], {"settings": {}})["settings"].get("file", "")
        index = results.rows_of(entrant)
        index = index[~results.columns["success"][index].astype(bool)]
        collided, distance, error = (results.columns[c][index] for c in ("collided", "min_distance", "final_error"))
        worst = index[np.lexsort((-error, np.where(collided, distance, 0.0), ~collided.astype(bool)))[:_LISTED]]
        for row in (results.row(i) for i in worst.tolist()):
            where = text_cell(row["family"]), count_cell(row["seed"]), text_cell(row["robot"])
            again = Cell(rerun_line(row, folder, file), name, code=True)
            rows.append((text_cell(name), *where, text_cell(_went_wrong(row)), again))
    headings = ("entrant", "family", "seed", "robot", "what went wrong", "run it again")
    text = (
        f"The {_LISTED} worst runs of each entrant that did not succeed: deepest contacts first, then by final error.",
    )
    return Section("Worst runs", text if rows else ("None.",), tables=(Table(headings, tuple(rows)),) if rows else ())


def _went_wrong(row: dict[str, Any]) -> str:
    if row["collided"]:
        return f"{row['contacts']} contacts, {max(0.0, -1e3 * row['min_distance']):.1f} mm deep"
    if row["reachable"]:
        return f"{1e3 * row['final_error']:.0f} mm short of its goal{', stuck' if row['stuck'] else ''}"
    return "not at rest at the end"


def rerun_line(row: dict[str, Any], folder: Path, file: str = "") -> str:
    """The command that runs one row once more.

    Args:
        row: the run.
        folder: of the results.
        file: that the entrant came from, where it does not ship.
    """
    entrant = f"{file}:{row['entrant']}" if file else row["entrant"]
    case = ("--family", row["family"], "--seed", row["seed"])
    return shlex.join(map(str, ("qpavoid", "bench", "show", folder, *case, "--entrant", entrant)))


def _failures(results: Results) -> Section:
    """What entrants said when they failed, with how often."""
    rows = []
    for entrant, name in enumerate(results.entrants):
        said = results.columns["failure"][results.rows_of(entrant)]
        often = Counter(sorted(said[said != ""])).most_common(_LISTED)
        rows += [(text_cell(name), count_cell(count), text_cell(text)) for text, count in often]
    headings = ("entrant", "runs", "the first thing that it said")
    return Section("Failures", () if rows else ("None.",), tables=(Table(headings, tuple(rows)),) if rows else ())


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False).replace('"', "")
