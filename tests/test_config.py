"""Scenario and robot files: what they may say, and the errors when they say something else."""

import copy
import re
import typing

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

from qpavoid import ConfigError, Robot, UnknownName, config, load_scenario
from qpavoid.config import Block, RobotConfig, ScenarioConfig
from qpavoid.config.loading import read_config
from qpavoid.config.shipped import data_folder, robot_names, scenario_names
from qpavoid.errors import nearest
from qpavoid.run.simulate import simulate
from qpavoid.solvers import SOLVERS, parse_solver

BLOCKS = [b for b in vars(config).values() if isinstance(b, type) and issubclass(b, Block) and b is not Block]
FIELDS = [(block, name) for block in BLOCKS for name in block.model_fields]
IDS = [f"{block.__name__}.{name}" for block, name in FIELDS]

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
    "avoidance": {"d1": 0.18, "d2": 0.36, "offset": 0.1, "row": {"type": "damper", "gain": 5}},
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
    """Loads the scenario above with one field changed."""

    def load(path: str, value: object, *overrides: str) -> ScenarioConfig:
        file = tmp_path / "scene.yaml"
        file.write_text(yaml.safe_dump(changed(SCENARIO, path, value)), encoding="utf-8")
        return load_scenario(file, overrides)

    return load


@pytest.fixture
def load_robot(tmp_path):
    """Loads the robot.yaml above with one field changed."""

    def load_robot(path: str, value: object) -> RobotConfig:
        file = tmp_path / "robot.yaml"
        file.write_text(yaml.safe_dump(changed(ROBOT, path, value)), encoding="utf-8")
        return read_config(file, RobotConfig)

    return load_robot


def message(error: pytest.ExceptionInfo) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


# What ships


def test_every_shipped_scenario_is_listed_and_loads():
    assert {"situation1", "situation2", "panda_line"} <= set(scenario_names())
    for name in scenario_names():
        scenario = load_scenario(name)
        assert scenario.source.name == f"{name}.yaml"
        assert scenario.robot in robot_names()
        assert scenario.title


def test_every_shipped_robot_is_listed_and_loads():
    assert {"paper-dual-arm", "panda"} <= set(robot_names())
    for name in robot_names():
        robot = Robot.load(name)
        assert robot.model.nv > 0
        assert len(robot.bodies.geometryObjects) > 0
        assert robot.home.shape == (robot.model.nq,)


# What documents itself


def numbers_in(annotation: object) -> bool:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return False
    return annotation in (int, float) or any(numbers_in(inner) for inner in typing.get_args(annotation))


def blocks_in(annotation: object) -> bool:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return True
    return any(blocks_in(inner) for inner in typing.get_args(annotation))


def is_tag(block: type[Block], name: str) -> bool:
    """Whether it chooses the block from a union, so that the block's docstring explains it."""
    return name in ("type", "name") and typing.get_origin(block.model_fields[name].annotation) is typing.Literal


@pytest.mark.parametrize("block", BLOCKS)
def test_every_block_says_what_it_is(block):
    assert block.__doc__
    assert block.__doc__ != Block.__doc__


@pytest.mark.parametrize(("block", "name"), FIELDS, ids=IDS)
def test_every_field_says_what_it_is(block, name):
    field = block.model_fields[name]
    if not is_tag(block, name) and not blocks_in(field.annotation):
        assert field.description
    if numbers_in(field.annotation):
        assert re.search(r"\[[^\]]+\]", field.description or ""), "a number without its unit in brackets"


# Mistyped keys and tags


@pytest.mark.parametrize(
    ("path", "valid"),
    [
        ("durration", "duration"),
        ("avoidance.d11", "d1"),
        ("avoidance.row.gian", "gain"),
        ("solver.regularisation", "regularization"),
        ("tasks.0.wieght", "weight"),
        ("tasks.0.motion.sped", "speed"),
        ("obstacles.0.shap", "shape"),
        ("obstacles.0.shape.radus", "radius"),
        ("obstacles.0.motion.positon", "position"),
    ],
)
def test_mistyped_key_names_file_field_and_nearest_key(load, path, valid):
    with pytest.raises(ConfigError) as error:
        load(path, 1.0)
    assert message(error).endswith(f"scene.yaml: {path}: unknown key; did you mean {valid!r}?")


@pytest.mark.parametrize(
    ("path", "valid"),
    [
        ("end_efectors", "end_effectors"),
        ("limits.velocty", "velocity"),
        ("bodies.0.fram", "frame"),
        ("bodies.0.shape.lenght", "length"),
    ],
)
def test_mistyped_key_of_a_robot(load_robot, path, valid):
    with pytest.raises(ConfigError) as error:
        load_robot(path, 1.0)
    assert message(error).endswith(f"robot.yaml: {path}: unknown key; did you mean {valid!r}?")


