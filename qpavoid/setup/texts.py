"""The robot.yaml and the SRDF of a description, as text."""

from __future__ import annotations

import os.path
import re
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import yaml

from qpavoid.config import Body
from qpavoid.config.shipped import EXAMPLES, example_robot
from qpavoid.model.notes import Note, NoteKind, abbreviate
from qpavoid.setup.add import DescribeOptions, Description
from qpavoid.setup.srdf import MADE_BY, srdf_text
from qpavoid.setup.written import BLANK, seal


def description_files(description: Description, folder: Path) -> dict[Path, bytes]:
    """Write the files of a description, sealed.

    Args:
        description: what they say.
        folder: where they are to stand; paths in them are relative to it.
    """
    srdf = folder / f"{description.config.name}.srdf"
    comment = f"{description.config.name}: {MADE_BY}; {BLANK}"
    text = srdf_text(description.robot.model.name, comment, description.disabled, description.config.end_effectors)
    return {
        folder / "robot.yaml": seal(_robot_yaml(description, folder, srdf.name).encode()),
        srdf: seal(text.encode()),
    }


def _robot_yaml(description: Description, folder: Path, srdf: str) -> str:
    config = description.config
    lines = [f"# {line}" for line in [*_header(description), f"Again: {_command(description, folder)}"]]
    lines += [f"name: {_flow(config.name)}", f"urdf: {_flow(_reference(Path(config.urdf), folder))}"]
    lines.append(f"srdf: {_flow(srdf)}")
    if config.package_dirs:
        lines.append(f"package_dirs: {_flow([_entry(entry, folder) for entry in config.package_dirs])}")
    if config.allow_missing_meshes:
        lines.append("allow_missing_meshes: true")
    if config.root_joint != "fixed":
        lines.append(f"root_joint: {config.root_joint}")
    lines.append(f"end_effectors: {_flow(list(config.end_effectors))}")
    assert not isinstance(config.bodies, str)
    lines += ["bodies:" if config.bodies else "bodies: []"]
    lines += _body_lines(config.bodies, description)
    if config.disabled_pairs:
        lines.append("disabled_pairs:   # of links that have other pairs which are checked; the rest is in the SRDF")
        lines += [f"  - {_flow(list(pair))}" for pair in config.disabled_pairs]
    if config.pair_margins:
        lines.append("pair_margins:   # of bodies that are near each other by design")
        lines += [f"  - {_flow({'bodies': list(own.bodies), 'd1': own.d1})}" for own in config.pair_margins]
    if config.limits.velocity:
        lines.append("limits:   # assumed: the file gives no speed of these")
        lines.append(f"  velocity: {_flow(dict(config.limits.velocity))}")
    for field, values in (("home", config.home), ("lock", config.lock)):
        if values:
            lines += [f"{field}:", *(f"  {_flow(joint)}: {value:g}" for joint, value in values.items())]
    return "\n".join([*lines, ""])


def _header(description: Description) -> list[str]:
    lines = [f"{description.config.name}: {MADE_BY}, which leaves it alone once you edit it; {BLANK}"]
    lines += [
        f"Bodies: {volume_line(description)}.",
        f"Pairs: {pairs_line(description)}.",
        f"Home: {home_line(description)}.",
    ]
    return [*lines, *note_lines(description.notes)]


def pairs_line(description: Description) -> str:
    """Summarise how many pairs are checked, and why the others are not."""
    counts, options = description.counts, description.options
    srdf_of_file = "no SRDF came with it" if description.honoured is None else f"in {description.honoured.name}"
    return (
        f"{counts['active']} of {counts['all']} are checked, {len(description.config.pair_margins)} of them with a "
        f"smaller safety distance; {counts['adjacent']} are adjacent, {counts['srdf']} disabled ({srdf_of_file}), "
        f"{counts['always']} touch always, {counts['drawn in']} when drawn in, {counts['never']} come never within "
        f"{1000 * description.near:.0f} mm ({options.samples} samples, seed {options.seed}, descent from the nearest)"
    )


def home_line(description: Description) -> str:
    """Summarise the clearance of the home pose, and the conditioning of the limbs there."""
    home = description.home
    words = ["no pair is checked"]
    if home.nearest is not None:
        words = [f"least distance {1000 * home.clearance:.1f} mm ({' - '.join(home.nearest)})"]
    return "; ".join([*words, *(f"{frame}: {limb}" for frame, limb in home.conditioning.items())])


