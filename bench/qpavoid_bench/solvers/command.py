"""`qpavoid bench solvers`: QPs of real runs through every back end that is installed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from qpavoid.errors import ConfigError
from qpavoid_bench.tables import RESULTS, describe_machine, number, table, write

if TYPE_CHECKING:
    from qpavoid_bench.solvers.record import Run
    from qpavoid_bench.solvers.replay import Cell
    from qpavoid_bench.solvers.truth import Judgement, Truth

PACKAGES = ("qpavoid", "daqp", "proxsuite", "osqp", "quadprog", "piqp", "clarabel", "qpsolvers", "numpy", "numba")
_LIMITS = """Problems of one law (`qp`) at its defaults: another law, other weights or another regularisation (here \
1e-3, the smallest eigenvalue of P) change conditioning, and with it what the first-order solvers need. The tight \
tolerances of proxqp, osqp, piqp and clarabel were chosen on such recordings, so their shares that are right are best \
cases; the active-set methods (native, daqp, quadprog) were not tuned. Rows that contradict each other are recorded, \
the relaxed QPs that follow are not. At replay the caches are warmer than in a control loop. One machine."""


def solvers(
    every: Annotated[int, typer.Option(help="Record the QPs of every so many control steps.")] = 1,
    rounds: Annotated[int, typer.Option(help="How often the back ends take turns.")] = 5,
    budget: Annotated[float, typer.Option(help="Time that a back end may use on a run [s].")] = 5.0,
    backends: Annotated[str | None, typer.Option(help="Comma-separated; all if left out.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few QPs, one round; writes solvers-quick.*")] = False,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Record QPs of closed loops, replay them through every back end, and judge all answers."""
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
        os.environ.setdefault(threads, "1")
    from qpavoid_bench.solvers.record import runs
    from qpavoid_bench.solvers.replay import contestants, replay
    from qpavoid_bench.solvers.truth import find_truth

    makers = contestants()
    for name in backends.split(",") if backends else ():
        if name not in makers:
            raise ConfigError(f"no back end {name!r}; there are {', '.join(makers)}")
    if backends:
        makers = {name: makers[name] for name in backends.split(",")}
    if quick:
        every, rounds, budget = 40, 1, 0.5
    recorded = runs(every)
    truths = [[find_truth(qp) for qp in run.qps] for run in recorded]
    cells = [replay(run, known, makers, rounds, budget) for run, known in zip(recorded, truths, strict=True)]
    rows = [
        _record(run, name, cell) for run, result in zip(recorded, cells, strict=True) for name, cell in result.items()
    ]
    print(write(out, "solvers-quick" if quick else "solvers", _sections(recorded, truths, cells, rounds), rows))


def _sections(runs: list[Run], truths: list[list[Truth]], cells: list[dict[str, Cell]], rounds: int) -> Iterator[str]:
    from qpavoid_bench.solvers.truth import DISTANCE, EDGE, VIOLATION

    total = {name: _joined([result[name] for result in cells]) for name in cells[0]}
    names = sorted(total, key=lambda name: _median(total[name]))
    yield "# QP back ends on recorded problems"
    yield (
        f"{sum(len(run.qps) for run in runs)} QPs from {len(runs)} closed loops, in the order of their control steps; "
        f"{rounds} rounds in which the back ends take turns, each made anew at the start of a round. "
        f"{describe_machine(*PACKAGES)}; load at the end {os.getloadavg()[0]:.1f}."
    )
    yield (
        f"**An answer is right** when rows and bounds hold to {VIOLATION:g} and no coordinate is farther than "
        f"{DISTANCE:g} rad/s from the reference; when the rows contradict each other, the right answer is none, and "
        f"where less than {EDGE:g} m/s is left between them, either counts. The reference is the better of daqp and "
        "quadprog, solved again as equations on its active set, and proved by multipliers that we compute "
        "(non-negative least squares); a contradiction is proved by a linear program. What a solver says about its own "
        "answer counts for nothing."
    )
    yield _choice(names, total)
    yield "## All runs together"
    yield table(
        ["back end", "gave an answer", "right", "median [µs]", "p99 [µs]", "worst violation", "worst ‖x - x_ref‖∞"],
        ([name, *_row(total[name])] for name in names),
    )
    yield (
        "`native` is what the `qp` solver calls. `NAME, defaults` is a solver through qpsolvers at its own default "
        "tolerances, with the velocity v as the unknown as everywhere else; `v dt`: with the displacement as the "
        "unknown. They show why tolerances are tight and the unknown is a velocity. `gave an answer` counts a "
        "contradiction that was recognised."
    )
    yield "## Run by run: median / p99 [µs], and the share that is right where that is not all"
    shown = [name for name in total if "defaults" not in name]
    rows = ([run.name, *(_brief(result[name]) for name in shown)] for run, result in zip(runs, cells, strict=True))
    yield table(["run", *shown], rows)
    yield "## The runs"
    head = ["run", "steps", "QPs", "n", "rows m", "contradicting", "open", "reference stationary to"]
    yield table(head, (_size(run, known) for run, known in zip(runs, truths, strict=True)))
    yield "## Limits"
    yield _LIMITS


