"""Report of a results folder: entrants, limits of the comparison, and results."""

from __future__ import annotations

import json
import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from qpavoid.errors import ConfigError, QpavoidError
from qpavoid_bench.arena import figures
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family
from qpavoid_bench.arena.results import Results, results_of
from qpavoid_bench.arena.statistics import CONFIDENCE, duel, mean
from qpavoid_bench.arena.store import read_facts, read_failures, read_runs
from qpavoid_bench.arena.suite import describe_entrants
from qpavoid_bench.arena.tables import (
    better_than,
    code,
    escape,
    groups_of,
    has_motors,
    interval_text,
    markdown_table,
    score_tables,
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
MOTORS_LIMITS = (
    "Robots have torque motors in MuJoCo, with masses, friction and delays that the controller does not know. "
    "Distances and contacts are MuJoCo's where the robot was at its control steps; obstacles push nothing. Of a law "
    "without bounds, the velocity is approached at the tracking rate, and its inverse dynamics are commanded, cut at "
    "their limits; of a robot that stands, the nearest velocity that torques and friction cones allow."
)
"""What holds in place of the first of these where robots have motors."""
_MAX_ROWS = 3
"""Worst runs, and failures, that are listed of each entrant."""
_MAX_SEEDS_SHOWN = 5
_FIGURES = (
    (figures.safety_against_tracking, "tracking", "Safety against tracking: full points are beaten by none in both."),
    (
        figures.success_against_time,
        "speed",
        "Success against the time of a tick: full points are beaten by none in both.",
    ),
    (figures.success_by_family, "families", "Success by family."),
)
"""Figures of a report: function, name of its file, caption."""


def write_report(folder: Path) -> list[Path]:
    """Write report.md and its figures into a folder of results.

    Raises:
        ConfigError: the folder holds no results, or none that all entrants have.
    """
    facts = {**read_facts(folder), "failures": read_failures(folder)}
    results = comparable_results(read_runs(folder), folder)
    paths = [folder / "report.md", *(folder / f"report-{name}.png" for _, name, _ in _FIGURES)]
    text = "\n".join([f"# Arena: {facts.get('title') or folder.name}", "", *report_lines(results, facts, folder)])
    for path, (draw, _, _) in zip(paths[1:], _FIGURES, strict=True):
        draw(results).savefig(path, dpi=110)
    paths[0].write_text(text, encoding="utf-8")
    return paths


def comparable_results(runs: pd.DataFrame, folder: Path) -> Results:
    """Arrange runs for a report.

    Raises:
        ConfigError: no runs, or no case that all entrants have run.
    """
    if not len(runs):
        raise ConfigError(f"{folder}: there are no runs to report; `qpavoid bench run` makes some")
    results = results_of(runs, tuple(ENTRANTS))
    if results.common.empty:
        counts = results.runs["entrant"].value_counts()
        raise ConfigError(
            f"{folder}: no case was run by all of {', '.join(results.entrants)}, {counts.idxmin()} has run the fewest "
            f"({counts.min()} of {results.cases}); let the suite end first"
        )
    return results


def report_lines(results: Results, facts: Mapping[str, Any], folder: Path = Path("DIR")) -> Iterator[str]:
    """Yield the lines of a report, without its title.

    Args:
        results: what there is.
        facts: of the last sweep, and its `failures`; whatever they lack is not asked for.
        folder: of the results, for the commands that run something again.
    """
    sections = {
        "What this was made on": [f"- {point}" for point in _provenance(results, facts)],
        "Limits of the comparison": [f"- {point}" for point in _limits(results)],
        "Who takes part": _entrants(results, facts),
        "How it is scored": _definitions(results),
        "Overall": [*(f"![{caption}](report-{name}.png)\n" for _, name, caption in _FIGURES), *score_tables(results)],
        "Beside the best": _beside_the_best(results),
        **({"Where others are better than qp": better_than(results, "qp")} if "qp" in results.entrants else {}),
        **{f"Family: {name}": _family(results, name) for name in results.families},
        "Worst runs": _worst_runs(results, facts, folder) or ["None."],
        "Failures": _failures(results) or ["None."],
    }
    for title, lines in sections.items():
        yield from (f"## {title}", "", *lines, "")


def _limits(results: Results) -> tuple[str, ...]:
    """Return what the comparison does not tell."""
    return (MOTORS_LIMITS, *COMPARISON_LIMITS[1:3]) if has_motors(results) else COMPARISON_LIMITS


def _provenance(results: Results, facts: Mapping[str, Any]) -> Iterator[str]:
    """List versions, machine, numbers of runs, and everything that is not as the suite asks."""
    for name in ("versions", "machine"):
        if facts.get(name):
            yield f"{name.capitalize()}: {', '.join(f'{key} {value}' for key, value in facts[name].items())}."
    if "workers" in facts:
        yield f"Processes at once, in the last sweep: {facts['workers']}."
    yield (
        f"{len(results.runs) + results.replaced} runs: {len(results.entrants)} entrants, {len(results.families)} "
        f"families, {results.cases} cases. All figures are of the {results.common['case'].nunique()} cases that every "
        "entrant has run."
    )
    seeds = results.runs["seed"] - facts.get("first_seed", 0)
    in_suite = results.runs[(seeds >= 0) & (seeds < facts.get("seeds", 0))]
    for family in facts.get("families", ()):
        missing = facts["seeds"] - in_suite.loc[in_suite["family"] == family, "seed"].nunique()
        if missing:
            yield f"No entrant has run {missing} of the {facts['seeds']} cases of {family} that the suite asks for."
    for name, family, count in results.missing():
        yield f"{name} has not run {count} cases of {family}, which count for no entrant."
    for name, packages in facts.get("absent", {}).items():
        if name not in results.entrants:
            yield f"{name} does not take part: it needs {', '.join(packages)}."
    for name in sorted({entry["name"] for entry in facts.get("entrants", {}).values()} - set(results.entrants)):
        yield f"{name} was to take part, and has no run."
    failed_seeds = defaultdict(list)
    for failure in facts.get("failures", ()):
        failed_seeds[failure["family"], failure["entrant"], failure["failure"]].append(str(failure["seed"]))
    for (family, entrant, message), failed in failed_seeds.items():
        outcome = "could not be made" if entrant is None else f"could not be run by {entrant}"
        shown = ", ".join(failed[:_MAX_SEEDS_SHOWN]) + ", …" * (len(failed) > _MAX_SEEDS_SHOWN)
        yield f"{family}, seed {shown}: {outcome}: {code(message.replace('`', chr(39)))}"
    versions = results.runs.groupby("entrant")["version"].first()
    if versions.nunique() > 1:
        listed = ", ".join(f"{name} {versions[name]}" for name in results.entrants)
        yield f"**Entrants ran with different versions of qpavoid**: {listed}."
    if results.replaced:
        yield (
            f"{results.replaced} rows count for nothing: an entrant has run with other settings or another version "
            "since, or the family has been changed."
        )
    if results.bounded:
        yield f"{results.bounded} figures were infinite or no numbers: they stand at the worst of all runs."


def _entrants(results: Results, facts: Mapping[str, Any]) -> list[str]:
    """Tabulate entrants with their descriptions and settings."""
    known = {**describe_entrants(ENTRANTS.values()), **facts.get("entrants", {})}
    digests, rows = results.runs.groupby("entrant")["settings"].first(), []
    for name in results.entrants:
        entry = known.get(digests[name], {"says": "", "settings": {}})
        settings = ", ".join(
            f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in entry["settings"].items()
        )
        rows.append((escape(name), escape(entry["says"]), escape(settings.replace('"', ""))))
    return markdown_table(("entrant", "what it is", "its own settings"), rows)


def _definitions(results: Results) -> list[str]:
    """Define the figures and the ranking."""
    return [
        f"Ranges with figures hold the true value with {100 * CONFIDENCE:.0f} % over further seeds: of rates that of "
        "Wilson, of means the bootstrap's, of medians that of the sign test. A run that fails counts at its limit and "
        "is never left out: an entrant that raises is held for that tick, and its run goes on.",
        "",
        "**Ranking.** By the share of runs that succeed; where that is the same, by the mean tracking error. "
        "Entrants that McNemar's exact test over the same cases cannot separate from the first of a rank, at "
        f"{100 * (1 - CONFIDENCE):.0f} %, share it. With few cases, the test separates little.",
        "",
        *markdown_table(
            ("figure", "what it is"),
            [(escape(column.heading), escape(column.description)) for group in groups_of(results) for column in group],
        ),
    ]


def _beside_the_best(results: Results) -> list[str]:
    """Compare every entrant with the first of the ranking."""
    success, tracking = results.table("success").astype(bool), results.table("tracking_error")
    first = next(iter(results.ranking()))
    best = results.entrants.index(first)
    rows = []
    for i, name in enumerate(results.entrants):
        if i != best:
            d = duel(success[:, best], success[:, i])
            difference = interval_text(mean(tracking[:, i] - tracking[:, best]), 1e3, 1)
            rows.append((escape(name), d.only_first, d.only_second, f"{d.p:.2g}", difference))
    headings = (
        "entrant", f"only {escape(first)} succeeds", "only this one does", "p of no difference", "more tracking [mm]"
    )  # fmt: skip
    text = (
        f"Case by case against {escape(first)}, first of the ranking: in how many cases only one of the two does, and "
        "how much larger the tracking error is."
    )
    return [text, "", *markdown_table(headings, rows)]


def _family(results: Results, name: str) -> list[str]:
    """Tabulate the results of one family, under its title and purpose if its file can be read."""
    try:
        config = load_family(name).config
        text = [f"{config.title}. {config.about}", ""]
    except QpavoidError:
        text = []
    runs = results.common[results.common["family"] == name]
    if runs.empty:
        return [*text, "No case that all have run."]
    text += [f"{runs['case'].nunique()} cases, on {', '.join(sorted(runs['robot'].unique()))}.", ""]
    return text + score_tables(results, name)


def _worst_runs(results: Results, facts: Mapping[str, Any], folder: Path) -> list[str]:
    """Tabulate the worst runs of each entrant."""
    rows = []
    for name in results.entrants:
        own = results.runs[(results.runs["entrant"] == name) & ~results.runs["success"]]
        depth = np.where(own["collided"], own["min_distance"], 0.0)
        worst = own.iloc[np.lexsort((-own["final_error"], depth, ~own["collided"]))[:_MAX_ROWS]]
        for row in worst.to_dict("records"):
            entry = facts.get("entrants", {}).get(row["settings"], {"settings": {}})
            command = rerun_line(row, folder, entry["settings"].get("file", ""))
            rows.append(
                (*map(escape, (name, row["family"], str(row["seed"]), row["robot"], _fault(row))), code(command))
            )
    text = f"The {_MAX_ROWS} worst runs of each entrant without success: deepest contacts first, then by final error."
    table = markdown_table(("entrant", "family", "seed", "robot", "what went wrong", "run it again"), rows)
    return [text, "", *table] if rows else []


def _fault(run: Mapping[Any, Any]) -> str:
    """Describe how a run failed."""
    if run["collided"]:
        verdict = f"; {run['verdict']}" if run["verdict"] else ""
        return f"{run['contacts']} contacts, {max(0.0, -1e3 * run['min_distance']):.1f} mm deep{verdict}"
    if run["reachable"]:
        return f"{1e3 * run['final_error']:.0f} mm short of its goal{', stuck' if run['stuck'] else ''}"
    return "not at rest at the end"


def rerun_line(run: Mapping[Any, Any], folder: Path, file: str = "") -> str:
    """Return the command that runs one row once more.

    Args:
        run: the row.
        folder: of the results.
        file: that the entrant came from, where it does not ship.
    """
    entrant = f"{file}:{run['entrant']}" if file else run["entrant"]
    case = ("--family", run["family"], "--seed", run["seed"])
    return shlex.join(map(str, ("qpavoid", "bench", "show", folder, *case, "--entrant", entrant)))


def _failures(results: Results) -> list[str]:
    """Tabulate the first failures of entrants, with their counts."""
    rows = []
    for name in results.entrants:
        texts = results.runs.loc[(results.runs["entrant"] == name) & (results.runs["failure"] != ""), "failure"]
        rows += [(escape(name), n, escape(text)) for text, n in texts.value_counts().head(_MAX_ROWS).items()]
    return markdown_table(("entrant", "runs", "the first thing that it said"), rows)
