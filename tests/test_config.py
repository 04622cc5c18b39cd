"""Scenario and robot files: what they may say, and the errors when they say something else."""

import copy
import re
import typing

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

from qpavoid import ConfigError, Robot, UnknownName, config, load_scenario
from qpavoid.config import Block, RobotConfig
from qpavoid.config.loading import read_config
from qpavoid.config.shipped import data_folder, shipped_names
from qpavoid.errors import nearest
from qpavoid.run.simulate import simulate
from qpavoid.solvers import SOLVERS, parse_solver

BLOCKS = [b for b in vars(config).values() if isinstance(b, type) and issubclass(b, Block) and b is not Block]
SCENARIO = {
    "robot": "paper-dual-arm",
    "lock": ["right_joint*"],
    "q0": [-1.18, 1.13, 0.14, -1.02, 1.45, -1.07, -1.44, 0, 0, 0, 0, 0, 0, 0],
    "tasks": [{"frame": "left_tool", "motion": {"type": "line", "displacement": [0, -0.8, 0], "speed": 0.1}}],
    "obstacles": [
        {
            "name": "fist",
            "shape": {"type": "sphere", "radius": 0.05},
            "motion": {"type": "fixed", "position": [0.396, 0.411, 0.747]},
        }
    ],
    "avoidance": {"d1": 0.18, "d2": 0.36, "offset": 0.1, "row": {"type": "beta", "gain": 5}},
    "solver": {"name": "qp", "regularization": 1e-3},
    "duration": 0.05,
}
SHIPPED = data_folder("robots") / "paper-dual-arm"
ROBOT = yaml.safe_load((SHIPPED / "robot.yaml").read_text(encoding="utf-8"))
ROBOT["limits"] = {"position": {"left_joint1": [-1.0, 1.0]}, "velocity": {"left_joint2": 2.0}}


def changed(data: dict, path: str, value: object) -> dict:
    """`data` with the field at a dotted path set."""
    data = copy.deepcopy(data)
    *inner, last = (int(key) if key.isdecimal() else key for key in path.split("."))
    node = data
    for key in inner:
        node = node[key]
    node[last] = value
    return data


@pytest.fixture
def load(tmp_path):
    """Loads the scenario above, or the robot.yaml, with one field changed."""

    def load(path: str, value: object, *overrides: str, robot: bool = False, solver: str | None = None):
        file = tmp_path / ("robot.yaml" if robot else "scene.yaml")
        file.write_text(yaml.safe_dump(changed(ROBOT if robot else SCENARIO, path, value)), encoding="utf-8")
        return read_config(file, RobotConfig) if robot else load_scenario(file, overrides, solver)

    return load


def test_everything_that_ships_is_listed_and_loads():
    assert {"situation1", "situation2", "panda_line"} <= set(shipped_names("scenario"))
    for name in shipped_names("scenario"):
        scenario = load_scenario(name)
        assert scenario.source.name == f"{name}.yaml" and scenario.robot in shipped_names("robot") and scenario.title
    for name in shipped_names("robot"):
        robot = Robot.load(name)
        assert len(robot.bodies.geometryObjects) > 0 and robot.home.shape == (robot.model.nq,)


def holds(annotation: object, kinds: tuple[type, ...]) -> bool:
    arguments = typing.get_args(annotation)  # asked first: Python 3.10 takes list[float] as a type
    if not arguments and isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return BaseModel in kinds
    return annotation in kinds or any(holds(inner, kinds) for inner in arguments)


@pytest.mark.parametrize("block", BLOCKS)
def test_every_block_and_field_says_what_it_is(block):
    """Numbers with their unit in brackets; tags are explained by the block, fields that are blocks by those."""
    assert block.__doc__ and block.__doc__ != Block.__doc__
    described = block.model_json_schema().get("properties", {})
    for name, field in block.model_fields.items():
        is_tag = name in ("type", "name") and typing.get_origin(field.annotation) is typing.Literal
        description = described[name].get("description", "")
        assert is_tag or holds(field.annotation, (BaseModel,)) or description, name
        if holds(field.annotation, (int, float)):
            assert re.search(r"\[[^\]]+\]", description), name


