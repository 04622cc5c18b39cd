"""`qpavoid bench tick`: one control step of qpavoid beside its peers, or beside another qpavoid."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from qpavoid.errors import ConfigError
from qpavoid_bench.tables import RESULTS

QUICK = ("panda-0@0.10", "panda-5@0.10", "panda-50@0.10", "baxter-0@0.10", "g1-8@0.10")


def tick(
    workloads: Annotated[str | None, typer.Option(help="Comma-separated names or patterns; see --list.")] = None,
    libs: Annotated[str | None, typer.Option(help="Comma-separated libraries; all if left out.")] = None,
    against: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="Folder with another `qpavoid` in it, such as a checkout: qpavoid beside it."),
    ] = None,
    rounds: Annotated[int | None, typer.Option(help="How often the libraries take turns: 10, or 40 --against.")] = None,
    ticks: Annotated[int, typer.Option(help="Steps of a library in a round.")] = 300,
    budget: Annotated[float, typer.Option(help="Time that a round of one library may take [s].")] = 1.0,
    quick: Annotated[bool, typer.Option("--quick", help="A look in under a minute; writes tick-quick.*")] = False,
    list_: Annotated[bool, typer.Option("--list", help="List the workloads.")] = False,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
    name: Annotated[str | None, typer.Option(help="Name of the results.")] = None,
) -> None:
    """Time one control step of qpavoid and of its peers on identical work."""
    from qpavoid_bench.tick.build import is_recorded, recorded_names, variant_names
    from qpavoid_bench.tick.libraries import LIBRARIES, Ours
    from qpavoid_bench.tick.loops import loop_names
    from qpavoid_bench.tick.report import write_report
    from qpavoid_bench.tick.runner import run

    known = [*recorded_names(), *variant_names(), *loop_names()]
    if list_:
        print("\n".join(known))
        return
    default = QUICK if quick else known
    chosen = []
    for pattern in workloads.split(",") if workloads else default:
        result = [each for each in known if fnmatchcase(each, pattern)] or [pattern] * is_recorded(pattern)
        if not result:
            raise ConfigError(f"no workload {pattern!r}; there are {', '.join(known)}")
        chosen += result
    if libs is None:
        libraries = list(LIBRARIES.values()) if not against else [LIBRARIES["qpavoid"]]
    else:
        for each in libs.split(","):
            if each not in LIBRARIES:
                raise ConfigError(f"no library {each!r}; there are {', '.join(LIBRARIES)}")
        libraries = [LIBRARIES[each] for each in libs.split(",")]
    for folder in against or ():
        if not (folder / "qpavoid" / "__init__.py").is_file():
            raise ConfigError(f"{folder}: has no qpavoid in it")
        label = f"qpavoid {_revision(folder)}"
        ours = LIBRARIES["qpavoid"]
        assert isinstance(ours, Ours)
        libraries.append(replace(ours, name=label, path=str(folder.resolve())))
    if quick:
        rounds, ticks, budget = rounds or 3, min(ticks, 100), min(budget, 0.1)
    results = run(chosen, libraries, rounds or (40 if against else 10), ticks, budget)
    stem = name or ("tick-against" if against else "tick-quick" if quick else "tick")
    print(write_report(results, out, stem))


def _revision(folder: Path) -> str:
    """Return the commit of a checkout, or the folder's name."""
    command = ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else folder.resolve().name
