"""Command line: `qpavoid list | run | compare | view | render | serve | warmup | fields | robot | bench`.

Exit status: 0 done, 1 a run ended in a defined failure (collision, safe stop, broken off), 2 bad input.
"""

from __future__ import annotations

import sys
import warnings
from enum import Enum
from functools import partial
from importlib.metadata import version
from json import dumps
from pathlib import Path
from textwrap import wrap
from time import perf_counter
from typing import Annotated, Any, NamedTuple

import typer
from rich.markup import escape
from rich.progress import Progress, TaskID

from qpavoid.config import Planning, RobotConfig, ScenarioConfig
from qpavoid.config.fields import page, schema_of
from qpavoid.config.loading import load_scenario
from qpavoid.config.shipped import shipped_names
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError, QpavoidError
from qpavoid.kernels.cache import FOLDER
from qpavoid.run.log import WITH_PLANNING, Log
from qpavoid.run.report import events, failed, metrics_table, to_json
from qpavoid.run.simulate import simulate
from qpavoid.run.terminal import ERR, OUT, names_of, progress, terminate_like_interrupt
from qpavoid.service import commands as service_commands
from qpavoid.setup import commands as robot_commands
from qpavoid.solvers import SOLVERS, Solver, backend_names
from qpavoid.solvers.python_file import scenario_with_law
from qpavoid.viz import commands as view_commands

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # which takes units in brackets for markup
    help="Follow a planned motion and stay clear of obstacles, other arms and yourself.",
)
app.add_typer(robot_commands.app, name="robot")
app.command("view")(view_commands.view)
app.command("render")(view_commands.render)
app.command("serve")(service_commands.serve)

Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a field: avoidance.d2=0.30")
]
Out = Annotated[Path, typer.Option(help="Folder for logs and figures.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else on stdout.")]
Figures = Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the figures.")]
Verbose = Annotated[bool, typer.Option("--verbose", help="List the files that were written.")]


class Kind(str, Enum):
    """Kinds of things that `list` can list."""

    robots = "robots"
    scenarios = "scenarios"
    solvers = "solvers"


def _print_version(is_asked: bool) -> None:
    if is_asked:
        print(f"qpavoid {version('qpavoid')}")
        raise typer.Exit


