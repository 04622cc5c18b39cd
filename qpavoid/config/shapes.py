"""Shapes of bodies given by hand, and of obstacles, which may have some more."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from qpavoid.config.base import Block, Positive


class Sphere(Block):
    """Sphere about the origin."""

    type: Literal["sphere"] = "sphere"
    radius: Positive
    """Radius [m]."""


class Capsule(Block):
    """Segment along z, centred on the origin, swept by a sphere."""

    type: Literal["capsule"] = "capsule"
    radius: Positive
    """Radius [m]."""
    length: Positive
    """Length of the axis between the centres of the two caps [m]."""


class Box(Block):
    """Cuboid centred on the origin."""

    type: Literal["box"] = "box"
    size: tuple[Positive, Positive, Positive]
    """Full side lengths along x, y, z [m]."""


class Cylinder(Block):
    """Cylinder along z, centred on the origin."""

    type: Literal["cylinder"] = "cylinder"
    radius: Positive
    """Radius [m]."""
    length: Positive
    """Height along z [m]."""


class Cone(Block):
    """Cone along z: base at z = -length/2, tip at z = length/2."""

    type: Literal["cone"] = "cone"
    radius: Positive
    """Radius of the base [m]."""
    length: Positive
    """Height along z [m]."""


class Ellipsoid(Block):
    """Ellipsoid about the origin."""

    type: Literal["ellipsoid"] = "ellipsoid"
    radii: tuple[Positive, Positive, Positive]
    """Semi-axes along x, y, z [m]."""


class HalfSpace(Block):
    """All that lies below the plane z = 0 of its frame: the ground, or a wall whose z axis points into the room."""

    type: Literal["half_space"] = "half_space"


class Mesh(Block):
    """Triangle mesh from a file (STL, OBJ, PLY, DAE)."""

    type: Literal["mesh"] = "mesh"
    path: str
    """The file: relative to the scenario file, absolute, or `example-robot-data:PATH`."""
    scale: Positive = 1.0
    """Length of the file's unit [m]."""
    method: Literal["convex", "decomposed", "surface"] = "decomposed"
    """`convex`: its hull. `decomposed`: hulls of pieces, which enclose it together. `surface`: the triangles,
    100 to 500 µs a pair at every control step; once a body cuts through them, no direction is safe: the robot stops."""
    max_pieces: Annotated[int, Field(ge=1, le=64)] = 16
    """Of `decomposed`: most pieces [-]; each is a body of its own, with its pairs."""
    tolerance: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Of `decomposed`: volume that pieces may enclose beyond the mesh, as a share of the volume of its hull [-]."""


class PointCloud(Block):
    """Points as from a depth camera, merged into voxels; each voxel counts as the sphere around it."""

    type: Literal["point_cloud"] = "point_cloud"
    path: str | None = None
    """Points to start with [m], relative to the scenario file: `.npy` (n, 3), or `.csv` with the header `x,y,z`; left
    out: none until a program gives some."""
    resolution: Annotated[float, Field(ge=1e-3, le=1.0)] = 0.02
    """Edge of a voxel [m]; its sphere has a radius of √3/2 of it."""
    nearest: Annotated[int, Field(ge=1, le=32)] = 8
    """How many voxels each body of the robot keeps clear of at a time [-]: the nearest at different places of the body,
    then the nearest in different directions."""


Shape = Annotated[Sphere | Capsule | Box | Cylinder | Cone | Ellipsoid, Field(discriminator="type")]
ObstacleShape = Annotated[
    Sphere | Capsule | Box | Cylinder | Cone | Ellipsoid | HalfSpace | Mesh | PointCloud, Field(discriminator="type")
]
