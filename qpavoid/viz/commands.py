"""Commands that show runs: `qpavoid view | render`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress, TaskID

from qpavoid.config.loading import load_scenario
from qpavoid.errors import ConfigError
from qpavoid.run.log import Log
from qpavoid.run.simulate import simulate
from qpavoid.run.terminal import OUT, names_of, progress
from qpavoid.solvers.python_file import scenario_with_law

Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a field: avoidance.d2=0.30")
]
_MAX_LOGS = 4
"""Runs beside one another: in more, nothing can be seen."""


def view(
    sources: Annotated[
        list[str], typer.Argument(metavar="SCENARIO | LOG...", help="A scenario, or logs of `qpavoid run`.")
    ],
    solver: Annotated[
        str | None, typer.Option(help="Such as eq10, qp:proxqp or my_law.py:MyLaw; as in the file if left out.")
    ] = None,
    set_: Sets = None,
    beside: Annotated[str | None, typer.Option(help="Solver of a second robot in the same scene, translucent.")] = None,
    port: Annotated[int, typer.Option(help="Of the page; the next free one if it is taken.")] = 8080,
    host: Annotated[str, typer.Option(help="Address that serves the page; 0.0.0.0: every machine can see it.")] = (
        "127.0.0.1"
    ),
    low: Annotated[bool, typer.Option("--low", help="Coarse meshes and plain lights, for weak graphics.")] = False,
) -> None:
    """Show a scenario in a browser: drag targets and obstacles, change the solver; or play logs. Ctrl-C ends it."""
    quality = "low" if low else "high"
    if _are_logs(sources):
        from qpavoid.viz.view_replay import Replay

        _refuse_options(solver or beside, set_)
        Replay([Log.load(source) for source in sources], port=port, host=host, quality=quality).run()
    elif len(sources) > 1:
        raise ConfigError(f"{len(sources)} scenarios: give one, or logs of runs")
    else:
        from qpavoid.viz.view_session import Session

        Session(sources[0], set_ or (), solver, beside=beside, port=port, host=host, quality=quality).run()


def render(
    sources: Annotated[
        list[str], typer.Argument(metavar="SCENARIO | LOG...", help="A scenario, or logs of `qpavoid run`.")
    ],
    gif: Annotated[Path | None, typer.Option(help="Film to write.")] = None,
    mp4: Annotated[Path | None, typer.Option(help="Film to write; needs imageio-ffmpeg.")] = None,
    png: Annotated[Path | None, typer.Option(help="Picture of the closest moment of the first run.")] = None,
    solvers: Annotated[
        str | None,
        typer.Option(help="Of a scenario, side by side: tracking and its own; FILE.py:NAME for one of yours."),
    ] = None,
    set_: Sets = None,
    width: Annotated[int, typer.Option(min=64, max=3840, help="Of the film [pixels].")] = 720,
    fps: Annotated[float, typer.Option(min=1.0, max=60.0, help="Pictures a second.")] = 15.0,
    azimuth: Annotated[float | None, typer.Option(help="Direction in which it looks, about z [deg].")] = None,
    elevation: Annotated[float | None, typer.Option(help="Angle above the horizon in which it looks [deg].")] = None,
) -> None:
    """Write a film of runs, side by side, without a display."""
    from qpavoid.viz import film

    if gif is mp4 is png is None:
        raise ConfigError("nothing to write: give --gif, --mp4 or --png a file")
    if _are_logs(sources):
        _refuse_options(solvers, set_)
        logs = [Log.load(source) for source in sources]
    elif len(sources) > 1:
        raise ConfigError(f"{len(sources)} scenarios: give one, or logs of runs")
    else:
        config = load_scenario(sources[0], set_ or ())
        beside = "" if config.contacts else "tracking,"  # which holds no contacts
        names = names_of("--solvers", f"{beside}{config.solver.label}" if solvers is None else solvers)
        jobs = [scenario_with_law(sources[0], set_ or (), name) for name in dict.fromkeys(names)]
        logs = [simulate(config, law) for config, law in jobs]
    if len(logs) > _MAX_LOGS:
        raise ConfigError(f"{len(logs)} runs: at most {_MAX_LOGS} are shown side by side")
    for log in logs:
        if not len(log.t):
            raise ConfigError(f"{log.meta['scenario']} {log.meta['solver']}: a run without a step")
    for path in filter(None, (gif, mp4, png)):
        if not path.absolute().parent.is_dir():
            raise ConfigError(f"{path}: no such folder; make it first")
    sight = film.film_sight(logs, azimuth, elevation)
    stages = film.stages_of(logs, width)
    if png is not None:
        film.write_png(film.render_moment(stages, sight), png)
    if gif is not None or mp4 is not None:
        with progress() as bar:
            update = partial(_update, bar, bar.add_task("pictures", total=None))
            pictures = film.render_film(stages, fps, sight, update)
        if gif is not None:
            film.write_gif(pictures, gif, fps)
        if mp4 is not None:
            film.write_mp4(pictures, mp4, fps)
    for path in filter(None, (gif, mp4, png)):
        OUT.print(f"{path}: {path.stat().st_size // 1000} kB", highlight=False, soft_wrap=True, markup=False)


def _update(bar: Progress, job: TaskID, count_done: int, total: int) -> None:
    bar.update(job, completed=count_done, total=total)


def _are_logs(sources: Sequence[str]) -> bool:
    """Return True if all sources are logs; False if none is one.

    Raises:
        ConfigError: both kinds.
    """
    logs = [source for source in sources if source.endswith(".npz")]
    if logs and len(logs) < len(sources):
        raise ConfigError("scenarios and logs together: give one scenario, or logs alone")
    return bool(logs)


def _refuse_options(solver: str | None, set_: list[str] | None) -> None:
    if solver or set_:
        raise ConfigError("a log has its solver and its fields: --solver and --set are for scenarios")