def note_lines(notes: Sequence[Note]) -> list[str]:
    """Write the table of notes: a line each, and another for the remedy."""
    order = {"error": 0, "warning": 1, "note": 2}
    lines = []
    for note in sorted(notes, key=lambda note: order[note.severity]):
        share = "" if note.share is None else f"{100.0 * note.share:.0f} %"
        names = " - ".join(note.subject) if note.kind is NoteKind.PAIR else abbreviate(note.subject)
        lines.append(f"{note.severity:<8} {note.kind.value:<6} {share:>5}  {names}{': ' if names else ''}{note.what}")
        if note.remedy:
            lines.append(f"{'':24}→ {note.remedy}")
    return lines


def _command(description: Description, folder: Path) -> str:
    """Write the command that makes the same files."""
    options = description.options
    words = ["qpavoid robot add", _reference(description.urdf, Path()), "--name", description.config.name]
    words += ["--out", folder.as_posix()] if folder != Path(description.config.name) else []
    words += ["--bodies", options.bodies] if options.bodies != DescribeOptions.bodies else []
    words += [word for link, kind in options.bodies_of.items() for word in ("--bodies", f"{link}={kind}")]
    words += ["--root", options.root] if options.root != DescribeOptions.root else []
    words += [word for joint in options.lock for word in ("--lock", joint)]
    words += [word for joint, value in options.home.items() for word in ("--home", f"{joint}={value:g}")]
    for entry in map(str, options.package_dirs):
        words += ["--package" if _PACKAGE.fullmatch(entry) else "--package-dir", entry]
    words += ["--allow-missing-meshes"] if options.allow_missing_meshes else []
    words += ["--srdf", options.srdf.as_posix()] if options.srdf is not None else []
    words += ["--samples", str(options.samples)] if options.samples != DescribeOptions.samples else []
    words += ["--seed", str(options.seed)] if options.seed != DescribeOptions.seed else []
    return " ".join([words[0], *(quote(word) for word in words[1:])])


def volume_line(description: Description) -> str:
    """Summarise the bodies: number, and volume beside that of the geometry and its hulls."""
    volume, inside, hulls = (
        sum(getattr(link, name) for link in description.links.values()) for name in ("volume", "inside", "hulls")
    )
    over = ""
    if inside > 0.0:
        over = f", {volume / inside:.2f} times the {1e3 * inside:.2f} l of the geometry (hulls: {hulls / inside:.2f})"
    return f"{len(description.config.bodies)}, {1e3 * volume:.2f} l{over}"


def _body_lines(bodies: Sequence[Body], description: Description) -> list[str]:
    lines, last = [], ""
    for body in bodies:
        fields: dict[str, Any] = {"name": body.name, "frame": body.frame, "shape": body.shape.model_dump()}
        fields["shape"] = {key: list(v) if isinstance(v, tuple) else v for key, v in fields["shape"].items()}
        if any(body.position):
            fields["position"] = list(body.position)
        if any(body.rpy):
            fields["rpy"] = list(body.rpy)
        link = description.links[body.frame]
        comment = f"   # {link.volume / link.inside:.2f} of it" if link.inside > 0.0 and body.frame != last else ""
        lines.append(f"  - {_flow(fields)}{comment}")
        last = body.frame
    return lines


def _flow(value: Any) -> str:
    text = str(yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6))
    return text.strip().removesuffix("\n...")


def _reference(urdf: Path, folder: Path) -> str:
    """Write the path of the URDF as a robot.yaml names it."""
    robots = example_robot("").resolve()
    if urdf.is_relative_to(robots):
        return f"{EXAMPLES}{urdf.relative_to(robots).as_posix()}"
    return _relative(urdf, folder)


_PACKAGE = re.compile(r"([A-Za-z][\w.-]*)=(.+)", re.DOTALL)
"""`NAME=FOLDER` of a package."""


def _entry(entry: str, folder: Path) -> str:
    """Write an entry of `package_dirs`, its folder relative to that of the robot.yaml."""
    match = _PACKAGE.fullmatch(entry)
    return f"{match[1]}={_relative(Path(match[2]), folder)}" if match else _relative(Path(entry), folder)


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return path.as_posix()
