"""Sends every robot of example-robot-data through `qpavoid robot check` and `add`, and writes docs/robots.md.

    python -m bench.robots              # all of them
    python -m bench.robots talos pr2    # those with a word in their path: replaces their rows

Each command runs in a process of its own with a time limit: a crash or a hang is a row of the table. The exit status is
1 if there was one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

from qpavoid.config.shipped import example_robot_data
from qpavoid.model.notes import abbreviate

ROBOTS = example_robot_data() / "example-robot-data" / "robots"
OUT = Path(__file__).parent.parent / "docs" / "robots.md"
PACKAGES = {"data": "example-robot-data", "pin": "pin", "coal": "coal"}
LIMIT = 300
"""Seconds that a command may take."""
HEAD = """# Every robot of example-robot-data

`python -m bench.robots` sends each of its {count} URDF files through `qpavoid robot check` and `qpavoid robot add`,
with default options and a fixed base, and then checks the robot.yaml that was written. example-robot-data {data},
pinocchio {pin}, coal {coal}; a machine with 2 cores that was busy with other things: take the times as upper bounds.

- *pairs*: as the bare URDF loads (without adjacent pairs and those that always touch) → as written;
- *bodies*: pieces of collision geometry → bodies in the written robot.yaml, and their volume in units of what the
  geometry encloses;
- *step*: median control step that tracks all end effectors near the home pose, without obstacles, bare → written;
- *home*: least distance between bodies at the written home pose;
- *seconds*: `check` of the URDF, and `add`;
- *worst problem*: the first one that `check` names of the URDF, and what `add` or the check of its robot.yaml adds.

| robot | coordinates | bodies | volume | pairs | home [mm] | step [µs] | seconds | worst problem |
|---|---:|---:|---:|---:|---:|---:|---:|---|
"""


def run(*arguments: str) -> tuple[dict[str, Any] | None, str]:
    """Run a `robot` command; return its document, or None and its last words on stderr."""
    command = [sys.executable, "-m", "qpavoid", "robot", *arguments, "--json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return None, f"HANG: not done after {LIMIT} s"
    if done.returncode in (0, 1) and done.stdout and "Traceback" not in done.stderr:
        return json.loads(done.stdout), ""
    said = [line for line in done.stderr.splitlines() if line.strip()] or ["nothing"]
    if done.returncode == 2 and "Traceback" not in done.stderr:
        return None, said[-1].removeprefix("error: ")
    return None, f"CRASH: exit status {done.returncode}: {said[-1]}"


def row(urdf: Path, folder: Path) -> tuple[str, bool]:
    """Return a robot's row of the table, and True if every command ended as it should."""
    name = urdf.relative_to(ROBOTS).as_posix()
    checked, why = run("check", str(urdf))
    added, why_not = run("add", str(urdf), "--out", str(folder / name))
    written, why_neither = run("check", str(folder / name / "robot.yaml")) if added else (None, "")
    said = list(dict.fromkeys(text.replace(f"{urdf}: ", "") for text in (why, why_not, why_neither) if text))
    if checked and checked["notes"]:
        said.append(_problem(checked))
    if added:
        said += [note["what"] for note in added["notes"] if note["severity"] == "warning"]
    if written and not written["usable"]:
        said.append(f"written: {_problem(written)}")
    bare, made, last = checked or {}, added or {}, written or {}
    ratio = made["bodies_volume"] / made["geometry_volume"] if made and made["geometry_volume"] else None
    clear = made["clearance"] if made else None
    cells = (
        name,
        f"{last['nv']} of {bare['nv']}" if last and bare and last["nv"] != bare["nv"] else _n(bare.get("nv")),
        f"{_n(bare.get('bodies'))} → {_n(made.get('bodies'))}",
        "" if ratio is None else f"{ratio:.2f}",
        f"{_n(bare.get('pairs'))} → {_n(last.get('pairs'))}",
        "" if clear is None or not last.get("pairs") else f"{1000 * clear:.0f}",
        f"{_n(bare.get('tick_us'))} → {_n(last.get('tick_us'))}",
        f"{bare.get('load_seconds') or 0.0:.1f}, {made['seconds']:.1f}" if made else "",
        "; ".join(said).replace("|", "/").replace(str(ROBOTS), "…") or "none",
    )
    return f"| {' | '.join(cells)} |\n", not any(text.startswith(("CRASH", "HANG")) for text in said)


def _problem(report: dict[str, Any]) -> str:
    note = report["notes"][0]
    names = f"{abbreviate(note['subject'], 5)}: " if note["subject"] else ""
    return f"{note['severity']}: {names}{note['what']}"


def _n(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("words", nargs="*", help="only robots with one of these words in their path")
    words = parser.parse_args().words
    every = sorted(ROBOTS.rglob("*.urdf"))
    chosen = [path for path in every if not words or any(word in path.as_posix() for word in words)]
    rows, fine = [], True
    with tempfile.TemporaryDirectory() as folder:
        for urdf in chosen:
            line, ended_well = row(urdf, Path(folder))
            print(line, end="", flush=True)
            rows.append(line)
            fine &= ended_well
    if words and OUT.exists():
        fresh = {line.split("|")[1]: line for line in rows}
        before = OUT.read_text(encoding="utf-8").splitlines(keepends=True)
        OUT.write_text("".join(fresh.get("|".join(line.split("|")[1:2]), line) for line in before), encoding="utf-8")
    else:
        head = HEAD.format(count=len(every), **{name: version(package) for name, package in PACKAGES.items()})
        OUT.write_text(head + "".join(rows), encoding="utf-8")
    print(OUT)
    sys.exit(0 if fine else 1)


if __name__ == "__main__":
    main()