@pytest.mark.parametrize(
    ("path", "valid"),
    [
        ("durration", "duration"),
        ("avoidance.row.gian", "gain"),
        ("solver.regularisation", "regularization"),
        ("tasks.0.wieght", "weight"),
        ("tasks.0.motion.sped", "speed"),
        ("obstacles.0.shape.radus", "radius"),
        ("robot: limits.velocty", "velocity"),
        ("robot: bodies.0.shape.lenght", "length"),
    ],
)
def test_mistyped_key_names_file_field_and_nearest_key(load, path, valid):
    is_robot, path = path.startswith("robot: "), path.removeprefix("robot: ")
    with pytest.raises(ConfigError, match=rf"\.yaml: {path}: unknown key; did you mean '{valid}'\?$"):
        load(path, 1.0, robot=is_robot)


NAN, INF = float("nan"), float("inf")
WAYPOINTS = {"type": "waypoints", "times": [0, 1], "positions": [[0, 0, 0], [1, 0, 0]]}


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("obstacles.0.shape.zzz", 1.0, "obstacles.0.shape.zzz: unknown key; valid are radius, type"),
        ("solver", "eq11", "solver: unknown name 'eq11'; did you mean 'eq10'?"),
        ("tasks.0.motion.type", "lin", "tasks.0.motion: unknown type 'lin'; did you mean 'line'?"),
        (
            "avoidance.row",
            {"type": "beta", "d1": 0.1},
            "avoidance.row.d1: unknown key; valid are gain*",
        ),
        ("solver", {"backend": "osqp"}, f"solver: `name` is missing; valid are {', '.join(sorted(SOLVERS))}"),
        ("solver", "eq10:daqp", "solver.backend: unknown key; valid are alpha_cap, damping, name, retreat_speed"),
        ("duration", "8 s", "duration: * got '8 s': give a number alone, in m, rad, kg and s"),
        ("lock", "right_joint1", "lock: * got 'right_joint1': give a list, as in [a, b]"),
        ("tasks", [], "tasks: * at least 1 *"),
        ("avoidance", None, "avoidance: must be a mapping of fields, got None"),
        ("q0", {"left_joint1": "x"}, "q0.left_joint1: * valid number*"),
        ("dt", NAN, "dt: *finite*"),
        ("obstacles.0.motion.position", [0, 0, -INF], "obstacles.0.motion.position.2: *finite*"),
        ("obstacles.0.motion.position", [0, 0], "obstacles.0.motion.position.2: is missing"),
        ("obstacles.0.shape", {"type": "box", "size": [1, 0, 1]}, "obstacles.0.shape.size.1: *greater than 0*"),
        ("dt", 0.2, "dt: *less than or equal to 0.1*"),
        ("avoidance.d1", 0.5, "avoidance: needs 0 < d1 < d2, got d1 = 0.5, d2 = 0.36"),
        ("avoidance.offset", 0.2, "avoidance: d1 = 0.18 must exceed offset = 0.2*"),
        ("avoidance.row", {"type": "damper"}, "avoidance.row: unknown type 'damper'*"),
        ("tasks.0.motion.end", [1, 0, 0], "tasks.0.motion: give exactly one of `end` and `displacement`"),
        ("tasks.0.motion", {**WAYPOINTS, "times": [0, 1, 2]}, "tasks.0.motion: 3 times but 2 positions*"),
        ("tasks.0.motion", {**WAYPOINTS, "times": [1, 1]}, "tasks.0.motion: times must increase*"),
        ("obstacles.0.motion", {"type": "fixed"}, "obstacle 'fist': motion.position is missing"),
        ("obstacles.0.motion", {"type": "circle", "radius": 1, "period": 1}, "obstacle 'fist': motion.center *"),
        ("obstacles", SCENARIO["obstacles"] * 2, "obstacle 'fist' is given twice: names must differ"),
        ("tasks", SCENARIO["tasks"] * 2, "task 'left_tool' is given twice: names must differ"),
        # lower = upper stands for no limit in a URDF, so a robot.yaml must not be able to ask for a joint held so
        ("limits.position.left_joint1", [0.5, 0.5], "limits: position of 'left_joint1'*"),
        ("home", {"left_joint1": NAN}, "home.left_joint1: *finite*"),
    ],
)
def test_bad_value_names_file_field_and_fault(load, path, value, expected):
    is_robot = path.startswith(("limits", "home"))
    with pytest.raises(ConfigError) as error:
        load(path, value, robot=is_robot)
    pattern = r".*".join(map(re.escape, expected.split("*")))
    assert re.search(rf"\.yaml: {pattern}$", str(error.value)), str(error.value)


