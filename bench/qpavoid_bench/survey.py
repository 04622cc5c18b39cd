"""`qpavoid bench robots`: every robot of example-robot-data through `qpavoid robot check` and `add`.

Each command runs in a process of its own with a time limit: a crash or a hang is a row of the table.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from qpavoid.config.shipped import example_robot_data
from qpavoid.model.notes import abbreviate
from qpavoid_bench.tables import number, table

LIMIT = 300
"""Seconds that a command may take."""
COLUMNS = ("robot", "coordinates", "bodies", "volume", "pairs", "home [mm]", "step [µs]", "seconds", "worst problem")
TEXT = """# Every robot of example-robot-data

`qpavoid bench robots` sends each of its {count} URDF files through `qpavoid robot check` and `qpavoid robot add`,
with default options and a fixed base, and then checks the robot.yaml that was written. example-robot-data {data},
pinocchio {pin}, coal {coal}; a machine with 2 cores that was busy with other things: take the times as upper bounds.

- *pairs*: as the bare URDF loads (without adjacent pairs and those that always touch) → as written;
- *bodies*: pieces of collision geometry → bodies in the written robot.yaml, and their volume in units of what the
  geometry encloses;
- *step*: median control step that tracks all end effectors near the home pose, without obstacles, bare → written;
- *home*: least distance between bodies at the written home pose;
- *seconds*: `check` of the URDF, and `add`;
- *worst problem*: the first one that `check` names of the URDF, and what `add` or the check of its robot.yaml adds.

"""


def robots(
    words: Annotated[
        list[str] | None, typer.Argument(help="Only robots with one of these words in their path.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Page to write; with words, their rows in it are replaced.")] = Path(
        "docs/robots.md"
    ),
) -> None:
    """Send every robot of example-robot-data through `robot check` and `robot add`; exit status 1 after a crash."""
    folder = example_robot_data() / "example-robot-data" / "robots"
    every = sorted(folder.rglob("*.urdf"))
    chosen = [path for path in every if not words or any(word in path.as_posix() for word in words)]
    rows = []
    with tempfile.TemporaryDirectory() as written:
        for urdf in chosen:
            rows.append(_row(urdf, folder, Path(written)))
            print(" | ".join(rows[-1]), flush=True)
    if words and out.exists():
        fresh = {row[0]: f"| {' | '.join(row)} |" for row in rows}
        lines = [fresh.get(line.split("|")[1].strip(), line) if line.startswith("| ") else line for line in _lines(out)]
        out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    else:
        packages = {"data": "example-robot-data", "pin": "pin", "coal": "coal"}
        head = TEXT.format(count=len(every), **{name: version(package) for name, package in packages.items()})
        out.write_text(head + table(COLUMNS, rows) + "\n", encoding="utf-8")
    raise typer.Exit(1 if any("CRASH" in row[-1] or "HANG" in row[-1] for row in rows) else 0)


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()


def _run(*arguments: str) -> tuple[dict[str, Any], str]:
    """Run a `robot` command; return its document, or none and its last words on stderr."""
    command = [sys.executable, "-m", "qpavoid", "robot", *arguments, "--json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return {}, f"HANG: not done after {LIMIT} s"
    crashed = "Traceback" in done.stderr
    if done.returncode in (0, 1) and done.stdout and not crashed:
        return json.loads(done.stdout), ""
    last = ([line for line in done.stderr.splitlines() if line.strip()] or ["nothing"])[-1]
    if done.returncode == 2 and not crashed:
        return {}, last.removeprefix("error: ")
    return {}, f"CRASH: exit status {done.returncode}: {last}"


def _row(urdf: Path, robots: Path, folder: Path) -> list[str]:
    """Return a robot's row of the table."""
    name = urdf.relative_to(robots).as_posix()
    bare, error_of_check = _run("check", str(urdf))
    added, error_of_add = _run("add", str(urdf), "--out", str(folder / name))
    last, error_of_result = _run("check", str(folder / name / "robot.yaml")) if added else ({}, "")
    errors = (error_of_check, error_of_add, error_of_result)
    problems = list(dict.fromkeys(text.replace(f"{urdf}: ", "") for text in errors if text))
    if bare.get("notes"):
        problems.append(_problem(bare))
    problems += [note["what"] for note in added.get("notes", ()) if note["severity"] == "warning"]
    if last and not last["usable"]:
        problems.append(f"written: {_problem(last)}")
    clearance = added.get("clearance")
    return [
        name,
        f"{last['nv']} of {bare['nv']}" if last and bare and last["nv"] != bare["nv"] else _whole(bare.get("nv")),
        f"{_whole(bare.get('bodies'))} → {_whole(added.get('bodies'))}",
        f"{added['bodies_volume'] / added['geometry_volume']:.2f}" if added.get("geometry_volume") else "",
        f"{_whole(bare.get('pairs'))} → {_whole(last.get('pairs'))}",
        _whole(1000 * clearance) if clearance is not None and last.get("pairs") else "",
        f"{_whole(bare.get('tick_us'))} → {_whole(last.get('tick_us'))}",
        f"{number(bare.get('load_seconds') or 0.0)}, {number(added['seconds'])}" if added else "",
        "; ".join(problems).replace("|", "/").replace(str(robots), "…") or "none",
    ]


def _problem(report: dict[str, Any]) -> str:
    note = report["notes"][0]
    names = f"{abbreviate(note['subject'], 5)}: " if note["subject"] else ""
    return f"{note['severity']}: {names}{note['what']}"


def _whole(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f}"