def test_key_that_resembles_nothing_gets_the_list_of_the_block_it_is_in(load):
    with pytest.raises(ConfigError, match=r"obstacles\.0\.shape\.zzz: unknown key; valid are radius, type$"):
        load("obstacles.0.shape.zzz", 1.0)


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("solver", "eq11", "solver: unknown name 'eq11'; did you mean 'eq10'?"),
        ("solver.name", "pq", "solver: unknown name 'pq'; did you mean 'qp'?"),
        ("tasks.0.motion.type", "lin", "tasks.0.motion: unknown type 'lin'; did you mean 'line'?"),
        ("obstacles.0.shape.type", "spher", "obstacles.0.shape: unknown type 'spher'; did you mean 'sphere'?"),
        ("avoidance.row.type", "dampr", "avoidance.row: unknown type 'dampr'; did you mean 'damper'?"),
        ("avoidance.row", {"gain": 3}, "avoidance.row: `type` is missing; valid are beta, damper, task-switching"),
        ("solver", {"backend": "osqp"}, f"solver: `name` is missing; valid are {', '.join(sorted(SOLVERS))}"),
        ("solver", "eq10:daqp", "solver.backend: unknown key; valid are alpha_cap, damping, name, retreat_speed"),
    ],
)
def test_unknown_member_of_a_union(load, path, value, expected):
    with pytest.raises(ConfigError) as error:
        load(path, value)
    assert message(error).endswith(f"scene.yaml: {expected}")


def test_settings_of_another_member_are_unknown_keys(load):
    with pytest.raises(ConfigError, match=r"avoidance\.row\.d_safe: unknown key; valid are gain, type$"):
        load("avoidance.row", {"type": "beta", "d_safe": 0.1})


# Bad values

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("path", "value", "field", "expected"),
    [
        ("duration", "long", "duration", "valid number"),
        ("duration", "8 s", "duration", "got '8 s': give a number alone, in m, rad, kg and s"),
        ("lock", "right_joint1", "lock", "got 'right_joint1': give a list"),
        ("robot", 3, "robot", "valid string"),
        ("tasks", {}, "tasks", "valid list"),
        ("tasks", [], "tasks", "at least 1"),
        ("avoidance", None, "avoidance", "must be a mapping"),
        ("solver", 3, "solver", "must be a mapping"),
        ("limits", {"saturate": "perhaps"}, "limits.saturate", "valid boolean"),
        ("q0", [0.0, "x"], "q0.1", "valid number"),
        ("q0", {"left_joint1": "x"}, "q0.left_joint1", "valid number"),
        ("q0", [0.0, NAN], "q0.1", "finite"),
        ("dt", NAN, "dt", "finite"),
        ("duration", INF, "duration", "finite"),
        ("obstacles.0.motion.position", [0, 0, -INF], "obstacles.0.motion.position.2", "finite"),
        ("obstacles.0.motion.position", [0, 0], "obstacles.0.motion.position.2", "is missing"),
        ("obstacles.0.shape.radius", -0.05, "obstacles.0.shape.radius", "greater than 0"),
        ("obstacles.0.shape", {"type": "box", "size": [1, 0, 1]}, "obstacles.0.shape.size.1", "greater than 0"),
        ("dt", -0.01, "dt", "greater than 0"),
        ("dt", 0, "dt", "greater than 0"),
        ("dt", 0.2, "dt", "less than or equal to 0.1"),
        ("duration", 0, "duration", "greater than 0"),
        ("thresholds", [NAN], "thresholds.0", "finite"),
        ("tracking_damping", -1, "tracking_damping", "greater than or equal to 0"),
        ("tasks.0.gain", -1, "tasks.0.gain", "greater than or equal to 0"),
        ("avoidance.row.gain", 0, "avoidance.row.gain", "greater than 0"),
        ("avoidance.d2", 0.18, "avoidance", "needs 0 < d1 < d2, got d1 = 0.18, d2 = 0.18"),
        ("avoidance.d1", 0.5, "avoidance", "needs 0 < d1 < d2, got d1 = 0.5, d2 = 0.36"),
        ("avoidance.d1", 0, "avoidance", "needs 0 < d1 < d2"),
        ("avoidance.d1", -0.1, "avoidance", "needs 0 < d1 < d2"),
        ("avoidance.offset", 0.2, "avoidance", "d1 = 0.18 must exceed offset = 0.2"),
        ("avoidance.row.d_safe", 0.4, "avoidance", "row.d_safe < d2"),
        ("avoidance.row.d_safe", 0.05, "avoidance", "offset <= row.d_safe"),
        ("tasks.0.motion.end", [1, 0, 0], "tasks.0.motion", "exactly one of `end` and `displacement`"),
        ("tasks.0.motion", {"type": "line", "end": [1, 0, 0]}, "tasks.0.motion.speed", "is missing"),
        ("tasks.0.motion", {"type": "line", "speed": 1}, "tasks.0.motion", "exactly one of"),
        (
            "tasks.0.motion",
            {"type": "waypoints", "times": [0, 1, 2], "positions": [[0, 0, 0], [1, 0, 0]]},
            "tasks.0.motion",
            "3 times but 2 positions",
        ),
        (
            "tasks.0.motion",
            {"type": "waypoints", "times": [0, 1], "positions": [[0, 0, 0], [1, 0, 0]], "rpys": [[0, 0, 0]]},
            "tasks.0.motion",
            "2 times but 1 rpys",
        ),
        (
            "tasks.0.motion",
            {"type": "waypoints", "times": [1, 1], "positions": [[0, 0, 0], [1, 0, 0]]},
            "tasks.0.motion",
            "times must increase",
        ),
    ],
)
def test_bad_value_names_file_and_field(load, path, value, field, expected):
    with pytest.raises(ConfigError) as error:
        load(path, value)
    assert f"scene.yaml: {field}: " in message(error)
    assert expected in message(error)
    assert ";" not in message(error).split("scene.yaml")[1], "more than one fault named for a single one"


