"""The report: Markdown for people, CSV for programs."""

from __future__ import annotations

import csv
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.solvers.record import Run
from bench.solvers.replay import Cell, Loose
from bench.solvers.verify import DISTANCE, EDGE, GAP, VIOLATION, Judgement, Truth
from qpavoid.run.machine import cpu

PACKAGES = (
    "qpavoid",
    "daqp",
    "proxsuite",
    "osqp",
    "quadprog",
    "piqp",
    "clarabel",
    "qpsolvers",
    "numpy",
    "scipy",
    "numba",
)


class Results(NamedTuple):
    """Everything that was measured."""

    runs: list[Run]
    truths: list[list[Truth]]
    cells: list[dict[str, Cell]]
    """By run, then by back end."""
    loose: dict[tuple[str, bool], list[Loose]]
    """(back end, whether in displacements): one a run."""
    rounds: int
    every: int
    load: tuple[float, float]


def write(results: Results, folder: Path, name: str = "solvers") -> str:
    """Writes NAME.md and NAME.csv, and returns the Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    markdown = "\n".join(_sections(results)) + "\n"
    (folder / f"{name}.md").write_text(markdown)
    with (folder / f"{name}.csv").open("w", newline="") as file:
        fields = ["run", "n", "m_median", "qps", "back_end", "solved", "right", "p50_us", "p99_us", "mean_us"]
        writer = csv.writer(file)
        writer.writerow([*fields, "worst_violation", "worst_distance"])
        for run, cells in zip(results.runs, results.cells, strict=True):
            n, m = len(run.qps[0].q), int(np.median([len(qp.h) for qp in run.qps]))
            for back_end, cell in cells.items():
                shares = [f"{_share(cell.judged, 'solved'):.5f}", f"{_share(cell.judged, 'right'):.5f}"]
                times = [f"{np.percentile(cell.us, p):.2f}" for p in (50, 99)] + [f"{cell.us.mean():.2f}"]
                worst = [f"{_worst(cell.judged, field):.2g}" for field in ("violation", "distance")]
                writer.writerow([run.name, n, m, len(run.qps), back_end, *shares, *times, *worst])
    return markdown


def _sections(results: Results) -> list[str]:
    names = list(results.cells[0])
    total = {name: _joined([cells[name] for cells in results.cells]) for name in names}
    return [
        "# QP back ends on recorded problems",
        "",
        f"{sum(len(run.qps) for run in results.runs)} QPs from {len(results.runs)} closed loops, in the order of their "
        f"ticks{'' if results.every == 1 else f', of every {results.every}th tick'}; {results.rounds} rounds in which "
        "the back ends take turns, each made anew at the start of a round, so that set-ups are in the times. "
        f"{_machine()}; one thread; load before and at the end {results.load[0]:.1f} and {results.load[1]:.1f}.",
        "",
        f"**An answer is right** when rows and bounds hold to {VIOLATION:g} and no coordinate is farther than "
        f"{DISTANCE:g} rad/s from the reference (or, for the least-slack QPs, whose minimum is flat, its cost is "
        f"within {GAP:g}); when the rows contradict each other, the right answer is none, and where less than "
        f"{EDGE:g} m/s is left between them, either counts. The reference is the better "
        "of daqp and quadprog, solved again as equations on its active set, and proved by multipliers that we compute "
        "(non-negative least squares); a contradiction is proved by a linear programme. What a solver says about its "
        "own answer counts for nothing.",
        "",
        *_choice(names, total, results),
        "",
        "## All runs together",
        "",
        _line(
            ["back end", "gave an answer", "right", "median [µs]", "p99 [µs]", "worst violation", "worst ‖x - x_ref‖∞"]
        ),
        _line(["---", *["---:"] * 6]),
        *(_line([name, *_row(total[name])]) for name in sorted(names, key=lambda name: np.median(total[name].us))),
        "",
        "`by qpsolvers` is the same solver through qpsolvers, at the tolerances that were used before it was called "
        "natively. `native` is what the `qp` solver calls; it gets -P⁻¹q from the tick, and here computes "
        "it within the time shown. `gave an answer` counts a contradiction that was recognised.",
        "",
        "## Run by run: median / p99 [µs], and the share that is right where that is not all",
        "",
        *_by_run(results, names),
        "",
        "## The runs",
        "",
        *_runs(results),
        "",
        "## Why tolerances are tight and the unknown is a velocity",
        "",
        "The same feasible QPs at each solver's own default tolerances, through qpsolvers, once with v as the unknown "
        "and once with the displacement v dt. Only answers that the solver itself calls solved are counted; all runs.",
        "",
        _line(
            ["back end", "unknown", "reports success", "worst error in v [rad/s]", "off by > 1e-3", "worst violation"]
        ),
        _line(["---", "---", *["---:"] * 4]),
        *(_loose_row(name, unit, cells) for (name, unit), cells in results.loose.items()),
        "",
        "## Limits",
        "",
        "Problems of one law (`qp`) at its defaults, recorded with daqp in the loop: another law, other weights or "
        "another regularisation (here 1e-3, the smallest eigenvalue of P) change conditioning and with it what the "
        "first-order solvers need. The tight tolerances of proxqp, osqp, piqp and clarabel were chosen on these "
        "recordings, so their shares that are right are best cases; the active-set methods (native, daqp, quadprog) "
        "were not tuned here. p99 includes what else the machine did (see its load). At replay the caches are warmer "
        "than in a control loop. One machine.",
        "",
        "Versions: " + ", ".join(f"{name} {_version(name)}" for name in PACKAGES if _version(name)) + ".",
    ]


def _choice(names: list[str], total: dict[str, Cell], results: Results) -> list[str]:
    right = [name for name in names if _share(total[name].judged, "right") == 1.0]
    if not right:
        return ["**No back end is right on every problem.**"]
    best = min(right, key=lambda name: float(np.median(total[name].us)))
    wins = sum(
        best == min(right, key=lambda name, cells=cells: float(np.median(cells[name].us))) for cells in results.cells
    )
    others = sorted((name for name in right if name != best), key=lambda name: float(np.median(total[name].us)))
    ratios = ", ".join(f"{name} {np.median(total[name].us) / np.median(total[best].us):.1f}x" for name in others)
    wrong = ", ".join(name for name in names if name not in right)
    return [
        f"**Choose `{best}`**: right on every problem, and the quickest of those that "
        f"are on {wins} of {len(results.cells)} runs. Time of the others that are always right, by medians over all "
        f"problems: {ratios}." + (f" Not always right: {wrong}." if wrong else "")
    ]


def _joined(cells: list[Cell]) -> Cell:
    return Cell(np.concatenate([cell.us.ravel() for cell in cells]), [j for cell in cells for j in cell.judged])


def _row(cell: Cell) -> list[str]:
    return [
        _percent(_share(cell.judged, "solved")),
        _percent(_share(cell.judged, "right")),
        _number(float(np.median(cell.us))),
        _number(float(np.percentile(cell.us, 99))),
        f"{_worst(cell.judged, 'violation'):.0e}",
        f"{_worst(cell.judged, 'distance'):.0e}",
    ]


def _by_run(results: Results, names: list[str]) -> list[str]:
    lines = [_line(["run", *names]), _line(["---", *["---:"] * len(names)])]
    for run, cells in zip(results.runs, results.cells, strict=True):
        entries = []
        for name in names:
            right = _share(cells[name].judged, "right")
            times = " / ".join(_number(float(np.percentile(cells[name].us, p))) for p in (50, 99))
            entries.append(times if right == 1.0 else f"{times} ({_percent(right)})")
        lines.append(_line([run.name, *entries]))
    return lines


def _runs(results: Results) -> list[str]:
    head = [
        "run",
        "ticks",
        "QPs",
        "n",
        "rows m",
        "sizes",
        "contradicting",
        "least slack",
        "open",
        "reference stationary to",
    ]
    lines = [_line(head), _line(["---", *["---:"] * (len(head) - 1)])]
    for run, right in zip(results.runs, results.truths, strict=True):
        n, m = ([len(getattr(qp, field)) for qp in run.qps] for field in ("q", "h"))
        proofs = [known.stationarity for known in right if known.x is not None and not known.open]
        counts = [
            sum(known.x is None and not known.open for known in right),
            sum(known.flat for known in right),
            sum(known.open for known in right),
        ]
        sizes = len(set(zip(n, m, strict=True)))
        lines.append(
            _line(
                [
                    run.name,
                    run.ticks,
                    len(run.qps),
                    min(n),
                    f"{min(m)} to {max(m)}",
                    sizes,
                    *counts,
                    f"{max(proofs):.0e}",
                ]
            )
        )
    return lines


def _loose_row(name: str, displacement: bool, cells: list[Loose]) -> str:
    unit = "v dt [rad]" if displacement else "v [rad/s]"
    found, above = np.mean([cell.found for cell in cells]), np.mean([cell.above for cell in cells])
    worst = [max(getattr(cell, field) for cell in cells) for field in ("error", "violation")]
    return _line([name, unit, _percent(float(found)), f"{worst[0]:.0e}", _percent(float(above)), f"{worst[1]:.0e}"])


def _share(judged: list[Judgement], field: str) -> float:
    return float(np.mean([getattr(judgement, field) for judgement in judged]))


def _worst(judged: list[Judgement], field: str) -> float:
    values = np.array([getattr(judgement, field) for judgement in judged])
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def _percent(share: float) -> str:
    return "100 %" if share == 1.0 else f"{min(100.0 * share, 99.99):.2f} %"


def _number(us: float) -> str:
    return f"{us:.1f}" if us < 100.0 else f"{us:.0f}"


def _line(cells: list[object]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _machine() -> str:
    return f"{cpu()}, {os.cpu_count()} CPUs, {platform.system()}, Python {platform.python_version()}"
