"""What a look at a robot finds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Problem:
    """Something to know or to mend."""

    severity: Literal["error", "warning", "note"]
    what: str
    remedy: str


@dataclass(frozen=True)
class Joint:
    """A joint as the file has it, with the limits that hold."""

    name: str
    kind: str
    """`fixed`, `revolute`, `continuous`, `prismatic`, `planar`, `floating` or `spherical`."""
    mimics: str | None = None
    lower: float | None = None
    """[rad or m]; None: no limit."""
    upper: float | None = None
    velocity: float | None = None
    """[rad/s or m/s]; None: no limit."""
    locked: bool = False
    led: bool = False
    """It moves with the joint that it mimics, and has no coordinate of its own."""


@dataclass
class Report:
    """What `robot check` found."""

    name: str
    source: str
    nq: int = 0
    nv: int = 0
    joints: list[Joint] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    shapes: dict[str, int] = field(default_factory=dict)
    """Pieces of collision geometry by type."""
    triangles: int = 0
    """Of all collision meshes."""
    missing_meshes: list[str] = field(default_factory=list)
    searched: list[str] = field(default_factory=list)
    """Folders in which meshes were looked for."""
    without_mass: int = 0
    """Links that move and have none."""
    bodies: int = 0
    pairs: int = 0
    home_collisions: list[tuple[str, str, float]] = field(default_factory=list)
    """Pairs that touch at the home pose, and their distance [m]."""
    end_effectors: list[str] = field(default_factory=list)
    load_seconds: float | None = None
    tick_us: float | None = None
    """Median control step that tracks all end effectors, without obstacles [µs]."""
    problems: list[Problem] = field(default_factory=list)

    @property
    def usable(self) -> bool:
        """Whether it can run as it is."""
        return not any(problem.severity == "error" for problem in self.problems)