@pytest.mark.parametrize(
    ("motion", "missing"),
    [
        ({"type": "fixed"}, "position"),
        ({"type": "line", "displacement": [1, 0, 0], "speed": 1}, "start"),
        ({"type": "circle", "radius": 1, "period": 1}, "center"),
    ],
)
def test_obstacle_without_a_place(load, motion, missing):
    with pytest.raises(ConfigError, match=rf"scene\.yaml: obstacle 'fist': motion\.{missing} is missing"):
        load("obstacles.0.motion", motion)


@pytest.mark.parametrize(
    ("path", "expected"),
    [("obstacles", "obstacle 'fist' is given twice"), ("tasks", "task 'left_tool' is given twice")],
)
def test_names_must_differ(load, path, expected):
    with pytest.raises(ConfigError, match=expected):
        load(path, SCENARIO[path] * 2)


@pytest.mark.parametrize("limits", [[1.0, -1.0], [0.5, 0.5]])
def test_position_limits_that_leave_no_range(load_robot, limits):
    """Lower = upper stands for no limit in a URDF, so a robot.yaml must not be able to ask for a joint held so."""
    with pytest.raises(ConfigError, match=r"robot\.yaml: limits: position of 'left_joint1'"):
        load_robot("limits.position.left_joint1", limits)


@pytest.mark.parametrize(("path", "value"), [("limits.velocity.left_joint2", 0), ("home", {"left_joint1": NAN})])
def test_bad_number_of_a_robot(load_robot, path, value):
    with pytest.raises(ConfigError, match=rf"robot\.yaml: {path}"):
        load_robot(path, value)


def test_bad_field_given_to_from_urdf_is_a_config_error():
    with pytest.raises(ConfigError, match="bodies"):
        Robot.from_urdf(SHIPPED / ROBOT["urdf"], bodies="convx")


def test_several_faults_are_named_at_once_up_to_a_number(load):
    with pytest.raises(ConfigError) as error:
        load("q0", [NAN] * 14)
    assert message(error).count("finite") == 5
    assert message(error).endswith("; and 9 more")


# Files that are not what they should be


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "must be a mapping of fields, got NoneType"),
        (b"# only a comment\n", "must be a mapping of fields, got NoneType"),
        (b"- 1\n- 2\n", "must be a mapping of fields, got list"),
        (b"hello", "must be a mapping of fields, got str"),
        (b"tasks: [", "not valid YAML"),
        (b"dt: 1\ndt: 2", "key 'dt' is given twice"),
        (b"title: 2024-13-45", "not valid YAML"),
        (b"!!python/object:os.system x", "not valid YAML"),
        (bytes(range(256)), "cannot be read"),
        (b"robot: panda\n1: 2\n", "1: Keys should be strings"),
    ],
)
def test_files_that_are_no_scenario(tmp_path, content, expected):
    file = tmp_path / "scene.yaml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=re.escape(expected)) as error:
        load_scenario(file)
    assert message(error).startswith(f"{file}: ")


