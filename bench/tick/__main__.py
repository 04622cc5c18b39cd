"""`python -m bench.tick`: times one control step of qpavoid and of its peers; see bench/README.md."""

from __future__ import annotations

import argparse

from bench.tick.libs import LIBRARIES


def main() -> None:
    """Parses the options, measures, writes bench/results/tick.md and tick.csv, prints the Markdown."""
    from bench.tick.build import names
    from bench.tick.report import write
    from bench.tick.runner import ROOT, run

    parser = argparse.ArgumentParser(prog="python -m bench.tick", description=__doc__)
    parser.add_argument("--workloads", help=f"comma-separated; default: all of {', '.join(names())}")
    parser.add_argument("--libs", help=f"comma-separated; default: all of {', '.join(LIBRARIES)}")
    parser.add_argument("--rounds", type=int, default=10, help="how often the libraries take turns (10)")
    parser.add_argument("--ticks", type=int, default=300, help="steps of a library in a round (300)")
    parser.add_argument("--budget", type=float, default=1.0, help="seconds a round of one library may take (1)")
    parser.add_argument("--quick", action="store_true", help="a look in under a minute; writes tick-quick.*")
    parser.add_argument("--out", help="name of the results (tick)")
    options = parser.parse_args()
    if options.quick:
        options.rounds, options.ticks, options.budget = 3, 100, 0.1
    workloads = options.workloads.split(",") if options.workloads else names()
    if options.quick and not options.workloads:
        workloads = ["panda-0@0.10", "panda-5@0.10", "panda-50@0.10", "baxter-0@0.10", "g1-8@0.10"]
    libraries = options.libs.split(",") if options.libs else list(LIBRARIES)
    for given, known, what in ((workloads, names(), "workload"), (libraries, list(LIBRARIES), "library")):
        for name in given:
            if name not in known:
                parser.error(f"no {what} {name!r}; there are {', '.join(known)}")
    results = run(workloads, libraries, options.rounds, options.ticks, options.budget)
    name = options.out or ("tick-quick" if options.quick else "tick")
    print(write(results, ROOT / "bench" / "results", name))


if __name__ == "__main__":
    main()