def _choice(names: list[str], total: dict[str, Cell]) -> str:
    shares = {name: _right_fraction(total[name].judged, "right") for name in names}
    right = [name for name in names if shares[name] == 1.0]
    if not right:
        return "**No back end is right on every problem.**"
    ratios = [f"{name} {_median(total[name]) / _median(total[right[0]]):.1f}x" for name in right[1:]]
    wrong = [f"{name} ({_percent(fraction)})" for name, fraction in shares.items() if fraction < 1.0]
    return (
        f"**Choose `{right[0]}`**: right on every problem, and the quickest of those that are. Time of the others that "
        f"are always right, by medians: {', '.join(ratios) or 'none'}. Not always right: {', '.join(wrong) or 'none'}."
    )


def _joined(cells: list[Cell]) -> Cell:
    from qpavoid_bench.solvers.replay import Cell

    return Cell(np.concatenate([cell.us.ravel() for cell in cells]), [j for cell in cells for j in cell.judged])


def _row(cell: Cell) -> list[str]:
    shares = [_percent(_right_fraction(cell.judged, field)) for field in ("solved", "right")]
    times = [number(float(np.percentile(cell.us, percent))) for percent in (50, 99)]
    return [*shares, *times, *(f"{_worst(cell.judged, field):.0e}" for field in ("violation", "distance"))]


def _brief(cell: Cell) -> str:
    times = " / ".join(number(float(np.percentile(cell.us, percent))) for percent in (50, 99))
    right = _right_fraction(cell.judged, "right")
    return times if right == 1.0 else f"{times} ({_percent(right)})"


def _size(run: Run, truths: list[Truth]) -> list[Any]:
    rows = [len(qp.h) for qp in run.qps]
    proofs = [truth.stationarity for truth in truths if truth.x is not None and not truth.is_open]
    contradicting = sum(truth.x is None and not truth.is_open for truth in truths)
    is_open = sum(truth.is_open for truth in truths)
    sizes = [run.name, run.steps, len(run.qps), len(run.qps[0].q), f"{min(rows)} to {max(rows)}"]
    return [*sizes, contradicting, is_open, f"{max(proofs, default=np.nan):.0e}"]


def _record(run: Run, name: str, cell: Cell) -> dict[str, Any]:
    keys = ("solved", "right", "p50_us", "p99_us", "worst_violation", "worst_distance")
    sizes = {"n": len(run.qps[0].q), "m_median": int(np.median([len(qp.h) for qp in run.qps])), "qps": len(run.qps)}
    return {"run": run.name, **sizes, "back_end": name, **dict(zip(keys, _row(cell), strict=True))}


def _median(cell: Cell) -> float:
    return float(np.median(cell.us))


def _right_fraction(judged: list[Judgement], field: str) -> float:
    return float(np.mean([getattr(judgement, field) for judgement in judged])) if judged else 1.0


def _worst(judged: list[Judgement], field: str) -> float:
    values = np.array([getattr(judgement, field) for judgement in judged])
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def _percent(fraction: float) -> str:
    return "100 %" if fraction == 1.0 else f"{min(100.0 * fraction, 99.99):.2f} %"
