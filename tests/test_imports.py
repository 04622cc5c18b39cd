"""What reads, records and solves problems works without a robot library; only the package's front door brings it in."""

import subprocess
import sys
from pathlib import Path

import pytest

import qpavoid

PACKAGE = Path(qpavoid.__file__).parent

ALONE = """
import importlib, sys, types
for name in ("pinocchio", "coal", "hppfcl"):
    sys.modules[name] = None                       # any import of these fails from here on
package = types.ModuleType("qpavoid")              # stands for the package without running its __init__,
package.__path__ = [sys.argv[1]]                   # which imports everything on purpose
sys.modules["qpavoid"] = package
importlib.import_module(sys.argv[2])
"""


def import_alone(module: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", ALONE, str(PACKAGE), module]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


READERS = ["config", "problem", "solvers", "config.loading", "run.report", "run.log", "run.metrics", "viz.figures"]


@pytest.mark.parametrize("module", READERS)
def test_module_needs_no_robot_library(module):
    done = import_alone(f"qpavoid.{module}")
    assert done.returncode == 0, done.stderr


def test_import_check_detects_robot_libraries():
    """The guard would notice."""
    done = import_alone("qpavoid.model.kinematics")
    assert done.returncode != 0
    assert "pinocchio" in done.stderr


def test_every_public_name_exists():
    assert sorted(qpavoid.__all__) == sorted(set(qpavoid.__all__))
    for name in qpavoid.__all__:
        assert hasattr(qpavoid, name)