@app.callback()
def options(
    version_: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Take options that stand before any command."""


@app.command("list")
def list_(kind: Annotated[Kind | None, typer.Argument(help="Only these.")] = None) -> None:
    """List what ships: robots, scenarios with their titles, solvers."""
    names = {
        Kind.robots: shipped_names("robot"),
        Kind.scenarios: shipped_names("scenario"),
        Kind.solvers: [*SOLVERS, "qp:native", *(f"qp:{name}" for name in backend_names())],
    }
    if kind is not None:
        for name in names[kind]:
            print(name)
        return
    titles = [f"{name:16} {load_scenario(name).title}" for name in names[Kind.scenarios]]
    for heading, entries in names.items():
        OUT.print(f"[bold]{heading.value}[/]")
        for line in titles if heading is Kind.scenarios else wrap("  ".join(entries), 76, break_on_hyphens=False):
            OUT.print(f"  {line}", highlight=False, soft_wrap=True, markup=False)


@app.command()
def run(
    scenario: Annotated[str, typer.Argument(help="Shipped name or path of a YAML file.")],
    solver: Annotated[
        str | None, typer.Option(help="Such as eq10, qp:proxqp or my_law.py:MyLaw; as in the file if left out.")
    ] = None,
    set_: Sets = None,
    out: Out = Path("out"),
    json: Json = False,
    figures: Figures = True,
    verbose: Verbose = False,
) -> None:
    """Run one scenario; write its log and figures."""
    logs, files = _run_all([_job(scenario, set_, solver)], out)
    if figures:
        files += _draw(logs, out)
    metrics = [log.metrics() for log in logs]
    if json:
        print(to_json({**metrics[0], "files": [str(f) for f in files]}))
    else:
        _print(metrics, files, out, verbose)
    raise typer.Exit(1 if failed(metrics[0]) else 0)


@app.command()
def compare(
    scenarios: Annotated[list[str], typer.Argument(help="Shipped names or paths of YAML files.")],
    solvers: Annotated[
        str, typer.Option(help="Comma-separated; FILE.py:NAME for one of your own.")
    ] = "tracking,eq10-literal,eq10,qp",
    planning: Annotated[
        bool, typer.Option("--planning", help="Run qp and hqp a second time, with `planning: {}` in the scenario.")
    ] = False,
    set_: Sets = None,
    out: Out = Path("out"),
    json: Json = False,
    figures: Figures = True,
    verbose: Verbose = False,
) -> None:
    """Run scenarios with several solvers, side by side.

    A collision is a result here, not a failure: the exit status is 1 only when a run was broken off.
    """
    names = names_of("--solvers", solvers)
    jobs = [_job(scenario, set_, name) for scenario in scenarios for name in names]
    if planning:
        jobs = [twin for job in jobs for twin in job.with_and_without_planning()]
    logs, files = _run_all(jobs, out)
    if figures:
        files += _draw(logs, out)
    metrics = [log.metrics() for log in logs]
    if json:
        print(to_json({"runs": metrics, "files": [str(f) for f in files]}))
    else:
        _print(metrics, files, out, verbose)
    raise typer.Exit(0 if all(run["completed"] for run in metrics) and len(logs) == len(jobs) else 1)


@app.command("bench", context_settings={"ignore_unknown_options": True, "help_option_names": []})
def bench_(words: Annotated[list[str] | None, typer.Argument(metavar="COMMAND ...")] = None) -> None:
    """Compare solvers on families of scenarios: the arena. `qpavoid bench --help` lists its commands."""
    try:
        from qpavoid_bench.arena.commands import app as bench
    except ModuleNotFoundError as missing:
        if missing.name != "qpavoid_bench":
            raise
        raise ConfigError(
            "qpavoid bench needs the package qpavoid_bench, which comes with qpavoid; put the "
            "checkout's folder `bench` on PYTHONPATH, or install the checkout"
        ) from None
    raise typer.Exit(bench(words or ["--help"], prog_name="qpavoid bench", standalone_mode=False) or 0)


class Schema(str, Enum):
    """Kinds of files that have a schema."""

    scenario = "scenario"
    robot = "robot"


@app.command("fields")
def fields_(
    schema: Annotated[Schema | None, typer.Option(help="Print the JSON Schema of such a file, for an editor.")] = None,
) -> None:
    """Print every field that a scenario and a robot.yaml may have, with units and defaults, as Markdown."""
    if schema is None:
        print(page())
    else:
        root = ScenarioConfig if schema is Schema.scenario else RobotConfig
        print(dumps(schema_of(root), indent=2))


@app.command()
def warmup(
    scenarios: Annotated[
        list[str] | None, typer.Argument(help="Shipped names or paths of YAML files; all that ship if left out.")
    ] = None,
) -> None:
    """Compile what steps of some scenarios need, for an image, or before a test: no later start on it compiles."""
    begin, configs = perf_counter(), [load_scenario(name) for name in scenarios or shipped_names("scenario")]
    with progress() as bar:
        task = bar.add_task("warmup", total=len(configs))
        for config in configs:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a run of the scenario warns
                Controller.from_scenario(config)
            bar.advance(task)
    size = sum(path.stat().st_size for path in FOLDER.glob("*.code"))
    print(f"{len(configs)} scenarios, {perf_counter() - begin:.0f} s; {1e-6 * size:.0f} MB of code in {FOLDER}")


class _Job(NamedTuple):
    """A run: its scenario, and a law of the user's own in place of its solver."""

    config: ScenarioConfig
    law: Solver | None

    @property
    def label(self) -> str:
        """Scenario and solver, for messages and names of files."""
        label = f"{self.config.source.stem} {(self.law or self.config.solver).label}"
        return f"{label} {WITH_PLANNING}" if self.config.planning else label

    def with_and_without_planning(self) -> list[_Job]:
        """Return the run without planning, and with it, where it is of a law that is forecast."""
        if self.law is not None or self.config.solver.name not in ("qp", "hqp"):
            return [self]
        blocks = None, self.config.planning or Planning()
        return [self._replace(config=self.config.model_copy(update={"planning": block})) for block in blocks]


def _job(scenario: str, sets: list[str] | None, solver: str | None) -> _Job:
    """Read a scenario, with a solver by name or from a file."""
    return _Job(*scenario_with_law(scenario, sets or (), solver))


def _run_all(jobs: list[_Job], out: Path) -> tuple[list[Log], list[Path]]:
    """Run and save one scenario after the other, the last one as far as it came."""
    logs: list[Log] = []
    files = []
    for config, law in jobs:  # faults of the last scenario show before the first one runs
        controller, _ = Controller.from_scenario(config)
        controller.solver = law or controller.solver
    labels = [job.label for job in jobs]
    for label in labels:
        if labels.count(label) > 1:
            raise ConfigError(f"{label} would be written twice: leave one out, or rename one scenario file")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {out}: {error.strerror}; give a folder that can be written") from None
    with progress() as bar, terminate_like_interrupt():
        for label, (config, law) in zip(labels, jobs, strict=True):
            update = partial(_update, bar, bar.add_task(label, total=None))
            logs.append(simulate(config, law, update))
            files.append(logs[-1].save(out / f"{logs[-1].stem}.npz"))
            if logs[-1].meta["stopped_by"]:
                message = escape(f"{label}: broken off: {logs[-1].meta['stopped_by']}")
                ERR.print(f"[red]{message}[/]", highlight=False)
                break
    return logs, files


def _update(bar: Progress, job: TaskID, count_done: int, total: int) -> None:
    bar.update(job, completed=count_done, total=total)


def _draw(logs: list[Log], out: Path) -> list[Path]:
    """Write the figures of runs and the page that shows them; without matplotlib, print how to install it."""
    try:
        from qpavoid.viz import figures as plot
        from qpavoid.viz.index_page import write_index
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] != "matplotlib":
            raise
        ERR.print("no figures: matplotlib is missing; pip install 'qpavoid\\[plots]'", highlight=False)
        return []
    with progress() as bar:
        job = bar.add_task("figures", total=len(logs))
        files = []
        for scenario in dict.fromkeys(log.meta["scenario"] for log in logs):
            runs = [log for log in logs if log.meta["scenario"] == scenario]
            sight = plot.sight_of(runs[-1]) if len(runs[-1].t) else None
            for log in runs:
                files += plot.plot_run(log, out, sight)
                bar.advance(job)
            if len(runs) > 1:
                files += plot.plot_compare(runs, out)
    return [*files, write_index(logs, files, out)]


