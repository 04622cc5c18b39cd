"""The robot.yaml and the SRDF of a description, as text, and the lines that sum it up."""

from __future__ import annotations

import os.path
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from qpavoid.config import Body
from qpavoid.config.shipped import EXAMPLES, example_robot
from qpavoid.errors import ConfigError
from qpavoid.model.notes import Note, NoteKind, abbreviate
from qpavoid.setup.add import Description
from qpavoid.setup.srdf import MADE_BY, srdf_text


def description_files(description: Description, folder: Path, command: str = "") -> dict[Path, str]:
    """Write the files of a description.

    Args:
        description: what they say.
        folder: where they are to stand; paths in them are relative to it.
        command: that makes them again.
    """
    srdf, head = folder / f"{description.config.name}.srdf", f"{description.config.name}: {MADE_BY}"
    comments = [head, *(f"{what.capitalize()}: {line}." for what, line in summary(description))]
    comments += [*note_lines(description.notes), *([f"Again: {command}"] if command else [])]
    lines = [*(f"# {line}" for line in comments), *_robot_yaml(description, folder, srdf.name), ""]
    ends = description.config.end_effectors
    return {
        folder / "robot.yaml": "\n".join(lines),
        srdf: srdf_text(description.robot.model.name, head, description.disabled, ends),
    }


def write_files(contents: Mapping[Path, str], force: bool = False) -> dict[Path, str]:
    """Write all files, or none.

    Args:
        contents: what each is to hold.
        force: overwrites files that hold something else.

    Returns:
        For each file `written`, `unchanged` or `updated`.

    Raises:
        ConfigError: a file is there and holds something else; or it cannot be written.
    """
    outcome = {}
    try:
        for path, content in contents.items():
            old = path.read_bytes() if path.exists() else None
            outcome[path] = "written" if old is None else "updated"
            if old == content.encode():
                outcome[path] = "unchanged"
            elif old is not None and not force:
                raise ConfigError(
                    f"{path}: is there already, with something else in it: left as it is; --force overwrites it, "
                    "--out DIR writes elsewhere"
                )
        for path in (path for path, what in outcome.items() if what != "unchanged"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(contents[path].encode())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; give a folder that can be written with --out") from None
    return outcome


def _robot_yaml(description: Description, folder: Path, srdf: str) -> Iterator[str]:
    config = description.config
    yield f"name: {_flow(config.name)}"
    yield f"urdf: {_flow(_reference(Path(config.urdf), folder))}"
    yield f"srdf: {_flow(srdf)}"
    if config.package_dirs:
        yield f"package_dirs: {_flow([_entry(entry, folder) for entry in config.package_dirs])}"
    if config.allow_missing_meshes:
        yield "allow_missing_meshes: true"
    if config.root_joint != "fixed":
        yield f"root_joint: {config.root_joint}"
    yield f"end_effectors: {_flow(list(config.end_effectors))}"
    assert not isinstance(config.bodies, str)
    yield "bodies:" if config.bodies else "bodies: []"
    yield from _body_lines(config.bodies, description)
    if config.disabled_pairs:
        yield "disabled_pairs:   # of links that have other pairs which are checked; the rest is in the SRDF"
        yield from (f"  - {_flow(list(pair))}" for pair in config.disabled_pairs)
    if config.pair_margins:
        yield "pair_margins:   # of bodies that are near each other by design"
        yield from (f"  - {_flow({'bodies': list(own.bodies), 'd1': own.d1})}" for own in config.pair_margins)
    if config.limits.velocity:
        yield "limits:   # assumed: the file gives no speed of these"
        yield f"  velocity: {_flow(dict(config.limits.velocity))}"
    for field, values in (("home", config.home), ("lock", config.lock)):
        if values:
            yield from (f"{field}:", *(f"  {_flow(joint)}: {value:g}" for joint, value in values.items()))


def _body_lines(bodies: Sequence[Body], description: Description) -> Iterator[str]:
    last = ""
    for body in bodies:
        fields: dict[str, Any] = body.model_dump(mode="json", include={"name", "frame", "shape"})
        fields |= {key: list(value) for key in ("position", "rpy") if any(value := getattr(body, key))}
        link = description.links[body.frame]
        comment = f"   # {link.volume / link.inside:.2f} of it" if link.inside > 0.0 and body.frame != last else ""
        yield f"  - {_flow(fields)}{comment}"
        last = body.frame


def _flow(value: Any) -> str:
    text = str(yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6))
    return text.strip().removesuffix("\n...")


def _reference(urdf: Path, folder: Path) -> str:
    """Write the path of the URDF as a robot.yaml names it."""
    robots = example_robot("").resolve()
    if urdf.is_relative_to(robots):
        return f"{EXAMPLES}{urdf.relative_to(robots).as_posix()}"
    return _relative(urdf, folder)


def _entry(entry: str, folder: Path) -> str:
    """Write an entry of `package_dirs`, its folder relative to that of the robot.yaml."""
    match = re.fullmatch(r"([A-Za-z][\w.-]*)=(.+)", entry, re.DOTALL)
    return f"{match[1]}={_relative(Path(match[2]), folder)}" if match else _relative(Path(entry), folder)


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return path.as_posix()


def summary(description: Description) -> Iterator[tuple[str, str]]:
    """Yield what the bodies, the pairs and the home pose have come to, each with its name."""
    counts, options, home = description.counts, description.options, description.home
    volume, inside, hulls = (
        sum(getattr(link, name) for link in description.links.values()) for name in ("volume", "inside", "hulls")
    )
    over = ""
    if inside > 0.0:
        over = f", {volume / inside:.2f} times the {1e3 * inside:.2f} l of the geometry (hulls: {hulls / inside:.2f})"
    yield "bodies", f"{len(description.config.bodies)}, {1e3 * volume:.2f} l{over}"
    srdf_of_file = "no SRDF came with it" if description.honoured is None else f"in {description.honoured.name}"
    yield (
        "pairs",
        f"{counts['active']} of {counts['all']} are checked, {len(description.config.pair_margins)} of them with a "
        f"smaller safety distance; {counts['adjacent']} are adjacent, {counts['srdf']} disabled ({srdf_of_file}), "
        f"{counts['always']} touch always, {counts['drawn in']} when drawn in, {counts['never']} come never within "
        f"{1000 * description.near:.0f} mm ({options.samples} samples, seed {options.seed}, descent from the nearest)",
    )
    clear = "no pair is checked"
    if home.nearest is not None:
        clear = f"least distance {1000 * home.clearance:.1f} mm ({' - '.join(home.nearest)})"
    yield "home", "; ".join([clear, *(f"{frame}: {limb}" for frame, limb in home.conditioning.items())])


def note_lines(notes: Sequence[Note]) -> list[str]:
    """Write the table of notes: a line each, and another for the remedy."""
    order = {"error": 0, "warning": 1, "note": 2}
    lines = []
    for note in sorted(notes, key=lambda note: order[note.severity]):
        percentage = "" if note.fraction is None else f"{100.0 * note.fraction:.0f} %"
        names = " - ".join(note.subject) if note.kind is NoteKind.PAIR else abbreviate(note.subject)
        lines.append(
            f"{note.severity:<8} {note.kind.value:<6} {percentage:>5}  {names}{': ' if names else ''}{note.what}"
        )
        if note.remedy:
            lines.append(f"{'':24}→ {note.remedy}")
    return lines
