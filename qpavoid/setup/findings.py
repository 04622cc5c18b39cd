"""The report of `robot check`."""

from __future__ import annotations

from dataclasses import dataclass, field

from qpavoid.model.notes import Note
from qpavoid.setup.home import Conditioning


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
    """Findings of `robot check`."""

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
    clearance: float | None = None
    """Least distance of any pair at the home pose [m]; None: no pair."""
    conditioning: dict[str, Conditioning] = field(default_factory=dict)
    """Of the limb that ends at each end effector, at the home pose."""
    notes: list[Note] = field(default_factory=list)
    """What was left out, mended, replaced or assumed, and what is wrong; errors first."""

    @property
    def usable(self) -> bool:
        """Whether it can run as it is."""
        return not any(note.severity == "error" for note in self.notes)
