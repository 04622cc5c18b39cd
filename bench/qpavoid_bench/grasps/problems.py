"""Motion problems of MotionBenchMaker: a robot, what stands around it, where it starts and where it is to grasp.

Chamzas et al. 2022, "MotionBenchMaker: A tool to generate and benchmark motion planning datasets", RA-L 7(2). The file
has, by robot and kind of problem, a list of problems with `index`, `obstacles` (name, shape, position [m], rpy [rad]),
`start` and `goal` (joint: position [rad or m]), in the frame of the robot's base.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pinocchio as pin

from qpavoid import ConfigError, Obstacle, Pose, Robot, Scene, build_scene
from qpavoid.config import Box, Cylinder, Sphere
from qpavoid.problem import Array

FILE = "motionbenchmaker.json"
FOLDER = Path("..") / "shared" / "data"
"""Where the file is looked for if no other folder is given: beside the checkout."""


@dataclass(frozen=True)
class Problem:
    """One motion problem, with a robot that knows it as its world."""

    family: str
    """Robot and kind, such as `panda/bookshelf_small`."""
    index: int
    """Its number in the family."""
    robot: Robot
    """Joints that it locks, such as those of fingers, stay where it locks them."""
    robot_name: str
    """Shipped name of the robot, or the path of its robot.yaml."""
    obstacles: tuple[Obstacle, ...]
    """All of them stand still."""
    q_start: Array
    """(nq,) [rad or m]."""
    q_goal: Array
    """(nq,) a configuration that reaches the goal [rad or m]; others may do so too."""

    @property
    def name(self) -> str:
        """Family and number."""
        return f"{self.family}/{self.index}"

    @cached_property
    def scene(self) -> Scene:
        """Robot and obstacles, with every pair that has to be checked."""
        return build_scene(self.robot, self.obstacles)

    @cached_property
    def goal_poses(self) -> dict[str, Pose]:
        """Frame of each end effector: world pose that it has at `q_goal`."""
        model = self.robot.model
        data = model.createData()
        pin.framesForwardKinematics(model, data, self.q_goal)
        places = {frame: data.oMf[model.getFrameId(frame)] for frame in self.robot.end_effectors}
        return {frame: Pose.at(place.translation, place.rotation) for frame, place in places.items()}


def load_problems(path: str | Path = FOLDER, robots: Mapping[str, str | Path] | None = None) -> list[Problem]:
    """Load all problems of a problem set.

    Args:
        path: the file, or the folder that it is in.
        robots: robot of the file: name or path of the one to take in place of the shipped one of that name.

    Returns:
        In the order of the file.

    Raises:
        ConfigError: there is no such file, or it is not such a set.
    """
    path = Path(path) / FILE if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such problem set; name its folder with --data")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        sources = {name: str((robots or {}).get(name, name)) for name in content}
        loaded = {name: Robot.load(source) for name, source in sources.items()}
        return [
            _problem(f"{name}/{kind}", entry, loaded[name], sources[name])
            for name, kinds in content.items()
            for kind, entries in kinds.items()
            for entry in entries
        ]
    except (ValueError, KeyError, TypeError, AttributeError) as fault:
        raise ConfigError(f"{path}: not a problem set: {fault!r:.100}") from None


def _problem(family: str, entry: Mapping[str, Any], robot: Robot, robot_name: str) -> Problem:
    obstacles = tuple(
        Obstacle.at(fields["name"], _shape(fields["shape"]), fields["position"], pin.rpy.rpyToMatrix(*fields["rpy"]))
        for fields in entry["obstacles"]
    )
    start, goal = (
        robot.configuration({joint: x for joint, x in values.items() if joint in robot.joint_names}, family)
        for values in (entry["start"], {**entry["start"], **entry["goal"]})
    )
    return Problem(family, entry["index"], robot, robot_name, obstacles, start, goal)


def _shape(fields: Mapping[str, Any]) -> Box | Cylinder | Sphere:
    kinds: dict[str, Any] = {"box": Box, "cylinder": Cylinder, "sphere": Sphere}
    return kinds[fields["type"]](**fields)  # type: ignore[no-any-return]