def _print(metrics: list[dict[str, Any]], files: list[Path], out: Path, verbose: bool) -> None:
    """Print tables of the figures, the first events, and where files were written."""
    for scenario in dict.fromkeys(run["scenario"] for run in metrics):
        runs = [run for run in metrics if run["scenario"] == scenario]
        OUT.print(metrics_table(runs, OUT.width))
        for run in runs:
            for line in events(run):
                OUT.print(f"{run['solver']}: {line}", highlight=False, soft_wrap=True, markup=False)
    suffixes = [file.suffix for file in files]
    kinds = (suffixes.count(".npz"), "log"), (suffixes.count(".png"), "figure")
    counts = [f"{count} {kind}{'s' * (count > 1)}" for count, kind in kinds if count]
    remedy = "" if verbose else " (--verbose lists them)"
    OUT.print(f"{' and '.join(counts)} in {out}{remedy}", highlight=False, soft_wrap=True)
    for file in files if verbose else ():
        OUT.print(str(file), highlight=False, soft_wrap=True)
    page = out / "index.html"
    if page in files:
        OUT.print(f"all of it on one page: {page}", highlight=False, soft_wrap=True)
    elif page.is_file():
        OUT.print(f"{page} and its figures are those of an earlier command", highlight=False, soft_wrap=True)


def _show_warning(message: Warning | str, *_: Any) -> None:
    ERR.print(f"[yellow]warning:[/] {escape(str(message))}", highlight=False, soft_wrap=True)


def main() -> None:
    """Run the command line; turn every expected error into one line and exit status 2."""
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        app()
    except QpavoidError as error:
        ERR.print(f"[red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)
