"""Report of a results folder: entrants, limits of the comparison, and results."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from qpavoid.errors import ConfigError, QpavoidError
from qpavoid_bench.arena import figures
from qpavoid_bench.arena.coverage import missing_results
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family
from qpavoid_bench.arena.pages import write_markdown, write_page
from qpavoid_bench.arena.results import Results, results_of
from qpavoid_bench.arena.statistics import CONFIDENCE, duel, mean
from qpavoid_bench.arena.store import read_failures, read_runs
from qpavoid_bench.arena.suite import describe_entrants
from qpavoid_bench.arena.tables import (
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

COMPARISON_LIMITS = (
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
    "Ratios of less than 1.5 mean little; `qpavoid bench tick` is where libraries are timed side by side.",
    "Distances, contacts and limit violations are MuJoCo's, which runs the commanded velocities again with kinematics "
    "and distances of its own, at the ticks and between them.",
    "Not measured: drives, dynamics and forces; sensors, beyond the delay and noise of a family that says so; memory, "
    "and the time to set up; what a tick that comes late would do, for here every velocity is there in time.",
)


def write_report(folder: Path) -> list[Path]:
    """Write report.md with its figures, and report.html, into a folder of results.

    Raises:
        ConfigError: the folder holds no results, or none that all entrants have.
    """
    facts = _read_facts(folder)
    sections = tuple(report_of(read_runs(folder), facts, folder))
    title = f"Arena: {facts.get('title') or folder.name}"
    return [*write_markdown(folder, title, sections), write_page(folder, title, sections)]


def report_of(runs: pa.Table, facts: dict[str, Any], folder: Path = Path("DIR")) -> Iterator[Section]:
    """Yield the sections of a report.

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
    yield _provenance_section(results, runs, facts)
    yield Section("Limits of the comparison", points=COMPARISON_LIMITS)
    yield _entrants_section(results, facts)
    yield _definitions_section()
    yield _overall_section(results)
    yield _comparison_section(results)
    for index, name in enumerate(results.families):
        yield _family_section(results, index, name)
    yield _worst_runs_section(results, facts, folder)
    yield _failures_section(results)