def test_several_faults_are_named_at_once_up_to_a_number(load, tmp_path):
    with pytest.raises(ConfigError, match=r"; and 9 more$") as error:
        load("q0", [NAN] * 14)
    assert str(error.value).count("finite") == 5
    (tmp_path / "scene.yaml").write_text("robot: panda", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"tasks: is missing; duration: is missing$"):
        load_scenario(tmp_path / "scene.yaml")
    with pytest.raises(ConfigError, match="bodies"):
        Robot.from_urdf(SHIPPED / ROBOT["urdf"], bodies="convx")


def test_names_and_files_that_are_not_there(tmp_path):
    with pytest.raises(UnknownName, match="unknown scenario 'situaton1'; did you mean 'situation1'"):
        load_scenario("situaton1")
    with pytest.raises(ConfigError, match=r"absent\.yaml: no such file; .*situation1"):
        load_scenario(tmp_path / "absent.yaml")
    with pytest.raises(ConfigError, match="is a folder"):
        load_scenario(f"{tmp_path}/")
    assert nearest("zzz", ["b", "a"]) == "; valid are a, b" and nearest("zzz", []) == ""


def test_set_reaches_into_blocks_and_lists_and_makes_what_the_file_left_out(load):
    """The last one wins."""
    scenario = load(
        "title", "", "avoidance.d2=0.3", "tasks.0.motion.speed=0.2", "q0.1=0.7", "tags=[a, b]",
        "limits.velocity_scale=0.5", "dt=0.02", "dt=3e-2",
    )  # fmt: skip
    assert scenario.avoidance.d2 == 0.3 and scenario.avoidance.d1 == SCENARIO["avoidance"]["d1"]
    assert scenario.tasks[0].motion.speed == 0.2 and scenario.q0[:2] == [-1.18, 0.7] and scenario.tags == ["a", "b"]
    assert "limits" not in SCENARIO and scenario.limits.velocity_scale == 0.5 and scenario.dt == 0.03
    below = load("solver", "qp:osqp", "solver.regularization=0.5").solver
    assert (below.name, below.backend, below.regularization) == ("qp", "osqp", 0.5)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("avoidance.d2", "expected path=value"),
        ("=3", "expected path=value"),
        ("avoidance.d2=[", "not a YAML value"),
        ("title=2024-13-45", "not a YAML value"),
        ("tasks.1.gain=3", "'1' is not an index below 1"),
        ("tasks.-1.gain=3", "'-1' is not an index below 1"),
        ("q0.0.x=3", "there is nothing below q0.0"),
        ("avoidence.d2=3", "avoidence: unknown key; did you mean 'avoidance'?"),
        ("avoidance.d2=", "avoidance.d2: Input should be a valid number, got None"),
    ],
)
def test_bad_set_is_refused(load, override, expected):
    with pytest.raises(ConfigError, match=re.escape(expected)):
        load("title", "", override)


def test_solver_option_keeps_settings_only_of_the_same_name(load):
    for name, expected in (("qp", ("auto", 0.25)), ("qp:proxqp", ("proxqp", 0.25))):
        solver = load("solver.regularization", 0.25, solver=name).solver
        assert (solver.backend, solver.regularization) == expected
    assert load("solver.regularization", 0.25, solver="eq10").solver == parse_solver("eq10")
    for name, expected in (("eq11", "did you mean 'eq10'"), ("eq10:daqp", "backend")):
        with pytest.raises(ConfigError, match=expected):
            load("title", "", solver=name)
        with pytest.raises(ConfigError, match=expected):
            parse_solver(name)


@pytest.mark.parametrize("name", ["eq10", "qp:proxqp"])
def test_solver_given_in_file_option_or_call_is_the_same(load, name):
    in_file, by_option = load("solver", name), load("title", "", solver=name)
    assert in_file.solver == by_option.solver == parse_solver(name)
    v = simulate(in_file).v
    assert np.abs(v).max() > 0.01
    for other in (simulate(by_option), simulate(load("title", ""), solver=name)):
        assert np.array_equal(v, other.v)


def test_paths_are_relative_to_the_scenario(tmp_path, monkeypatch):
    arm = {**ROBOT, "name": "arm beside the scenario", "limits": {}, "urdf": str(SHIPPED / ROBOT["urdf"])}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(arm), encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(changed(SCENARIO, "robot", "arm.yaml")), encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert simulate(load_scenario("../scene.yaml")).meta["robot"] == "arm beside the scenario"
