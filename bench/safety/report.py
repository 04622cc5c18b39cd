"""The report: Markdown for people, CSV for programs."""

from __future__ import annotations

import csv
import os
import platform
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.safety.campaign import KINDS, RANGES
from bench.safety.trial import Trial
from bench.safety.verdict import PROOF_TIME, RESOLUTION
from qpavoid.run.machine import cpu, versions
from qpavoid_bench.arena.checker import MAX_INSTANTS, STEP

PACKAGES = ("qpavoid", "mujoco", "pin", "coal", "daqp", "numpy", "scipy", "numba")
LISTED = 10
"""Avoidable collisions that are listed for each solver; those of `qp` and `qp-alone` all are. The CSV has them all."""


class Cost(NamedTuple):
    """Time of the campaign, and load of the machine."""

    seconds: float
    load: tuple[float, float]
    """Load average before and at the end [-]."""


def write(
    found: list[Trial], failures: dict[int, str], solvers: Sequence[str], cost: Cost, folder: Path, name: str
) -> str:
    """Write NAME.md and NAME.csv, and return the Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    markdown = "\n".join(_sections(found, failures, solvers, cost)) + "\n"
    (folder / f"{name}.md").write_text(markdown)
    with (folder / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Trial)])
        writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in asdict(trial).items()} for trial in found)
    return markdown


def _sections(found: list[Trial], failures: dict[int, str], solvers: Sequence[str], cost: Cost) -> list[str]:
    seeds = sorted({trial.seed for trial in found} | set(failures))
    lines = [
        "# Safety",
        "",
        f"{len(seeds)} random scenarios (seeds {_named(seeds)}), each with {', '.join(solvers)}: "
        f"{len(found)} runs in {cost.seconds / 60:.1f} minutes. The commanded joint velocities of every run are run "
        "in MuJoCo, with its own integration, kinematics and distances, at every control step and in between, so that "
        f"nothing moves more than {1e3 * STEP:g} mm from one evaluation to the next. {_machine()}; load before and "
        f"at the end: {cost.load[0]:.1f} and {cost.load[1]:.1f}.",
        "",
        "**What this does not show.** Velocities are followed exactly, and obstacles move as announced, with the "
        "velocity that the controller is given: no delay, no noise, no dynamics. Joint placements, collision shapes "
        "and the obstacles' motions come from the same description on both sides, so neither detects an error in "
        f"those. A contact of two moving bodies between two evaluations is at most {1e3 * STEP:g} mm deep, and may "
        f"be missed (a control step has at most {MAX_INSTANTS} evaluations). `eq10` and `tracking` are scaled to the "
        "joints' limits afterwards. Runs are short: one that has not arrived when it ends is not lost.",
        "",
        "**Avoidable or not.** The robot is taken back to the last control step at which the pair in contact was "
        "farther apart than d2, and evades from there within its limits, by ten policies, with no task. If one of "
        "them stays clear, the contact was avoidable. It counts as unavoidable only if all fail *and* a linear "
        "program over the joint velocities proves why: the pair does not depend on any joint (`fixed`), or, in the "
        f"last period of the longest evasion, no velocity held for {PROOF_TIME:g} s keeps it apart (`outrun`), or all "
        "near pairs at once (`squeezed`). What is not proved counts as avoidable. Details are in "
        "`bench/safety/verdict.py`.",
        "",
        *_by_solver(found, solvers),
        "",
        *_by_robot(found, solvers),
        "",
        *_by_moving(found, solvers),
        "",
        *_disagreement(found),
    ]
    for solver in solvers:
        lines += ["", *_avoidable([trial for trial in found if trial.solver == solver], solver)]
    if failures or any(trial.failure for trial in found):
        lines += ["", "## Runs that failed", ""]
        lines += [f"- seed {seed}: {text}" for seed, text in failures.items()]
        lines += [f"- seed {trial.seed}, {trial.solver}: {trial.failure}" for trial in found if trial.failure]
    return [*lines, "", *_ranges()]


def _named(seeds: list[int]) -> str:
    whole = len(seeds) == seeds[-1] - seeds[0] + 1
    return f"{seeds[0]} to {seeds[-1]}" if whole else ", ".join(map(str, seeds))


_COLUMNS = (
    "runs", "with a collision", "**avoidable**", "fixed", "outrun", "squeezed", "near misses", "worst distance [mm]",
    "runs that relax", "time relaxed [%]", "time stopped [%]", "arrived",
)  # fmt: skip


def _by_solver(found: list[Trial], solvers: Sequence[str]) -> list[str]:
    lines = [
        "A run counts as avoidable if any of its contacts is. Near misses: no contact, but nearer than d1/2. Worst "
        "distance: of runs without an unavoidable contact, among pairs whose distance depends on a joint.",
        "",
        f"| solver | {' | '.join(_COLUMNS)} |",
        "|---|" + "---:|" * len(_COLUMNS),
    ]
    return lines + [f"| {s} | {' | '.join(_summary([t for t in found if t.solver == s]))} |" for s in solvers]


def _by_robot(found: list[Trial], solvers: Sequence[str]) -> list[str]:
    lines = [f"| robot, solver | {' | '.join(_COLUMNS)} |", "|---|" + "---:|" * len(_COLUMNS)]
    for robot in sorted({trial.robot for trial in found}):
        for solver in solvers:
            row = _summary([trial for trial in found if trial.solver == solver and trial.robot == robot])
            lines.append(f"| {robot}, {solver} | {' | '.join(row)} |")
    return lines


_MOVING = {"none": (0, 0), "1 or 2": (1, 2), "3 or more": (3, 99)}


def _by_moving(found: list[Trial], solvers: Sequence[str]) -> list[str]:
    lines = [f"| obstacles that move, solver | {' | '.join(_COLUMNS)} |", "|---|" + "---:|" * len(_COLUMNS)]
    for name, (least, most) in _MOVING.items():
        for solver in solvers:
            row = _summary([trial for trial in found if trial.solver == solver and least <= trial.moving <= most])
            lines.append(f"| {name}, {solver} | {' | '.join(row)} |")
    return lines


def _summary(found: list[Trial]) -> list[str]:
    if not found:
        return ["0"] + [""] * (len(_COLUMNS) - 1)
    verdicts, count = Counter(trial.verdict for trial in found), len(found)
    worst = min((t.distance for t in found if t.avoidable or not t.collided), default=np.inf)
    time = sum(trial.ticks * trial.dt for trial in found)
    return [
        str(count),
        str(sum(trial.collided for trial in found)),
        f"**{sum(trial.avoidable for trial in found)}**",
        *(str(verdicts[why]) for why in ("fixed", "outrun", "squeezed")),
        str(sum(trial.near for trial in found)),
        f"{1e3 * worst:.1f}",
        str(sum(trial.relaxed > 0.0 for trial in found)),
        f"{100.0 * sum(trial.relaxed for trial in found) / time:.2f}",
        f"{100.0 * sum(trial.stopped for trial in found) / time:.3f}",
        f"{sum(trial.arrived for trial in found)} ({100.0 * sum(trial.arrived for trial in found) / count:.0f} %)",
    ]


def _disagreement(found: list[Trial]) -> list[str]:
    worst = max(found, key=lambda trial: trial.disagreement)
    unlogged = [trial for trial in found if trial.collided and not trial.logged]
    excess = [max(found, key=lambda t, name=name: getattr(t, name)) for name in ("speed_excess", "position_excess")]
    exceeding = [trial for trial in found if trial.acceleration_excess > 1e-6]
    return [
        f"**Where MuJoCo and qpavoid differ.** Distances, apart: by at most {worst.disagreement:.1e} m (seed "
        f"{worst.seed}, {worst.solver}); configurations, integrated to the end of a run: "
        f"{max(trial.drift for trial in found):.1e} rad. Runs with a contact that only the checker found, between "
        f"control steps: {len(unlogged)}. Largest excess over a joint's velocity limit {excess[0].speed_excess:.1e} "
        f"rad/s (seed {excess[0].seed}, {excess[0].solver}), over its position limit {excess[1].position_excess:.1e} "
        f"rad (seed {excess[1].seed}, {excess[1].solver}); negative figures are margins. Runs over their "
        f"acceleration limit: {len(exceeding)} ({_counts(exceeding)}).",
    ]


def _counts(found: list[Trial]) -> str:
    counts = Counter(trial.solver for trial in found)
    return ", ".join(f"{solver} {count}" for solver, count in counts.items()) or "none"


def _avoidable(found: list[Trial], solver: str) -> list[str]:
    bad = [trial for trial in found if trial.avoidable]
    shown = bad if solver.startswith("qp") else bad[:LISTED]
    lines = [f"## Avoidable collisions of {solver}", "", "None." if not bad else ""]
    if bad:
        lines[-1:] = [
            f"`python -m bench.safety --seed SEED --solver {solver}` runs one again."
            + (f" The first {len(shown)} of {len(bad)}:" if len(shown) < len(bad) else ""),
            "",
            "| seed | robot | dt [ms] | obstacles, moving | distance [mm] | last avoidable | contact, proof |",
            "|---:|---|---:|---:|---:|---|---|",
        ]
        lines += [
            f"| {t.seed} | {t.robot} | {1e3 * t.dt:g} | {t.obstacles}, {t.moving} | {1e3 * t.distance:.2f} | "
            f"{_last_avoidable(t)} | {t.verdict}: {t.judged} |"
            for t in shown
        ]
        lines += _explained(bad)
    return lines


def _last_avoidable(trial: Trial) -> str:
    if np.isnan(trial.lead_time):
        return ""
    return f"{trial.lead_time:.2f} s before, {1e3 * trial.lead_distance:.0f} mm apart, {trial.lead_status}"


def _explained(bad: list[Trial]) -> list[str]:
    """Return a paragraph on the last moments at which contacts were avoidable."""
    known = [trial for trial in bad if not np.isnan(trial.lead_time)]
    if not known:
        return []
    early = [trial for trial in known if trial.lead_distance > trial.d1]
    met = sum(trial.lead_status == "SOLVED" for trial in early)
    return [
        "",
        "**Why.** Last avoidable is the last moment from which one of the ten evasions still stays clear (to within "
        f"{1e3 * RESOLUTION:g} ms). In {len(early)} of {len(known)} runs the pair was then still farther apart than "
        f"d1, in {met} of these every row was met: the distances and velocities of one control step do not show it "
        "yet; it follows from later obstacle positions. Time from there to the contact: "
        f"{np.median([t.lead_time for t in early] or [np.nan]):.2f} s in the median of these, "
        f"{max((t.lead_time for t in known), default=np.nan):.2f} s at most.",
    ]


def _ranges() -> list[str]:
    lines = [
        "## What scenarios are drawn from",
        "",
        f"Robots, equally likely: {', '.join(kind.robot for kind in KINDS)}. What each field means is in "
        "`bench/safety/campaign.py`; how obstacles are placed (beside the tool's path, across it, head on, from "
        "behind, at the arm, in circles) in `bench/safety/obstacles.py`.",
        "",
        "| field | values |",
        "|---|---|",
    ]
    return lines + [f"| {name} | {value} |" for name, value in asdict(RANGES).items()]


def _cell(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def _machine() -> str:
    found = ", ".join(f"{package} {number}" for package, number in versions(PACKAGES).items())
    return f"{cpu()}, {os.cpu_count()} CPUs, {platform.system()}, Python {platform.python_version()}, {found}"
