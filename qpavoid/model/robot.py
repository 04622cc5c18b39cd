"""A robot: model, collision bodies with their pairs, joint limits, home pose; from a robot.yaml or a bare URDF."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config import RobotConfig
from qpavoid.config.loading import read_mapping, validate
from qpavoid.config.shipped import find_robot
from qpavoid.errors import ConfigError, matching, require_known
from qpavoid.model.end_effectors import end_effectors
from qpavoid.model.joints import (
    assume_speeds,
    frame_index,
    joint_bounds,
    limits_by_joint,
    middle_configuration,
    remove_joints,
    set_joints,
    set_limits,
)
from qpavoid.model.kinematics import turning_columns
from qpavoid.model.limits import JointBounds
from qpavoid.model.notes import Note, NoteKind, issue_warning, merge_notes
from qpavoid.model.packages import absolute_entries
from qpavoid.model.pairs import D1, add_self_pairs, drop_always_touching, notes_of_home, pair_array
from qpavoid.model.robot_bodies import pair_margins, robot_bodies
from qpavoid.model.urdf import apply_srdf, find_resource, is_mjcf, read_model
from qpavoid.model.urdf_tree import joints_fixed_by_limits
from qpavoid.model.xml_file import read_robot_xml
from qpavoid.problem import Array


@dataclass(frozen=True, eq=False)
class Robot:
    """Model, bodies, pairs, limits and home pose of a robot; immutable."""

    name: str
    model: Any
    """pinocchio model."""
    bodies: Any
    """pinocchio geometry model: collision bodies and the pairs among them."""
    home: Array
    """(nq,) home pose."""
    end_effectors: tuple[str, ...]
    """Frames that are meant as tools."""
    source: str
    """File that it was read from, for messages."""
    margins: Mapping[frozenset[str], float] = field(default_factory=dict)
    """Two bodies: safety distance of their own, where it is less than the scenario's [m]."""
    acceleration: Mapping[str, float] = field(default_factory=dict)
    """Joint: largest acceleration [rad/s² or m/s²]; joints left out have no such limit."""
    jerk: Mapping[str, float] = field(default_factory=dict)
    """Joint: largest jerk [rad/s³ or m/s³]; joints left out have no such limit."""
    torque: Mapping[str, float] = field(default_factory=dict)
    """Joint: largest torque or force [Nm or N], where it is not that of the file."""
    notes: tuple[Note, ...] = ()
    """What was left out, mended, replaced or assumed at loading."""
    urdf: Path = Path()
    """URDF or MJCF of the model, for what is meant to be seen of it."""
    package_dirs: tuple[str, ...] = ()
    """Folders of its packages, absolute, and `NAME=FOLDER`; see `mesh_folders`."""

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        folder: Path | None = None,
        *,
        packages: Mapping[str, str | Path] | None = None,
        **fields: Any,
    ) -> Robot:
        """Load a robot: a shipped name, a robot.yaml, a URDF (also in xacro) or an MJCF.

        What of it was left out, mended, replaced or assumed is in its `notes`, and the serious part in one
        `RobotWarning`.

        Args:
            name_or_path: what a scenario's `robot:` field says.
            folder: where relative paths are looked up first.
            packages: name of a ROS package: its folder, for `package://NAME/…`; relative ones start from the file.
            fields: fields of a robot.yaml, such as `package_dirs=["../.."]`, `root_joint="planar"` or
                `allow_missing_meshes=True`; they replace those that the file has.

        Raises:
            ConfigError, UnknownName: naming file, field and remedy.
        """
        path = find_robot(str(name_or_path), folder)
        if path.suffix not in (".yaml", ".yml"):
            return cls.from_urdf(path, packages=packages, **fields)
        return cls._from_fields({**read_mapping(path), **fields}, path, packages)

    @classmethod
    def from_urdf(cls, path: str | Path, *, packages: Mapping[str, str | Path] | None = None, **fields: Any) -> Robot:
        """Build a robot from a bare URDF or MJCF.

        Args:
            path: the file.
            packages: see `load`.
            fields: any other field of a robot.yaml, such as `bodies="capsule"` or `root_joint="free_flyer"`.

        Raises:
            ConfigError, UnknownName: naming file, field and remedy.
        """
        path = Path(path)
        bare = {"name": Path(path.name.removesuffix(".xacro")).stem, "urdf": path.name}
        return cls._from_fields({**bare, **fields}, path, packages)

    @classmethod
    def _from_fields(cls, fields: dict[str, Any], path: Path, packages: Mapping[str, str | Path] | None) -> Robot:
        config = validate(fields, RobotConfig, path)
        if packages:
            entries = [*(f"{name}={place}" for name, place in packages.items()), *config.package_dirs]
            config = config.model_copy(update={"package_dirs": entries})
        return cls.from_config(config, path)

    @classmethod
    def from_config(cls, config: RobotConfig, path: Path) -> Robot:
        """Build a robot from the fields of a robot.yaml.

        Args:
            config: its fields.
            path: the file, from which relative paths start; named in errors.

        Raises:
            ConfigError, UnknownName: naming file, field and remedy.
        """
        notes: list[Note] = []
        urdf = find_resource(config.urdf, path.parent, f"{path}: urdf")
        model = read_model(urdf, config.root_joint, notes)
        ends = _end_effectors(model, config.end_effectors, path, notes)
        bodies = robot_bodies(config, urdf, model, path, notes)
        config = config.model_copy(update={"limits": limits_by_joint(model, config.limits, path)})
        set_limits(model, config.limits, path)
        home = set_joints(model, middle_configuration(model), config.home, f"{path}: home")
        fixed = {**_fixed(urdf, config, notes), **config.lock}
        home = set_joints(model, home, fixed, f"{path}: lock")
        if fixed:
            model, bodies, index = remove_joints(model, bodies, list(fixed), home, f"{path}: lock")
            home = home[index]
        if model.nv == 0:
            raise ConfigError(
                f"{path}: no joint of {urdf.name} moves; give at least one that is neither fixed nor locked"
            )
        assume_speeds(model, notes)
        add_self_pairs(model, bodies, config.disabled_pairs, str(path))
        if config.srdf is not None:
            apply_srdf(model, bodies, find_resource(config.srdf, path.parent, f"{path}: srdf"))
        drop_always_touching(model, bodies, joint_bounds(model), notes)
        robot = cls(
            name=config.name,
            model=model,
            bodies=bodies,
            home=home,
            end_effectors=ends,
            source=str(path),
            margins=pair_margins(config, bodies, path),
            acceleration=config.limits.acceleration,
            jerk=config.limits.jerk,
            torque=config.limits.torque,
            urdf=urdf,
            package_dirs=tuple(absolute_entries(config.package_dirs, path.parent)),
        )
        notes = merge_notes([*notes, *notes_of_home(robot.near_at_home(D1), is_given=bool(config.home))])
        issue_warning(notes, str(path))
        return replace(robot, notes=tuple(notes))

    @property
    def always_touching(self) -> list[tuple[str, ...]]:
        """Pairs of bodies that were disabled at loading, because they touch in nearly every configuration."""
        return [note.subject for note in self.notes if note.kind is NoteKind.PAIR]

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints that move, in the order of q."""
        return list(self.model.names)[1:]

    @property
    def position_names(self) -> list[str]:
        """Name of each of the nq coordinates of q: the joint's, numbered where it has several."""
        return [name for joint, x in self._joints() for name in _numbered(joint, x.nq)]

    @property
    def coordinate_names(self) -> list[str]:
        """Name of each of the nv velocity coordinates: the joint's, numbered where it has several."""
        return [name for joint, x in self._joints() for name in _numbered(joint, x.nv)]

    @property
    def coordinate_units(self) -> list[str]:
        """What each of the nv velocity coordinates changes per second: `m` or `rad`."""
        turns = turning_columns(self.model)
        own = [turns[joint.idx_vExtended : joint.idx_vExtended + joint.nv] for _, joint in self._joints()]
        return ["rad" if turning else "m" for turning in np.concatenate(own)]

    @cached_property
    def home_distances(self) -> Mapping[frozenset[str], float]:
        """Return the distance of each pair of its bodies at home [m], negative in penetration."""
        data, bodies = self.model.createData(), self.bodies.createData()
        pin.computeDistances(self.model, data, self.bodies, bodies, self.home)
        names = [body.name for body in self.bodies.geometryObjects]
        pairs = zip(pair_array(self.bodies).tolist(), bodies.distanceResults, strict=True)
        return {frozenset((names[a], names[b])): float(result.min_distance) for (a, b), result in pairs}

    def safety_distance(self, a: str, b: str, d1: float) -> float:
        """Return the safety distance of two of its bodies [m].

        It is d1, the scenario's, unless the pair has a smaller one, or is nearer at home: then it is a millimetre less
        than there, so that the robot may rest at home, but no less than contact.
        """
        pair = frozenset((a, b))
        at_home = max(self.home_distances.get(pair, np.inf) - _HOME_MARGIN, 0.0)
        return min(d1, self.margins.get(pair, d1), at_home)

    def near_at_home(self, d1: float) -> list[tuple[str, str, float]]:
        """List the pairs of bodies whose safety distance is less than d1 [m] since they are near at home.

        Returns:
            Two names and the distance at home [m], negative in penetration; the nearest first.
        """
        near = [
            (min(pair), max(pair), distance)
            for pair, distance in self.home_distances.items()
            if distance - _HOME_MARGIN < min(d1, self.margins.get(pair, d1))
        ]
        return sorted(near, key=lambda entry: entry[2])

    def bounds(self) -> JointBounds:
        """Return the joint limits in tangent space; see `joint_bounds`."""
        acceleration, jerk = (
            np.array([limits.get(name, np.inf) for name, joint in self._joints() for _ in range(joint.nv)])
            for limits in (self.acceleration, self.jerk)
        )
        return replace(joint_bounds(self.model), acceleration=acceleration, jerk=jerk)

    def torque_limits(self) -> Array:
        """Return the largest torques or forces (nv,) [Nm or N]; 0 where neither robot.yaml nor URDF gives one."""
        limits = np.array(self.model.effortLimit)
        for name, joint in self._joints():
            limits[joint.idx_v : joint.idx_v + joint.nv] = self.torque.get(name, limits[joint.idx_v])
        limits[~np.isfinite(limits)] = 0.0
        return limits

    def configuration(self, values: Sequence[float] | Mapping[str, float], where: str = "q") -> Array:
        """Return the full configuration (nq,) of a scenario's `q0`.

        Args:
            values: all nq numbers, or joint: value over the home pose.
            where: file and field to name in errors.

        Raises:
            ConfigError, UnknownName: wrong number of values, unknown joint.
        """
        if isinstance(values, Mapping):
            return set_joints(self.model, self.home, values, where)
        if len(values) != self.model.nq:
            raise ConfigError(
                f"{where}: {len(values)} values for {self.model.nq} coordinates; the order is "
                f"{', '.join(self.joint_names)}"
            )
        return np.array(values, dtype=np.float64)

    def frame_id(self, name: str, where: str) -> int:
        """Return the index of a frame.

        Raises:
            UnknownName: with the nearest frame.
        """
        if not self.model.existFrame(name):
            frames = [f.name for f in self.model.frames if f.type in (pin.BODY, pin.OP_FRAME)]
            require_known(name, frames, f"{where}: {self.name} has no frame")
        return frame_index(self.model, name)

    def lock(self, patterns: Sequence[str], q: Array, where: str) -> tuple[Robot, Array]:
        """Return the robot with some joints fixed at a configuration.

        Args:
            patterns: joint names; `*` and `?` match as in file names.
            q: configuration (nq,) at which they are fixed.
            where: file and field to name in errors.

        Returns:
            The smaller robot and its part of q.

        Raises:
            UnknownName: a pattern without a joint.
        """
        locked = self.matching(patterns, where)
        if not locked:
            return self, q
        model, bodies, index = remove_joints(self.model, self.bodies, locked, q, where)
        return replace(self, model=model, bodies=bodies, home=self.home[index]), q[index]

    def matching(self, patterns: Sequence[str], where: str) -> list[str]:
        """List the joints that match some patterns, in their order.

        `*` and `?` match as in file names.

        Raises:
            UnknownName: a pattern without a joint.
        """
        return matching(patterns, self.joint_names, f"{where}: {self.name} has no joint")

    def _joints(self) -> Iterator[tuple[str, Any]]:
        return zip(self.joint_names, list(self.model.joints)[1:], strict=True)


