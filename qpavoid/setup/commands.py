"""Command line: `qpavoid robot check | add`."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from rich.markup import escape

from qpavoid.config.base import LARGEST
from qpavoid.config.shipped import find_robot
from qpavoid.errors import ConfigError
from qpavoid.model.notes import Note
from qpavoid.model.robot import Robot
from qpavoid.run.report import to_json
from qpavoid.run.terminal import ERR, OUT
from qpavoid.setup.add import PROTRUSION, WRIST_PROTRUSION, DescribeOptions, Description, Root, describe
from qpavoid.setup.check import Report, check_robot
from qpavoid.setup.fit import Bodies
from qpavoid.setup.joints import Joint, joint_values
from qpavoid.setup.pairs import pair_reasons, reasons_in_words
from qpavoid.setup.sampling import SAMPLES, SEED
from qpavoid.setup.texts import (
    description_files,
    frame_poses,
    home_facts,
    note_lines,
    refuse_edited,
    summary,
    write_files,
)

_PATIENCE = 2.0
"""Least time between two lines of progress [s]."""

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Look a robot over, or describe one for the first time."
)

ViewIt = Annotated[
    bool, typer.Option("--view", help="Show it in a browser: bodies over meshes, a slider a joint, its pairs.")
]
Port = Annotated[int, typer.Option(help="Of that page; the next free one if it is taken.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else on stdout.")]
PackageDirs = Annotated[
    list[Path] | None, typer.Option("--package-dir", help="Folder in which package:// meshes are looked up.")
]
Packages = Annotated[
    list[str] | None, typer.Option("--package", metavar="NAME=FOLDER", help="Folder of one ROS package.")
]
MissingMeshes = Annotated[
    bool, typer.Option("--allow-missing-meshes", help="Leave out shapes whose mesh cannot be found, and name them.")
]
RootJoint = Annotated[str, typer.Option("--root", help=f"How it stands: {', '.join(get_args(Root))}.")]


@app.command()
def check(
    robot: Annotated[str, typer.Argument(help="URDF, MJCF, robot.yaml, or the name of a robot that ships.")],
    root: RootJoint = "fixed",
    package_dir: PackageDirs = None,
    package: Packages = None,
    allow_missing_meshes: MissingMeshes = False,
    json: Json = False,
    view: ViewIt = False,
    port: Port = 8080,
) -> None:
    """Look a robot over: joints, limits, geometry, pairs, home pose, time of a step; each problem with its remedy.

    The exit status is 1 when it cannot be used as it is.
    """
    report = check_robot(
        robot, _one_of(root, Root, "--root"), _entries(package_dir, package), allow_missing_meshes, Progress()
    )
    if json:
        shown = {name: value for name, value in vars(report).items() if name != "robot"}
        if (made := report.robot) is not None:
            poses = frame_poses(made, report.end_effectors)
            shown |= {"home": joint_values(made.model, made.home), "end_effector_poses": poses}
        print(to_json({**shown, "usable": report.usable}))
    else:
        OUT.print(f"[bold]{escape(report.name)}[/]  {escape(report.source)}", highlight=False, soft_wrap=True)
        _print(_facts(report), report.notes)
        if not report.notes:
            OUT.print("no problem found", highlight=False)
    if view and report.robot is not None:
        _view(report.robot, pair_reasons(report.robot), report.notes, port)
    raise typer.Exit(0 if report.usable else 1)


def _facts(report: Report) -> Iterator[tuple[str, str]]:
    """Yield what a robot has, each with its name."""
    yield "coordinates", f"{report.nq} in q, {report.nv} in v"
    for kind in dict.fromkeys(joint.kind for joint in report.joints):
        of_kind = [_joint_text(joint) for joint in report.joints if joint.kind == kind]
        yield kind, f"{len(of_kind)}: {', '.join(of_kind)}"
    yield "frames", f"{len(report.frames)}"
    shapes = ", ".join(f"{count} {shape}" for shape, count in report.shapes.items()) or "none"
    yield "geometry", f"{shapes}; {report.triangles} triangles"
    if report.load_seconds is not None:
        yield "bodies, pairs", f"{report.bodies}, {report.pairs}; loaded in {report.load_seconds:.2f} s"
    yield "end effectors", ", ".join(report.end_effectors) or "none recognised"
    if report.tick_us is not None:
        yield "control step", f"{report.tick_us:.0f} µs (median, tracks the end effectors, no obstacles)"
    if report.robot is not None:
        yield from home_facts(report.robot, report.end_effectors)
    if report.clearance is not None:
        yield "home", f"least distance {1e3 * report.clearance:.1f} mm"
    for frame, limb in report.conditioning.items():
        yield "", f"{frame}: {limb}"


def _print(facts: Iterable[tuple[str, str]], notes: Sequence[Note] = ()) -> None:
    """Print facts with their names, then the table of notes, coloured by severity."""
    for name, text in facts:
        OUT.print(f"{name:<14} {text}", highlight=False, markup=False, soft_wrap=True)
    colours = {"error": "red", "warning": "yellow", "note": "dim"}
    for line in map(escape, note_lines(notes)):
        severity = line.partition(" ")[0]
        colour = colours.get(severity)
        styled = line.replace(severity, f"[{colour}]{severity}[/]", 1) if colour else line
        OUT.print(styled, highlight=False, soft_wrap=True)


def _joint_text(joint: Joint) -> str:
    words = joint.name + (f" mimics {joint.mimics}" if joint.mimics else "") + (" locked" if joint.locked else "")
    if joint.lower is None and joint.upper is None:
        return words
    lower, upper = ("∞" if limit is None else f"{limit:.3g}" for limit in (joint.lower, joint.upper))
    return f"{words} [{'-' if joint.lower is None else ''}{lower}, {upper}]"


@app.command()
def add(
    path: Annotated[str, typer.Argument(help="URDF or MJCF.")],
    name: Annotated[str | None, typer.Option(help="Of the robot; that of the file if left out.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for what is written; NAME if left out.")] = None,
    bodies: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND|LINK=KIND", help=f"Bodies: {', '.join(get_args(Bodies))}; also for single links."),
    ] = None,
    protrusion: Annotated[
        float, typer.Option(min=1e-4, max=1.0, help="How far bodies may stand out of the geometry [m].")
    ] = PROTRUSION,
    wrist_protrusion: Annotated[
        float, typer.Option(min=1e-4, max=1.0, help="The same from the wrist on, of what comes close to a grasp [m].")
    ] = WRIST_PROTRUSION,
    wrist: Annotated[
        list[str] | None, typer.Option(help="Link that counts as from the wrist on; * and ? match; found if left out.")
    ] = None,
    root: RootJoint = "fixed",
    lock: Annotated[list[str] | None, typer.Option(help="Joint to hold at home for good; * and ? match.")] = None,
    home: Annotated[
        list[str] | None, typer.Option(metavar="JOINT=VALUE", help="Of a home pose to prefer [rad or m].")
    ] = None,
    package_dir: PackageDirs = None,
    package: Packages = None,
    allow_missing_meshes: MissingMeshes = False,
    srdf: Annotated[Path | None, typer.Option(help="SRDF to honour; one beside the URDF if left out.")] = None,
    samples: Annotated[int, typer.Option(min=1, max=1_000_000, help="Configurations drawn to judge pairs.")] = SAMPLES,
    seed: Annotated[int, typer.Option(min=0, help="Of the draw.")] = SEED,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that hold something else.")] = False,
    json: Json = False,
    view: ViewIt = False,
    port: Port = 8080,
) -> None:
    """Write a robot.yaml with collision bodies, pairs, a home pose and end effectors."""
    begin = time.perf_counter()
    kinds = _kinds(bodies or [])
    options = DescribeOptions(
        name=name, bodies=kinds.pop(""), bodies_of=kinds, protrusion=protrusion, wrist_protrusion=wrist_protrusion,
        wrist=wrist, root=_one_of(root, Root, "--root"), lock=tuple(lock or ()),
        home=_values(home or []), package_dirs=_entries(package_dir, package),
        allow_missing_meshes=allow_missing_meshes, srdf=srdf, samples=samples, seed=seed,
    )  # fmt: skip
    urdf = find_robot(path)
    if urdf.suffix in (".yaml", ".yml"):
        raise ConfigError(f"{path}: is described already; give a URDF or MJCF")
    folder = out or Path(options.name or urdf.stem)
    command = shlex.join(["qpavoid", *(word for word in sys.argv[1:] if word not in ("--force", "--json"))])
    if not force:
        refuse_edited(folder, command)
    description = describe(urdf, options, Progress())
    outcome = write_files(description_files(description, folder, command), force)
    seconds = time.perf_counter() - begin
    if json:
        print(to_json(_document(description, outcome, seconds)))
    else:
        _report(description, outcome, seconds)
    if view:
        _view(description.robot, description.reasons, description.notes, port)


def _view(robot: Robot, reasons: Mapping[frozenset[str], Any], notes: Sequence[Note], port: int) -> None:
    from qpavoid.viz.view_robot import RobotPage

    RobotPage(robot, reasons_in_words(reasons), [str(note) for note in notes], port=port).run()


def _kinds(texts: list[str]) -> dict[str, Bodies]:
    """Parse `KIND` and `LINK=KIND`: kinds by link, that of all others under no name."""
    kinds: dict[str, Bodies] = {"": "auto"}
    for text in texts:
        link, _, kind = text.rpartition("=")
        kinds[link] = _one_of(kind, Bodies, f"--bodies {text}")
    return kinds


def _values(texts: list[str]) -> dict[str, float]:
    values = {}
    for text in texts:
        try:
            joint, value = text.rsplit("=", 1)
            values[joint] = float(value)
            is_sane = abs(values[joint]) <= LARGEST  # NaN is not
        except ValueError:
            is_sane = False
        if not is_sane:
            raise ConfigError(f"--home {text}: expected JOINT=VALUE, as in elbow=1.57")
    return values


def _entries(folders: list[Path] | None, packages: list[str] | None) -> tuple[str, ...]:
    """List the entries of `package_dirs`, packages by name first."""
    for text in packages or []:
        name, equals, folder = text.partition("=")
        if not (name and equals and folder):
            raise ConfigError(f"--package {text}: expected NAME=FOLDER, as in my_robot=~/src/my_robot")
        if not Path(folder).is_dir():
            raise ConfigError(f"--package {text}: no such folder {folder!r}")
    return (*(packages or ()), *(str(folder) for folder in folders or ()))


def _one_of(value: str, kind: Any, option: str) -> Any:
    if value not in get_args(kind):
        raise ConfigError(f"{option}: {value!r} is none of {', '.join(get_args(kind))}")
    return value


def _document(description: Description, outcome: dict[Path, str], seconds: float) -> dict[str, Any]:
    links, home, config, options = description.links.values(), description.home, description.config, description.options
    return {
        "name": config.name,
        "files": {str(path): what for path, what in outcome.items()},
        "bodies": len(config.bodies),
        "bodies_volume": sum(link.volume for link in links),
        "hulls_volume": sum(link.hulls for link in links),
        "protrusion": {name: link.protrusion for name, link in description.links.items()},
        "geometry_volume": sum(link.inside for link in links),
        "pairs": dict(description.counts),
        "left_out": description.unchecked,
        "samples": options.samples,
        "seed": options.seed,
        "srdf": None if description.honoured is None else str(description.honoured),
        **config.model_dump(include={"pair_margins", "end_effectors", "home", "lock"}),
        "end_effector_poses": frame_poses(description.robot, config.end_effectors),
        "clearance": home.clearance,
        "nearest": home.nearest,
        "conditioning": home.conditioning,
        "notes": description.notes,
        "seconds": seconds,
    }


def _report(description: Description, outcome: dict[Path, str], seconds: float) -> None:
    facts, ends = dict(summary(description)), description.config.end_effectors
    home = facts.pop("home")
    shown = [*facts.items(), ("end effectors", ", ".join(ends) or "none recognised")]
    _print([*shown, *home_facts(description.robot, ends), ("home", home)], description.notes)
    where = f"in {seconds:.1f} s; in a scenario: `robot: {next(iter(outcome))}`"
    _print([*((what, str(path)) for path, what in outcome.items()), ("", where)])


class Progress:
    """Says on stderr what is done, as soon as it takes long and then every other second."""

    def __init__(self) -> None:
        self._next = time.perf_counter() + _PATIENCE

    def __call__(self, what: str) -> None:
        """Print the next step, unless a line was printed just before."""
        if time.perf_counter() >= self._next:
            ERR.print(f"{what} …", style="dim", highlight=False, markup=False, soft_wrap=True)
            self._next = time.perf_counter() + _PATIENCE
