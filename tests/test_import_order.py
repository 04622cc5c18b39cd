"""The order of imports: every arrow between rooms of the package leads to a lower level, and no circle can close."""

import ast
from collections import defaultdict
from pathlib import Path

import qpavoid

BENCH = Path(qpavoid.__file__).parents[1] / "bench" / "qpavoid_bench"
if not BENCH.is_dir():  # in a wheel it stands beside the package
    BENCH = Path(qpavoid.__file__).parents[1] / "qpavoid_bench"
FOR_BENCHMARKS = {
    "qpavoid.errors": "error classes, and how messages name a place and the nearest name",
    "qpavoid.control.obstacle_states": "ObstacleStates: where the planner puts the obstacles for that",
    "qpavoid.control.distances": "DistanceQuery: the planner that proves a case solvable checks distances, grasps too",
    "qpavoid.control.tasks": "FrameTask: which goals the scores and other libraries follow",
    "qpavoid.solvers": "parse_solver: entrants are named as in scenarios",
    "qpavoid.solvers.python_file": "laws and generators of users' files are run in one way",
    "qpavoid.solvers.backends": "the back ends that are compared",
    "qpavoid.kernels": "project: the compiled QP, which is compared with them",
    "qpavoid.geometry.bodies": "make_shape: free places for random obstacles",
    "qpavoid.perception.depth_voxels": "DepthVoxels, OwnBodiesAt, Perception, RenderedCamera: what an image costs",
    "qpavoid.perception.own_bodies": "see there",
    "qpavoid.perception.process": "see there",
    "qpavoid.perception.rendering": "see there",
    "qpavoid.viz.style": "colours and grid: figures look alike",
    "qpavoid.viz.view": "View: what a live view costs a loop",
}
"""What the benchmarks import beside public names and `qpavoid.{config,problem,model,run}`, and for what."""

LEVELS = (
    ("errors", "reason", "budget", "dynamics", "field_docs"), ("config", "problem"), ("kernels", "geometry"),
    ("solvers", "model"), ("control",), ("safety",), ("planning",), ("controller",), ("run",),
    ("viz", "perception", "service"), ("setup", "adapters"), ("cli",), ("__main__",),
)  # fmt: skip
"""Rooms (folders, and modules beside them) from the bottom up; those of one level do not know each other."""
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}
ROOT = Path(qpavoid.__file__).parent


def imported(path):
    """Modules of the package that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def arrows():
    """(room, room it imports, file) of every import between two rooms; `__init__` of the package stands above all."""
    for path in sorted(ROOT.rglob("*.py")):
        room = path.relative_to(ROOT).with_suffix("").parts[0]
        for name in imported(path):
            package, other = (*name.split(".", 2), "")[:2]
            if package == "qpavoid" and room in LEVEL and other in LEVEL and other != room:
                yield room, other, path.relative_to(ROOT).as_posix()


def test_rooms_have_a_level():
    rooms = {path.relative_to(ROOT).with_suffix("").parts[0] for path in ROOT.rglob("*.py")} - {"__init__"}
    assert rooms == set(LEVEL)


def test_imports_lead_down():
    assert [arrow for arrow in arrows() if LEVEL[arrow[0]] <= LEVEL[arrow[1]]] == []


def test_benchmarks_import_few_other_modules():
    """The benchmarks stand on public names; a module that they need beside them has a reason, and none is idle."""
    others = set()
    for path in BENCH.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or not node.module or node.module.split(".")[0] != "qpavoid":
                continue
            if node.module == "qpavoid":
                assert {alias.name for alias in node.names} <= set(qpavoid.__all__), path
            elif node.module.split(".")[1] not in ("config", "problem", "model", "run", "adapters"):
                others.add(node.module)
    assert others == set(FOR_BENCHMARKS)


def test_core_imports_the_benchmarks_from_the_command_line_alone():
    importers = {path.name for path in ROOT.rglob("*.py") if any("qpavoid_bench" in name for name in imported(path))}
    assert importers == {"cli.py"}


def test_floors_of_imports():
    below = defaultdict(set)
    for room, other, _ in arrows():
        below[room].add(other)

    def floor(room):
        return 1 + max(map(floor, below[room]), default=0)

    assert max(map(floor, LEVEL)) <= 13


def test_modules_are_short():
    lengths = {path.as_posix(): len(path.read_text(encoding="utf-8").splitlines()) for path in ROOT.rglob("*.py")}
    assert {name: length for name, length in lengths.items() if length > 350} == {}