def _read_facts(folder: Path) -> dict[str, Any]:
    """Read suite.json and the failures of the last sweep."""
    try:
        facts = json.loads((folder / "suite.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        facts = {}
    return {**facts, "failures": read_failures(folder)}


def _provenance_section(results: Results, runs: pa.Table, facts: dict[str, Any]) -> Section:
    """List versions, machine, numbers of runs, and gaps."""
    points = [
        f"{section.capitalize()}: " + ", ".join(f"{name} {value}" for name, value in facts[section].items()) + "."
        for section in ("versions", "machine")
        if facts.get(section)
    ]
    if "workers" in facts:
        points.append(f"Processes at once, in the last sweep: {facts['workers']}.")
    points.append(
        f"{len(runs)} runs: {len(results.entrants)} entrants, {len(results.families)} families, {len(results.cell)} "
        f"cases. All figures are of the {int(results.common.sum())} cases that every entrant has run."
    )
    points += missing_results(results, facts)
    return Section("What this was made on", points=tuple(points))


def _entrants_section(results: Results, facts: dict[str, Any]) -> Section:
    """List entrants with their descriptions and settings."""
    entrant_facts = {**describe_entrants(ENTRANTS.values()), **facts.get("entrants", {})}
    rows = []
    for name, digest in zip(results.entrants, results.settings, strict=True):
        entry = entrant_facts.get(digest, {"says": "", "settings": {}})
        settings = ", ".join(f"{key}: {_json_text(value)}" for key, value in entry["settings"].items())
        rows.append((text_cell(name), text_cell(entry["says"]), text_cell(settings)))
    return Section("Who takes part", tables=(Table(("entrant", "what it is", "its own settings"), tuple(rows)),))


def _definitions_section() -> Section:
    """Define the figures and the ranking."""
    text = (
        f"Ranges with figures hold the true value with {100 * CONFIDENCE:.0f} % over further seeds: of rates that of "
        "Wilson, of means the bootstrap's, of medians that of the sign test. A run that fails counts at its limit and "
        "is never left out: an entrant that raises is held for that tick, and its run goes on.",
        "**Ranking.** By the share of runs that succeed; where that is the same, by the mean tracking error. "
        "Entrants that McNemar's exact test over the same cases cannot separate from the first of a rank, at "
        f"{100 * (1 - CONFIDENCE):.0f} %, share it. With few cases, the test separates little.",
    )
    rows = tuple((text_cell(column.heading), text_cell(column.description)) for column in (*COLUMNS, *MORE))
    return Section("How it is scored", text, tables=(Table(("figure", "what it is"), rows),))


def _overall_section(results: Results) -> Section:
    """Tabulate and draw the results of all families."""
    both = "full points are beaten by no other one in both"
    pictures = (
        ("tracking", f"Safety against tracking: {both}.", figures.safety_against_tracking(results)),
        ("speed", f"Success against the time of a tick: {both}.", figures.success_against_time(results)),
        ("families", "Success by family.", figures.success_by_family(results)),
    )
    return Section("Overall", tables=score_tables(results), pictures=pictures)


def _family_section(results: Results, index: int, name: str) -> Section:
    """Tabulate the results of one family."""
    text, robots = _family_text(name), np.unique(results.values("robot", 0, index).astype(str)).tolist()
    count = int(np.sum(results.common & (results.family == index)))
    if not count:
        return Section(f"Family: {name}", (*text, "No case that all have run."))
    text = (*text, f"{count} cases, on {', '.join(robots)}.")
    return Section(f"Family: {name}", text, tables=score_tables(results, index))


def _family_text(name: str) -> tuple[str, ...]:
    """Return title and purpose of a family, if its file can be read."""
    try:
        config = load_family(name).config
    except QpavoidError:
        return ()
    return (f"{config.title}. {config.about}",)


def _comparison_section(results: Results) -> Section:
    """Compare every entrant with the first of the ranking."""
    success, tracking = results.table("success").astype(bool), results.table("tracking_error")
    first = next(iter(results.ranking()))
    best = results.entrants.index(first)
    rows = []
    for i, name in enumerate(results.entrants):
        if i != best:
            d = duel(success[:, best], success[:, i])
            difference = interval_cell(mean(tracking[:, i] - tracking[:, best]), 1e3, 1)
            cells = count_cell(d.only_first), count_cell(d.only_second), Cell(f"{d.p:.2g}", d.p), difference
            rows.append((text_cell(name), *cells))
    headings = ("entrant", f"only {first} succeeds", "only this one does", "p of no difference", "more tracking [mm]")
    text = (
        f"Case by case against {first}, first of the ranking: in how many cases only one of the two does, and how "
        "much larger the tracking error is.",
    )
    return Section("Beside the best", text, tables=(Table(headings, tuple(rows)),) if rows else ())


_MAX_ROWS = 3


def _worst_runs_section(results: Results, facts: dict[str, Any], folder: Path) -> Section:
    """List the worst runs of each entrant."""
    rows, entrant_facts = [], facts.get("entrants", {})
    for entrant, name in enumerate(results.entrants):
        file = entrant_facts.get(results.settings[entrant], {"settings": {}})["settings"].get("file", "")
        index = results.rows_of(entrant)
        index = index[~results.columns["success"][index].astype(bool)]
        collided, distance, error = (results.columns[c][index] for c in ("collided", "min_distance", "final_error"))
        worst = index[np.lexsort((-error, np.where(collided, distance, 0.0), ~collided.astype(bool)))[:_MAX_ROWS]]
        for row in (results.row(i) for i in worst.tolist()):
            place = text_cell(row["family"]), count_cell(row["seed"]), text_cell(row["robot"])
            command = Cell(rerun_line(row, folder, file), name, code=True)
            rows.append((text_cell(name), *place, text_cell(_failure_text(row)), command))
    headings = ("entrant", "family", "seed", "robot", "what went wrong", "run it again")
    text = (
        f"The {_MAX_ROWS} worst runs of each entrant without success: deepest contacts first, then by final error.",
    )
    return Section("Worst runs", text if rows else ("None.",), tables=(Table(headings, tuple(rows)),) if rows else ())


def _failure_text(row: dict[str, Any]) -> str:
    """Describe how a run failed."""
    if row["collided"]:
        verdict = f"; {row['verdict']}" if row["verdict"] else ""
        return f"{row['contacts']} contacts, {max(0.0, -1e3 * row['min_distance']):.1f} mm deep{verdict}"
    if row["reachable"]:
        return f"{1e3 * row['final_error']:.0f} mm short of its goal{', stuck' if row['stuck'] else ''}"
    return "not at rest at the end"


def rerun_line(row: dict[str, Any], folder: Path, file: str = "") -> str:
    """Return the command that runs one row once more.

    Args:
        row: the run.
        folder: of the results.
        file: that the entrant came from, where it does not ship.
    """
    entrant = f"{file}:{row['entrant']}" if file else row["entrant"]
    case = ("--family", row["family"], "--seed", row["seed"])
    return shlex.join(map(str, ("qpavoid", "bench", "show", folder, *case, "--entrant", entrant)))


def _failures_section(results: Results) -> Section:
    """List the first failures of entrants, with their counts."""
    rows = []
    for entrant, name in enumerate(results.entrants):
        entrant_facts = results.columns["failure"][results.rows_of(entrant)]
        often = Counter(sorted(entrant_facts[entrant_facts != ""])).most_common(_MAX_ROWS)
        rows += [(text_cell(name), count_cell(count), text_cell(text)) for text, count in often]
    headings = ("entrant", "runs", "the first thing that it said")
    return Section("Failures", () if rows else ("None.",), tables=(Table(headings, tuple(rows)),) if rows else ())


def _json_text(value: Any) -> str:
    """Return a value as JSON without quotes."""
    return json.dumps(value, ensure_ascii=False).replace('"', "")
