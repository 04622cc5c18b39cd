"""The robot.yaml and the SRDF of a description, as text, and the lines that sum it up."""

from __future__ import annotations

import hashlib
import os.path
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
import yaml

from qpavoid.config.shipped import EXAMPLES, example_robot
from qpavoid.errors import ConfigError
from qpavoid.model.joints import frame_index
from qpavoid.model.notes import SEVERITIES, Note, NoteKind, abbreviate
from qpavoid.model.robot import Robot
from qpavoid.setup.add import Description
from qpavoid.setup.joints import joint_values
from qpavoid.setup.srdf import MADE_BY, srdf_text

_WIDTH = 120
"""Of the lines of a robot.yaml [characters]."""
_AGAIN, _DIGEST = "# Again: ", "# As written: "
"""What comes before the command that writes a robot.yaml, and before the digest that tells whether it was edited."""
_OCCUPIED = (
    "is there already, with something else in it: left as it is; --force overwrites it, --out DIR writes elsewhere"
)


def description_files(description: Description, folder: Path, command: str = "") -> dict[Path, str]:
    """Write the files of a description that are to stand in a folder, and name the command that makes them again.

    Paths in them are relative to that folder.
    """
    srdf, head = folder / f"{description.config.name}.srdf", f"{description.config.name}: {MADE_BY}"
    comments = [head, *(f"{what.capitalize()}: {line}." for what, line in summary(description))]
    comments += [*note_lines(description.notes), *([_AGAIN.removeprefix("# ") + command] if command else [])]
    text = "".join(f"# {line}\n" for line in comments) + _robot_yaml(description, folder, srdf.name)
    if command:
        text = text.replace(f"{_AGAIN}{command}\n", f"{_AGAIN}{command}\n{_DIGEST}{_digest(text)}\n", 1)
    ends = description.config.end_effectors
    return {
        folder / "robot.yaml": text,
        srdf: srdf_text(description.robot.model.name, head, description.disabled, ends),
    }


def refuse_edited(folder: Path, command: str) -> None:
    """Refuse, before any work, to write over a robot.yaml that was edited, or that another command wrote.

    Raises:
        ConfigError: there is one in the folder; `write_files` would refuse what comes of the work.
    """
    path = folder / "robot.yaml"
    if path.is_file():
        text = path.read_text(encoding="utf-8", errors="replace")
        digest = re.search(f"^{re.escape(_AGAIN + command)}\n{_DIGEST}(\\w+)\n", text, re.MULTILINE)
        if digest is None or _digest(text.replace(f"{_DIGEST}{digest[1]}\n", "", 1)) != digest[1]:
            raise ConfigError(f"{path}: {_OCCUPIED}")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_files(contents: Mapping[Path, str], force: bool = False) -> dict[Path, str]:
    """Write all files, or none; `force` overwrites those that hold something else.

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
                raise ConfigError(f"{path}: {_OCCUPIED}")
        for path in (path for path, what in outcome.items() if what != "unchanged"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(contents[path].encode())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; give a folder that can be written with --out") from None
    return outcome


def _robot_yaml(description: Description, folder: Path, srdf: str) -> str:
    """Write the fields of a robot.yaml that are not as they would be without it."""
    config, given = description.config, description.config.model_dump(mode="json", exclude_defaults=True)
    fields = {"name": config.name, "urdf": "", "srdf": srdf, **given}
    fields["urdf"] = _reference(Path(config.urdf), folder)
    if config.package_dirs:
        fields["package_dirs"] = [_entry(entry, folder) for entry in config.package_dirs]
    assert not isinstance(config.bodies, str)
    fields["bodies"] = []
    for body in config.bodies:
        pose = {key: list(value) for key in ("position", "rpy") if any(value := getattr(body, key))}
        shape = body.shape.model_dump(mode="json")
        fields["bodies"].append({"name": body.name, "frame": body.frame, "shape": shape, **pose})
    return str(yaml.safe_dump(fields, default_flow_style=None, sort_keys=False, width=_WIDTH))


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
    yield "protrusion", _protrusions(description)
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


def home_facts(robot: Robot, frames: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield the home pose: the position of each joint [rad or m], and where frames are in the world [m, rad]."""
    values = joint_values(robot.model, robot.home)
    yield "home pose", ", ".join(f"{joint} {value:.4g}" for joint, value in values.items()) or "of its base alone"
    for frame, (xyz, rpy) in frame_poses(robot, frames).items():
        yield "", f"{frame}: xyz {_numbers(xyz)} m, rpy {_numbers(rpy)} rad"


def frame_poses(robot: Robot, frames: Sequence[str]) -> dict[str, tuple[list[float], list[float]]]:
    """Return where frames of a robot are at home: position in the world [m], and roll, pitch, yaw [rad]."""
    data, poses = robot.model.createData(), {}
    pin.framesForwardKinematics(robot.model, data, robot.home)
    for frame in filter(robot.model.existFrame, frames):
        pose = data.oMf[frame_index(robot.model, frame)]
        poses[frame] = np.array(pose.translation).tolist(), pin.rpy.matrixToRpy(pose.rotation).tolist()
    return poses


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value + 0.0:.3f}" for value in np.round(values, 3))


def _protrusions(description: Description) -> str:
    """Say how far the bodies of each link stand out of its geometry, by the bound that they have."""
    links, parts = description.links, list[str]()
    for bound in sorted({made.bound for made in links.values()}, reverse=True):
        those = {link: made for link, made in links.items() if made.bound == bound}
        figures = ", ".join(f"{link} {1e3 * made.protrusion:.1f}" for link, made in those.items())
        spacing = max(made.spacing for made in those.values())
        parts.append(f"of {1e3 * bound:g} mm (samples up to {1e3 * spacing:.1f} mm apart): {figures}")
    return "; ".join(parts) or "no body"


def note_lines(notes: Sequence[Note]) -> list[str]:
    """Write the table of notes: a line each, and another for the remedy."""
    lines = []
    for note in sorted(notes, key=lambda note: SEVERITIES.index(note.severity)):
        percentage = "" if note.fraction is None else f"{100.0 * note.fraction:.0f} %"
        names = " - ".join(note.subject) if note.kind is NoteKind.PAIR else abbreviate(note.subject)
        lines.append(
            f"{note.severity:<8} {note.kind.value:<6} {percentage:>5}  {names}{': ' if names else ''}{note.what}"
        )
        if note.remedy:
            lines.append(f"{'':24}→ {note.remedy}")
    return lines
