"""Versions and hardware that results were made on, for the head of a report."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = (
    "qpavoid", "numpy", "scipy", "pin", "coal", "numba", "mujoco", "daqp", "proxsuite", "osqp", "quadprog", "qpsolvers",
    "pin-pink", "mink", "placo", "distributed", "pandas", "statsmodels",
)  # fmt: skip
"""Packages whose versions a report lists, where they are installed."""


def machine() -> dict[str, Any]:
    """Describe this machine: processor, cores, system and interpreter."""
    return {
        "cpu": cpu(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def versions(packages: Iterable[str] = PACKAGES) -> dict[str, str]:
    """Return the version of each package that is installed."""
    installed = {package: _version(package) for package in packages}
    return {package: number for package, number in installed.items() if number}


@cache
def _version(package: str) -> str:
    """Return the version of a package, nothing where it is not installed: each takes some ms to read."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def cpu() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