def _numbered(name: str, count: int) -> list[str]:
    return [name] if count == 1 else [f"{name}.{i}" for i in range(count)]


_HOME_MARGIN = 1e-3
"""Distance from home at which a pair that is near there may still come nearer [m]."""


def _end_effectors(model: Any, frames_of_config: Sequence[str], path: Path, notes: list[Note]) -> tuple[str, ...]:
    """Return the listed end effectors, or those at the ends of the limbs."""
    for name in frames_of_config:
        require_known(name, [frame.name for frame in model.frames], f"{path}: end_effectors: no frame")
    ends = tuple(frames_of_config or end_effectors(model))
    if ends and not frames_of_config:
        clause = "taken as end effectors, since limbs end there"
        notes.append(Note(NoteKind.FRAME, ends, clause, "list those that you mean under `end_effectors`"))
    return ends


def _fixed(urdf: Path, config: RobotConfig, notes: list[Note]) -> dict[str, float]:
    """Find the joints whose limits in the file leave no range (`joints_fixed_by_limits`) and that the config leaves."""
    if is_mjcf(urdf):
        return {}
    fixed = joints_fixed_by_limits(read_robot_xml(urdf, "URDF"), notes)
    fixed = {name: fixed[name] for name in fixed if name not in config.limits.position and name not in config.lock}
    remedy = "give its range under `limits.position` if it moves"
    for name, value in fixed.items():
        clause = f"locked at {value:g}, which is its lower and its upper limit"
        notes.append(Note(NoteKind.JOINT, (name,), clause, remedy, "warning"))
    return fixed
