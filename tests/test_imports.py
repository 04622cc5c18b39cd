"""What reads, records and solves problems works without a robot library; only the package's front door brings it in."""

import subprocess
import sys
from pathlib import Path

import qpavoid

PACKAGE = Path(qpavoid.__file__).parent

ALONE = """
import importlib, sys, types
for name in ("pinocchio", "coal", "hppfcl"):
    sys.modules[name] = None                       # any import of these fails from here on
package = types.ModuleType("qpavoid")              # stands for the package without running its __init__,
package.__path__ = [sys.argv[1]]                   # which imports everything on purpose
sys.modules["qpavoid"] = package
for name in sys.argv[2:]:
    importlib.import_module(f"qpavoid.{name}")
"""


def import_alone(*modules: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", ALONE, str(PACKAGE), *modules]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


READERS = ["config", "problem", "solvers", "config.loading", "run.report", "run.log", "viz.figures"]


def test_modules_need_no_robot_library():
    done = import_alone(*READERS)
    assert done.returncode == 0, done.stderr


def test_import_check_detects_robot_libraries():
    done = import_alone("model.kinematics")
    assert done.returncode != 0
    assert "pinocchio" in done.stderr


SLOW = {
    "scipy",
    "qpsolvers",
    "osqp",
    "proxsuite",
    "typer",
    "rich",
    "matplotlib",
    "mujoco",
    "xacro",
    "trimesh",
    "asyncio",
}
"""What takes as long to import as all that a step needs, and is used by few programs."""
MOST_MODULES = 197
"""Modules of this package in one import, with a reserve of a fifth: a bound on work that no clock disturbs."""


def test_import_brings_in_what_a_step_needs():
    """scipy itself is looked for by numba, without its parts."""
    count = "import sys; from qpavoid import *; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", count], capture_output=True, text=True, timeout=600, check=True)
    modules = done.stdout.split()
    slow = {name for name in modules if name.split(".")[0] in SLOW - {"scipy"} or name.startswith("scipy.s")}
    assert not slow
    assert 50 < len([name for name in modules if name.split(".")[0] == "qpavoid"]) <= MOST_MODULES


def test_reading_a_scenario_loads_no_compiler():
    """Public names are imported at their first use: help and settings come at once."""
    count = "import sys, qpavoid; qpavoid.load_scenario('panda_line'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", count], capture_output=True, text=True, timeout=600, check=True)
    assert not {"numba", "pinocchio", "coal"} & set(done.stdout.split())


def test_public_names_exist():
    assert sorted(qpavoid.__all__) == sorted(set(qpavoid.__all__))
    for name in qpavoid.__all__:
        assert hasattr(qpavoid, name)


def test_help_says_what_each_field_of_a_named_tuple_is():
    """As the source has it below each field; Python alone says `Alias for field number 5`."""
    public = [getattr(qpavoid, name) for name in qpavoid.__all__]
    for value in public:
        for field in getattr(value, "_fields", ()):
            assert not getattr(value, field).__doc__.startswith("Alias for"), f"{value.__name__}.{field}"
    assert qpavoid.Solution.v.__doc__ == "(nv,) joint velocity [rad/s or m/s]."
