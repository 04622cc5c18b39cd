"""`python -m bench.solvers`: records QPs of real runs and replays them through every back end that is installed."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")


def main() -> None:
    """Parses the options, records, replays, writes bench/results/solvers.md and solvers.csv, prints the Markdown."""
    import qpsolvers

    from bench.solvers.record import FOLDER, load, runs, save
    from bench.solvers.replay import contestants, loose, replay, truths
    from bench.solvers.report import Results, write

    parser = argparse.ArgumentParser(prog="python -m bench.solvers", description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="record the QPs of every so many ticks (1)")
    parser.add_argument("--rounds", type=int, default=5, help="how often the back ends take turns (5)")
    parser.add_argument("--budget", type=float, default=5.0, help="seconds that a back end may use on a run (5)")
    parser.add_argument("--backends", help="comma-separated; default: all")
    parser.add_argument(
        "--replay", type=Path, help=f"replay this folder's recordings, as in {FOLDER.name}/; record none"
    )
    parser.add_argument("--out", default="solvers", help="name of the results (solvers)")
    options = parser.parse_args()

    before = os.getloadavg()[0]
    if options.replay is None:
        recorded = runs(options.every)
        save(recorded)
    else:
        recorded = [load(path) for path in sorted(options.replay.glob("*.npz"))]
    recorded = [run for run in recorded if run.qps]
    if not recorded:
        parser.error("nothing is recorded")
    makers = contestants()
    if options.backends:
        for name in options.backends.split(","):
            if name not in makers:
                parser.error(f"no back end {name!r}; there are {', '.join(makers)}")
        makers = {name: makers[name] for name in options.backends.split(",")}
    right = [truths(run) for run in recorded]
    pairs = list(zip(recorded, right, strict=True))
    cells = [replay(run, known, makers, options.rounds, options.budget) for run, known in pairs]
    lax = {
        (name, displacement): [loose(run, known, name, displacement) for run, known in pairs]
        for name in sorted(qpsolvers.available_solvers)
        for displacement in (False, True)
    }
    load_average = (before, os.getloadavg()[0])
    results = Results(recorded, right, cells, lax, options.rounds, options.every, load_average)
    print(write(results, Path(__file__).parent.parent / "results", options.out))


if __name__ == "__main__":
    main()
