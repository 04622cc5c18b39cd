"""The commands of `qpavoid bench`.

Dependencies of a command are imported when it runs.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from qpavoid.config.shipped import shipped_names
from qpavoid.errors import ConfigError
from qpavoid.run.report import to_json
from qpavoid.run.terminal import ERR, OUT, names_of, progress, terminate_like_interrupt
from qpavoid_bench.adapters import adapters
from qpavoid_bench.camera import camera
from qpavoid_bench.endurance.command import endurance
from qpavoid_bench.grasps.command import grasps
from qpavoid_bench.loops import loops
from qpavoid_bench.planning import planning
from qpavoid_bench.serve import serve
from qpavoid_bench.solvers.command import solvers
from qpavoid_bench.survey import robots
from qpavoid_bench.tick.command import tick
from qpavoid_bench.torque_steps import dynamics

if TYPE_CHECKING:
    import pandas as pd

    from qpavoid_bench.arena.case import Case
    from qpavoid_bench.arena.suite import Suite
    from qpavoid_bench.arena.sweep import Tally

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # which takes units in brackets for markup
    help="Compare solvers on families of scenarios: the arena.",
)

app.command()(tick)
app.command()(solvers)
app.command()(endurance)
app.command()(robots)
app.command()(serve)
app.command()(camera)
app.command()(adapters)
app.command()(grasps)
app.command()(dynamics)
app.command()(planning)
app.command()(loops)
_MEASURES = (
    "tick", "solvers", "endurance", "robots", "grasps", "serve", "camera", "adapters", "dynamics", "planning", "loops",
)  # fmt: skip
"""Commands that need none of the packages below."""

_PACKAGES = ("distributed", "mujoco", "pandas", "statsmodels", "matplotlib")

Name = Annotated[str, typer.Argument(metavar="SUITE", help="Shipped name or path of a YAML file.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of results.")]
Jobs = Annotated[int | None, typer.Option(min=1, help="Processes on this machine; one a core if left out.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else on stdout.")]


@app.callback()
def arena(context: typer.Context) -> None:
    """Compare solvers on families of scenarios; time control steps, back ends and long runs."""
    if context.invoked_subcommand in _MEASURES:
        return
    missing = [package for package in _PACKAGES if find_spec(package) is None]
    if missing:
        raise ConfigError(f"qpavoid bench needs {', '.join(missing)}: pip install 'qpavoid[arena]'")


@app.command()
def run(
    suite: Name,
    solvers: Annotated[str | None, typer.Option(help="Comma-separated entrants in place of the suite's.")] = None,
    entrant: Annotated[
        list[str] | None, typer.Option(metavar="FILE.py:NAME", help="One more, of your own; may be given again.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Cases of each family.")] = None,
    jobs: Jobs = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="A Dask scheduler, in place of this machine.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of results; out/bench/SUITE if left out.")] = None,
    json: Json = False,
) -> None:
    """Run a suite, or go on with it: what is in the folder already is not done again.

    The exit status is 1 when something could not be made or run, or was interrupted; collisions are results.
    """
    from qpavoid_bench.arena.suite import load_suite

    if cluster is not None and jobs is not None:
        raise ConfigError("--jobs: the cluster has its own; leave one of --jobs and --cluster out")
    names = [] if solvers is None else names_of("--solvers", solvers)
    chosen, absent = load_suite(suite, names, entrant or (), seeds).prepare()
    for name, reason in absent.items():
        _print_error(f"{name} does not take part: {reason}")
    folder = out or Path("out") / "bench" / chosen.name
    tally = _run_sweep(chosen, folder, cluster, jobs)
    for failure in _failures(folder):
        _print_error(failure)
    _print(chosen, _runs_of(chosen, folder)[0], folder, tally, json)
    raise typer.Exit(1 if tally.failed else 0)


@app.command()
def smoke(
    out: Annotated[Path | None, typer.Option(help="Folder of results; none is kept if left out.")] = None,
    jobs: Jobs = None,
    json: Json = False,
) -> None:
    """Run a few cases of everything, and list faults: exit status 1 if there are any."""
    from qpavoid_bench.arena.suite import load_suite
    from qpavoid_bench.arena.summary import find_faults

    chosen = load_suite("smoke")
    for entrant in chosen.absent:
        _print_error(f"{entrant.name} does not take part: it needs {', '.join(entrant.missing)}")
    with ExitStack() as stack:
        folder = out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="qpavoid-smoke-")))
        tally = _run_sweep(chosen, folder, None, jobs)
        runs, cases = _runs_of(chosen, folder)
        faults = [*_failures(folder), *find_faults(chosen, runs, cases)]
    _print(chosen, runs, out, tally, json, {"broken": faults})
    for fault in faults:
        _print_error(f"broken: {fault}")
    raise typer.Exit(1 if faults else 0)


@app.command()
def report(folder: Folder) -> None:
    """Write the report of a folder: Markdown with pictures."""
    from qpavoid_bench.arena.report import write_report

    for file in write_report(folder):
        OUT.print(str(file), highlight=False, soft_wrap=True, markup=False)


@app.command()
def show(
    folder: Folder,
    family: Annotated[str, typer.Option(help="Name of the family.")],
    seed: Annotated[int, typer.Option(help="Of the case.")],
    entrant: Annotated[str | None, typer.Option(help="Runs it once more; a name, or my_law.py:MyLaw.")] = None,
    scenario: Annotated[Path | None, typer.Option(help="Write the case as a scenario, for `qpavoid run`.")] = None,
    json: Json = False,
) -> None:
    """Show a case of a folder, and run it once more with one entrant."""
    from qpavoid_bench.arena.show import find_case, rerun, write_scenario

    case = find_case(folder, family, seed)
    fields: dict[str, Any] = {"family": family, "seed": seed, "case": case.key, "solved_by": case.solved_by}
    if scenario is not None:
        write_scenario(case, scenario)
        fields["scenario"] = str(scenario)
    if entrant is not None:
        fields["run"] = rerun(case, entrant, folder)
    if json:
        print(to_json(fields))
        return
    figures = fields.pop("run", {})
    for name, value in {**fields, **figures}.items():
        OUT.print(f"{name:16} {value}", highlight=False, soft_wrap=True, markup=False)


@app.command("list")
def list_(json: Json = False) -> None:
    """List suites, families and entrants, and what entrants lack."""
    from qpavoid.config.loading import read_config
    from qpavoid.config.shipped import find_shipped
    from qpavoid_bench.arena.entrants import ENTRANTS
    from qpavoid_bench.arena.families import load_family
    from qpavoid_bench.arena.suite import SuiteConfig

    suites = {name: read_config(find_shipped("suite", name), SuiteConfig).title for name in shipped_names("suite")}
    families = {name: load_family(name).config.title for name in shipped_names("family")}
    if json:
        entrants = {e.name: {"says": e.description, "missing": list(e.missing)} for e in ENTRANTS.values()}
        print(to_json({"suites": suites, "families": families, "entrants": entrants}))
        return
    description = {
        e.name: e.description + f" (needs {', '.join(e.missing)})" * bool(e.missing) for e in ENTRANTS.values()
    }
    for heading, entries in {"suites": suites, "families": families, "entrants": description}.items():
        OUT.print(f"[bold]{heading}[/]")
        for name, text in entries.items():
            OUT.print(f"  {name:22} {text}", highlight=False, soft_wrap=True, markup=False)


def _run_sweep(suite: Suite, folder: Path, cluster: str | None, jobs: int | None) -> Tally:
    """Run a suite, with progress bars.

    Raises:
        Exit: it was interrupted, or the cluster went away.
    """
    from qpavoid.run.pool import ClusterLost, ClusterWorkers, Workers
    from qpavoid_bench.arena.store import Store
    from qpavoid_bench.arena.sweep import Tally, plan, sweep

    last: Tally | None = None
    with terminate_like_interrupt(), Store(folder) as store, progress() as bar:
        bars = {stage: bar.add_task(stage, total=None, visible=False) for stage in ("cases", "runs")}

        def report_progress(tally: Tally) -> None:
            nonlocal last
            last = tally
            lines = f"{tally.stage}, {tally.collided} collided" if tally.collided else tally.stage
            task, visible = bars[tally.stage], tally.total > 0
            bar.update(task, completed=tally.done, total=tally.total, description=lines, visible=visible)

        todo = plan(suite, store)
        if not (todo.cases or todo.runs):
            store.drop_failures()
            return Tally("runs", 0, 0, 0, 0)
        try:
            with Workers(jobs) if cluster is None else ClusterWorkers(cluster) as workers:
                return sweep(suite, store, workers, report_progress)
        except (KeyboardInterrupt, ClusterLost) as reason:
            cause = "interrupted" if isinstance(reason, KeyboardInterrupt) else str(reason)
            done = "nothing" if last is None else f"{last.done} of {last.total} {last.stage}"
            _print_error(f"{cause}: {done} done, all that is done is kept in {folder}; the same command goes on")
            raise typer.Exit(1) from None


def _runs_of(suite: Suite, folder: Path) -> tuple[pd.DataFrame, list[Case]]:
    """Return runs of a suite that are done, and its cases that are made."""
    from qpavoid_bench.arena.case import Case
    from qpavoid_bench.arena.scores import KEY
    from qpavoid_bench.arena.store import Store, read_runs
    from qpavoid_bench.arena.sweep import plan

    with Store(folder) as store:
        planned = plan(suite, store)
    runs = read_runs(folder)
    keys = zip(*(runs[name] for name in KEY), strict=True)
    return runs[[key in planned.keys for key in keys]], [Case.from_json(text) for text in planned.texts]


def _failures(folder: Path) -> list[str]:
    """List what the last sweep could not make or run, a line each."""
    from qpavoid_bench.arena.store import read_failures

    lines = []
    for f in read_failures(folder):
        message = "the case could not be made" if f["entrant"] is None else f"{f['entrant']} could not be run"
        lines.append(f"{f['family']}, seed {f['seed']}: {message}: {f['failure']}")
    return lines


def _print(
    suite: Suite,
    runs: pd.DataFrame,
    folder: Path | None,
    tally: Tally,
    json: bool,
    extra_fields: dict[str, Any] | None = None,
) -> None:
    """Print the summary of a suite, as a table or as JSON."""
    from qpavoid_bench.arena.summary import summary, summary_table

    rows = summary(runs)
    if json:
        fields = {"suite": suite.name, "folder": folder and str(folder), "new": tally.done, "runs": len(runs)}
        print(to_json({**fields, "failed": tally.failed, **(extra_fields or {}), "entrants": rows}))
        return
    OUT.print(summary_table(rows, f"{suite.name}: {suite.title}"))
    for row in rows:
        if row["failed"]:
            _print_error(f"{row['entrant']} failed in {row['failed']} of {row['runs']} runs: {row['failure']}")
    if folder is not None:
        OUT.print(
            f"{folder}: {len(runs)} runs, {tally.done} of them new", highlight=False, soft_wrap=True, markup=False
        )


def _print_error(message: str) -> None:
    ERR.print(message, highlight=False, soft_wrap=True, markup=False)
