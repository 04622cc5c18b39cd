"""The report of a results folder: what was compared, within which limits, and what came out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from qpavoid.arena import figures
from qpavoid.arena.entrants import ENTRANTS
from qpavoid.arena.families import load_family
from qpavoid.arena.pages import write_markdown, write_page
from qpavoid.arena.results import Results, results_of
from qpavoid.arena.statistics import CONFIDENCE, duel, ranks
from qpavoid.arena.store import read_runs
from qpavoid.arena.tables import COLUMNS, MORE, Cell, Section, Table, score_table, text_cell
from qpavoid.errors import ConfigError, QpavoidError

LIMITS = (
    "Velocities are followed exactly: no delay, no tracking error of a drive, no dynamics. What a real arm adds is the "
    "same for all, and in none of the figures.",
    "All entrants of this library see the same problem, tick by tick: the same kinematics, distances, task gains, d1 "
    "and d2. What a law does with d1 and d2 is its own: `eq10` settles at about d2/2 when the tool itself is in the "
    "way, the QPs hold d1.",
    "Laws without limits of their own are scaled to the joints' limits by the controller. No entrant plans: a way that "
    "leads round by going back is out of reach for all, though a planner has shown that there is one.",
    "Other libraries are in their documented default use; nothing is tuned for or against them. They do not know the "
    "velocities of obstacles, or of targets, unless their interface takes them.",
    "Times are those of whole ticks, from state to velocity, on the machine above with as many processes at once as it "
    "has cores. Ratios of less than 1.5 mean little; `bench/tick` is where libraries are timed side by side.",
    "Distances, contacts and limit violations are MuJoCo's, which plays the commanded velocities again with kinematics "
    "and distances of its own, at the ticks and between them.",
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
        raise ConfigError(f"{folder}: no case was run by all of {', '.join(results.entrants)}; let the suite end first")
    yield _made_on(results, runs, facts)
    yield Section("Limits of the comparison", points=LIMITS)
    yield _taking_part(results, facts)
    yield _definitions()
    yield _overall(results)
    yield _duels(results)
    for index, name in enumerate(results.families):
        yield _family(results, index, name)
    yield _worst(results, folder)
    yield _failures(results)


def _facts(folder: Path) -> dict[str, Any]:
    try:
        facts = json.loads((folder / "suite.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}


def _made_on(results: Results, runs: pa.Table, facts: dict[str, Any]) -> Section:
    count = int(results.common.sum())
    points = [
        f"{len(runs)} runs: {len(results.entrants)} entrants, {len(results.families)} families, {len(results.cell)} "
        f"cases. All figures are of the {count} cases that every entrant has run."
    ]
    points += [
        f"{name} has not run {n} cases of {family}, which count for nobody." for name, family, n in results.missing()
    ]
    if results.replaced:
        points.append(f"{results.replaced} rows are of older versions or settings; the newest ones count.")
    machine, versions = facts.get("machine", {}), facts.get("versions", {})
    if machine:
        points.append("Machine: " + ", ".join(f"{name} {value}" for name, value in machine.items()) + ".")
    if versions:
        points.append("Versions: " + ", ".join(f"{name} {value}" for name, value in versions.items()) + ".")
    return Section("What this was made on", points=tuple(points))


def _taking_part(results: Results, facts: dict[str, Any]) -> Section:
    said = {entry["name"]: entry for entry in facts.get("entrants", {}).values()}
    rows = []
    for name in results.entrants:
        entry = said.get(name) or {}
        settings = ", ".join(f"{key}: {_plain(value)}" for key, value in (entry.get("settings") or {}).items())
        rows.append((text_cell(name), text_cell(entry.get("says", "")), text_cell(settings)))
    return Section("Who takes part", tables=(Table(("entrant", "what it is", "its own settings"), tuple(rows)),))


def _definitions() -> Section:
    text = (
        f"Ranges behind figures hold the true value with {100 * CONFIDENCE:.0f} % over further seeds: of rates that of "
        "Wilson, of means the bootstrap's. A run that fails counts at its limit and is never left out: an entrant that "
        "raises is held for that tick, and its run goes on.",
        "**Ranking.** By the share of runs that succeed. Whoever cannot be told from the first of a rank by McNemar's "
        f"exact test over the same cases, at {100 * (1 - CONFIDENCE):.0f} %, shares it.",
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
    tables = (score_table(results, COLUMNS), score_table(results, MORE))
    return Section("Overall", tables=tables, pictures=pictures)


def _family(results: Results, index: int, name: str) -> Section:
    text, robots = _about(name), np.unique(results.values("robot", 0, index).astype(str)).tolist()
    count = int(np.sum(results.common & (results.family == index)))
    if not count:
        return Section(f"Family: {name}", (*text, "No case that all have run."))
    text = (*text, f"{count} cases, on {', '.join(robots)}.")
    tables = score_table(results, COLUMNS, index), score_table(results, MORE, index)
    return Section(f"Family: {name}", text, tables=tables)


def _about(name: str) -> tuple[str, ...]:
    """What a family is about, where its file is still at hand."""
    try:
        config = load_family(name).config
    except QpavoidError:
        return ()
    return (f"{config.title}. {config.about}",)


def _duels(results: Results) -> Section:
    """Everybody against the one that succeeds most often."""
    success = results.table("success").astype(bool)
    best = results.entrants.index(next(iter(ranks(success, results.entrants))))
    rows = []
    for i, name in enumerate(results.entrants):
        if i != best:
            d = duel(success[:, best], success[:, i])
            numbers = (Cell(str(d.only_first), d.only_first), Cell(str(d.only_second), d.only_second))
            rows.append((text_cell(name), *numbers, Cell(f"{d.p:.2g}", d.p)))
    first = results.entrants[best]
    headings = ("entrant", f"only {first} succeeds", "only this one does", "p of no difference")
    text = (f"Case by case against {first}, which succeeds most often: in how many cases only one of the two does.",)
    return Section("Beside the best", text, tables=(Table(headings, tuple(rows)),))


_LISTED = 3


def _worst(results: Results, folder: Path) -> Section:
    rows = []
    for entrant in range(len(results.entrants)):
        index = results.cell[:, entrant]
        index = index[index >= 0]
        deepest = index[np.argsort(results.columns["min_distance"][index], kind="stable")[:_LISTED]]
        for row in (results.row(i) for i in deepest.tolist() if results.columns["collided"][i]):
            depth = -1e3 * row["min_distance"]
            where = text_cell(row["family"]), Cell(str(row["seed"]), row["seed"]), text_cell(row["robot"])
            cells = text_cell(row["entrant"]), *where, Cell(f"{depth:.1f}", depth)
            rows.append((*cells, text_cell(rerun_line(row, folder))))
    headings = ("entrant", "family", "seed", "robot", "deepest [mm]", "run it again")
    text = (f"The {_LISTED} deepest contacts of each entrant.",)
    return Section("Worst runs", text, tables=(Table(headings, tuple(rows)),) if rows else ())


def rerun_line(row: dict[str, Any], folder: Path) -> str:
    """The command that runs one row once more."""
    return f"qpavoid bench show {folder} --family {row['family']} --seed {row['seed']} --entrant {row['entrant']}"


def _failures(results: Results) -> Section:
    """What entrants said when they failed, with how often."""
    rows = []
    for entrant, name in enumerate(results.entrants):
        index = results.cell[:, entrant]
        said = results.columns["failure"][index[index >= 0]].astype(str)
        texts, counts = np.unique(said[said != ""], return_counts=True)
        often = np.argsort(-counts, kind="stable")[:_LISTED].tolist()
        rows += [(text_cell(name), Cell(str(counts[i]), int(counts[i])), text_cell(texts[i])) for i in often]
    headings = ("entrant", "runs", "the first thing that it said")
    return Section("Failures", () if rows else ("None.",), tables=(Table(headings, tuple(rows)),) if rows else ())


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False).replace('"', "")