def test_missing_fields_are_all_named(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text("robot: panda", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"tasks: is missing; duration: is missing$"):
        load_scenario(file)


def test_scenarios_that_are_not_there(tmp_path):
    with pytest.raises(UnknownName, match="unknown scenario 'situaton1'; did you mean 'situation1'"):
        load_scenario("situaton1")
    with pytest.raises(ConfigError, match=r"absent\.yaml: no such file; .*situation1"):
        load_scenario(tmp_path / "absent.yaml")
    with pytest.raises(ConfigError, match="is a folder"):
        load_scenario(f"{tmp_path}/")


def test_nearest_names_one_or_lists_all():
    assert nearest("situaton1", ["situation1", "panda_line"]) == "; did you mean 'situation1'?"
    assert nearest("zzz", ["b", "a"]) == "; valid are a, b"
    assert nearest("zzz", []) == ""


# --set


def test_set_reaches_into_blocks_and_lists(load):
    scenario = load(
        "title", "", "avoidance.d2=0.3", "tasks.0.motion.speed=0.2", "q0.1=0.7", "tags=[a, b]", "duration=1e-1"
    )
    assert scenario.avoidance.d2 == 0.3
    assert scenario.avoidance.d1 == SCENARIO["avoidance"]["d1"]
    assert scenario.tasks[0].motion.speed == 0.2
    assert scenario.q0[:2] == [-1.18, 0.7]
    assert scenario.tags == ["a", "b"]
    assert scenario.duration == 0.1


def test_set_makes_blocks_that_the_file_left_out(load):
    assert "limits" not in SCENARIO
    scenario = load("title", "", "limits.saturate=false", "limits.velocity_scale=0.5")
    assert scenario.limits.saturate is False
    assert scenario.limits.velocity_scale == 0.5


def test_the_last_set_wins(load):
    assert load("title", "", "dt=0.02", "dt=0.03").dt == 0.03


def test_set_below_a_solver_in_short_form(load):
    assert load("solver", "qp:osqp", "solver.regularization=0.5").solver.model_dump() == {
        "name": "qp",
        "backend": "osqp",
        "regularization": 0.5,
    }
    assert load("solver", "eq10", "solver.damping=0.5").solver.damping == 0.5
    assert load("title", "", "solver=eq10").solver.name == "eq10"


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("avoidance.d2", "expected path=value"),
        ("=3", "expected path=value"),
        ("avoidance.d2=[", "not a YAML value"),
        ("title=2024-13-45", "not a YAML value"),
        ("tasks.1.gain=3", "'1' is not an index below 1"),
        ("tasks.-1.gain=3", "'-1' is not an index below 1"),
        ("tasks.first.gain=3", "'first' is not an index below 1"),
        ("q0.0.x=3", "there is nothing below q0.0"),
        ("avoidance.d22=3", "avoidance.d22: unknown key; did you mean 'd2'?"),
        ("avoidence.d2=3", "avoidence: unknown key; did you mean 'avoidance'?"),
        ("avoidance.d2=", "avoidance.d2: Input should be a valid number, got None"),
        ("avoidance.d2=.nan", "avoidance.d2: Input should be a finite number"),
    ],
)
def test_bad_set(load, override, expected):
    with pytest.raises(ConfigError) as error:
        load("title", "", override)
    assert expected in message(error)


# --solver


def test_solver_option_keeps_settings_only_of_the_same_name(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(changed(SCENARIO, "solver.regularization", 0.25)), encoding="utf-8")
    assert load_scenario(file, solver="qp").solver.regularization == 0.25
    proxqp = load_scenario(file, solver="qp:proxqp").solver
    assert (proxqp.backend, proxqp.regularization) == ("proxqp", 0.25)
    assert load_scenario(file, solver="eq10").solver == parse_solver("eq10")
    with pytest.raises(ConfigError, match="solver: unknown name 'eq11'; did you mean 'eq10'"):
        load_scenario(file, solver="eq11")


@pytest.mark.parametrize("name", ["tracking", "eq10", "qp", "qp:proxqp"])
def test_solver_given_in_file_option_or_call_is_the_same(tmp_path, name):
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(changed(SCENARIO, "solver", name)), encoding="utf-8")
    in_file = load_scenario(file)
    file.write_text(yaml.safe_dump(changed(SCENARIO, "solver.name", "qp")), encoding="utf-8")
    by_option = load_scenario(file, solver=name)
    assert in_file.solver == by_option.solver == parse_solver(name, load_scenario(file).solver)
    v = simulate(in_file).v
    assert np.abs(v).max() > 0.01
    assert np.array_equal(v, simulate(by_option).v)
    assert np.array_equal(v, simulate(load_scenario(file), solver=name).v)


@pytest.mark.parametrize(("name", "expected"), [("eq11", "did you mean 'eq10'"), ("eq10:daqp", "backend")])
def test_parse_solver_says_what_is_wrong(name, expected):
    with pytest.raises(ConfigError, match=expected):
        parse_solver(name)


def test_paths_are_relative_to_the_scenario(tmp_path, monkeypatch):
    arm = {**ROBOT, "name": "arm beside the scenario", "limits": {}, "urdf": str(SHIPPED / ROBOT["urdf"])}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(arm), encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(changed(SCENARIO, "robot", "arm.yaml")), encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert simulate(load_scenario("../scene.yaml")).meta["robot"] == "arm beside the scenario"
