"""Files from anybody: each is read or refused in one line, whatever is in it; nothing hangs, crashes or is half read.

Everything here was found by a fuzzer that loaded mutated files in child processes. What is mutated here never reaches
a C++ parser unchecked, except meshes, which therefore have a process of their own.
"""

import json
import os
import re
import signal
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import write_chain
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qpavoid import ConfigError, Controller, Log, Robot, Sample, load_scenario
from qpavoid.config import Csv, RobotConfig
from qpavoid.config.loading import read_config
from qpavoid.config.shipped import data_folder
from qpavoid.model.trajectory import build_motion
from qpavoid.run.simulate import simulate

if not hasattr(signal, "SIGALRM"):
    pytest.skip("a hang can only be stopped with SIGALRM", allow_module_level=True)

pytestmark = pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")

LIMIT = 300
"""Seconds after which a test counts as hanging, however busy the machine is."""


@pytest.fixture(autouse=True)
def in_time():
    def stop(*_):
        pytest.fail(f"not done after {LIMIT} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LIMIT)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def read_srdf(path: Path) -> Robot:
    write_chain(path.parent)
    robot = path.with_name("robot.yaml")
    robot.write_text(f"name: chain\nurdf: chain.urdf\nsrdf: {path.name}\n")
    return Robot.load(str(robot))


READERS = {
    "scene.yaml": load_scenario,
    "robot.yaml": lambda path: read_config(path, RobotConfig),
    "arm.urdf": Robot.from_urdf,
    "arm.srdf": read_srdf,
    "path.csv": lambda path: build_motion(Csv(path=path.name), Sample.at([0.0, 0.0, 0.0]), path.parent),
    "run.npz": Log.load,
}


def refusal(name: str, folder: Path) -> str:
    """Why a file is refused, or nothing: then what it holds must make sense."""
    try:
        found = READERS[name](folder / name)
    except ConfigError as error:
        message = str(error)
        assert message.isprintable() and len(message) < 2100
        assert str(folder / name) in message
        return message
    if isinstance(found, Robot):
        data = found.model.createData()
        assert np.isfinite(pin.computeJointJacobians(found.model, data, found.home)).all()
        assert np.all(found.bounds().lower < found.bounds().upper)
    if name == "path.csv":
        assert all(np.isfinite(part).all() for t in (-1.0, 0.05, 0.5, 9.0) for part in found.sample(t)[:4])
    return ""


# --- mutations -------------------------------------------------------------------------------------------------------

NUMBER = re.compile(rb"-?\d+(\.\d+)?")
PIECES = [
    *(b"nan .nan inf -.inf 1e308 -1e308 1e999 1e-320 -1 0 0x10 1_000".split()),
    *(b"\x00 \xff\xfe \xef\xbb\xbf < > & &amp; &#0; \" ' <!-- ]]> <!DOCTYPE />".split()),
    *(b"{ } [ ] : - &a *a <<: | ? ~ !!int".split()),
    *(b'"\\ud800" !!binary !!timestamp ../ /dev/zero type fixed planar \xd9\xa3'.split()),
    *(b"", b"\n", b"\r", b"\t", b" ", b",", b"A" * 3000, b"[" * 400, b"<a>" * 400),
]


@st.composite
def mutated(draw, original: bytes) -> bytes:
    """`original` with some numbers, words or bytes replaced, repeated or taken out."""
    content = original
    for _ in range(draw(st.integers(1, 4))):
        numbers = [match.span() for match in NUMBER.finditer(content)]
        begin = draw(st.integers(0, len(content)))
        end = min(len(content), begin + draw(st.sampled_from([0, 1, 5, 40])))
        if numbers and draw(st.booleans()):
            begin, end = draw(st.sampled_from(numbers))
        piece = draw(st.sampled_from(PIECES) | st.binary(max_size=3) | st.just(content[begin:end] * 2))
        content = content[:begin] + piece + content[end:]
    return content


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


LIMITS = '<limit lower="-2" upper="2" velocity="1.5" effort="1"/>'
URDF = f"""<robot name="arm">
<link name="base"/>
<link name="a"><collision><origin xyz="0 0 0.1" rpy="0 0 0"/>
<geometry><sphere radius="0.05"/></geometry></collision></link>
<link name="b"><collision><geometry><box size="0.1 0.1 0.2"/></geometry></collision></link>
<link name="c"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>{LIMITS}</joint>
<joint name="j2" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0 0 0.3"/>
<axis xyz="1 0 0"/>{LIMITS}</joint>
<joint name="j3" type="continuous"><parent link="b"/><child link="c"/><mimic joint="j1" multiplier="2"/></joint>
</robot>"""
SRDF = """<robot name="chain">
<disable_collisions link1="link0" link2="link2" reason="Never"/>
<group_state name="home" group="all"><joint name="joint1" value="1"/></group_state>
</robot>"""
CSV = "t,x,y,z,qx,qy,qz,qw\n0,0,0,0.5,0,0,0,1\n0.5,0.1,0,0.5,0,0,0.6,0.8\n1,0.1,0.2,0.5,0,0,0,1\n"
ORIGINALS = {
    "scene.yaml": (data_folder("tasks") / "panda_line.yaml").read_bytes(),
    "robot.yaml": (data_folder("robots") / "panda" / "robot.yaml").read_bytes(),
    "arm.urdf": URDF.encode(),
    "arm.srdf": SRDF.encode(),
    "path.csv": CSV.encode(),
}
COUNTS = {"scene.yaml": 120, "robot.yaml": 150, "arm.urdf": 400, "arm.srdf": 100, "path.csv": 300}
BOUNDED = settings(
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


@pytest.mark.parametrize("name", ORIGINALS)
def test_mutated_file_is_read_or_refused(name, folder):
    outcomes = set()

    @settings(BOUNDED, max_examples=COUNTS[name])
    @given(mutated(ORIGINALS[name]))
    def check(content):
        (folder / name).write_bytes(content)
        outcomes.add(bool(refusal(name, folder)))

    (folder / name).write_bytes(ORIGINALS[name])
    assert refusal(name, folder) == ""
    check()
    assert outcomes == {True, False}, "mutations that are all refused, or all read, try nothing"


# --- one by one ------------------------------------------------------------------------------------------------------


def laughs(depth: int = 8) -> str:
    """Ten lines of aliases that stand for a billion values."""
    lines = ["x0: &x0 [0]"]
    lines += [f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 10)}]" for i in range(1, depth + 1)]
    return "\n".join(lines)


def urdf(old: str, new: str) -> str:
    assert old in URDF
    return URDF.replace(old, new, 1)


ENTITIES = '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><robot name="&b;"/>'
EXTERNAL = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="a">&x;</robot>'
J2 = "joint 'j2'"
CHAIN_OF_FIXED = "".join(
    f'<link name="l{i}"/><joint name="j{i}" type="fixed"><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
    for i in range(20_000)
)
YAML = ("scene.yaml", "robot.yaml")
XML = ("arm.urdf", "arm.srdf")
TEXT = (*YAML, *XML, "path.csv")
ALL = (*TEXT, "run.npz")

CASES = [
    (YAML, "", "must be a mapping of fields, got NoneType"),
    (XML, "", "no element found"),
    ("path.csv", "", "header is ``"),
    ("run.npz", "", "not a qpavoid log"),
    (TEXT, bytes(range(256)), "cannot be read: .*give a UTF-8 text file"),
    ("run.npz", bytes(range(256)), "not a qpavoid log: .*; give one written by `qpavoid run`"),
    (TEXT, "a\0b", "holds NUL characters; give a text file"),
    (YAML, laughs(), r"more than 50000 values, aliases written out.* line 6"),
    (YAML, re.sub(r"(\[\*.*\])", r"{<<: \1}", laughs().replace("[0]", "{a: 0}")), "more than 50000 values"),
    (YAML, "a: &a [*a]", "alias 'a' stands for something that it is part of .*line 1, column 8"),
    (YAML, "a: " + "[" * 100_000, "nested more than 50 deep"),
    (YAML, "a:\n" + "- " * 100_000 + "x", "nested more than 50 deep"),
    (YAML, "{a: " * 100_000, "nested more than 50 deep"),
    (YAML, "a: " + "x" * 2_000_000, "2000003 bytes; at most 1000000 are read"),
    (YAML, "a: [" + "1," * 300_000 + "]", "more than 50000 values"),
    (YAML, "".join(f"k{i}: 1\n" for i in range(20_000)), r"k0: unknown key.*; and \d+ more$"),
    (YAML, "a: 0x" + "f" * 100_000, "a number of 100002 characters"),
    (YAML, "a: !!bool x", "does not fit its !!tag"),
    (YAML, "a: !!timestamp x", "does not fit its !!tag"),
    (YAML, 'a: "\\ud800"', "half a character pair"),
    (YAML, 'a: "x\\0"', "text with a NUL"),
    (YAML, '"a\\nb": 1', r"a\\nb: unknown key"),
    (YAML, "a: 1\na: 2", "key 'a' is given twice"),
    (XML, ENTITIES, "it has a <!DOCTYPE>; take it out"),
    (XML, EXTERNAL, "it has a <!DOCTYPE>; take it out"),
    (XML, "<robot name='x'>" + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>", "<a> is nested more than 50 deep"),
    (XML, "<robot><!--" + "x" * 11_000_000 + "--></robot>", "at most 10000000 are read"),
    (XML, "<mujoco/>", "its root is <mujoco>; must be <robot>"),
    (XML, URDF + "junk", "junk after document element"),
    ("arm.urdf", "<robot name='x'/>", "it has no link"),
    ("arm.urdf", f"<robot name='x'>{CHAIN_OF_FIXED}</robot>", "20000 links; at most 1000 are read"),
    ("arm.urdf", urdf('<link name="b">', '<link name="a">'), "link 'a' is given twice"),
    ("arm.urdf", urdf('name="j2"', 'name="j1"'), "joint 'j1' is given twice"),
    ("arm.urdf", urdf('<link name="base"/>', "<link/>"), "a link has no name; give it one"),
    ("arm.urdf", urdf('parent link="base"', 'parent link="c"'), "link 'a' hangs from a cycle of joints"),
    ("arm.urdf", urdf('parent link="a"', 'parent link="b"'), "link 'b' hangs from a cycle of joints"),
    ("arm.urdf", urdf('child link="c"', 'child link="b"'), "joint 'j3': link 'b' already hangs from 'a'"),
    ("arm.urdf", urdf("</robot>", '<link name="z"/></robot>'), "links 'base' and 'z' hang from no joint"),
    ("arm.urdf", urdf('<parent link="a"/>', ""), "joint 'j2': <parent link=…> is missing"),
    ("arm.urdf", urdf('parent link="base"', 'parent link="bas"'), "parent: no link 'bas'; did you mean 'base'"),
    ("arm.urdf", urdf('xyz="0 0 0.3"', 'xyz="0 0 nan"'), f"{J2}: origin xyz='0 0 nan': must be finite"),
    ("arm.urdf", urdf('xyz="0 0 0.3"', 'xyz="0 0 1e308"'), f"{J2}: origin xyz='0 0 1e308': must be at most 1e.09"),
    ("arm.urdf", urdf('xyz="0 0 0.3"', 'xyz="0 0 O"'), "'O' is not a number"),
    ("arm.urdf", urdf('xyz="1 0 0"', 'xyz="0 0 0"'), f"{J2}: axis xyz='0 0 0' has no length; give a direction"),
    ("arm.urdf", urdf('xyz="1 0 0"', 'xyz="1e-320 0 0"'), "has no length"),
    ("arm.urdf", urdf('<axis xyz="0 0 1"/>', "<axis/>"), "axis xyz is missing; give it 3 numbers"),
    ("arm.urdf", urdf('lower="-2"', 'lower="nan"'), "limit lower='nan': must be finite"),
    ("arm.urdf", urdf('velocity="1.5"', 'velocity="-1"'), "limit velocity=-1: must not be negative"),
    (
        "arm.urdf",
        urdf('radius="0.05"', 'radius="-1"'),
        "collision 0: sphere radius='-1': must not be negative",
    ),
    (
        "arm.urdf",
        urdf("0.1 0.1 0.2", "0.1 -1 0.2"),
        "collision 0: box size='0.1 -1 0.2': must not be negative",
    ),
    ("arm.urdf", urdf('multiplier="2"', 'multiplier="inf"'), "joint 'j3': mimic multiplier='inf': must be finite"),
    ("arm.urdf", re.sub("revolute|prismatic|continuous", "fixed", URDF), "no joint of arm.urdf moves"),
    ("arm.urdf", urdf('box size="0.1 0.1 0.2"', f'mesh filename="{"A" * 5000}.stl"'), "File name too long| … "),
    ("arm.urdf", urdf('box size="0.1 0.1 0.2"', 'mesh filename="/dev/zero"'), "name the folder that holds"),
    ("path.csv", "t,x,y,z\n0,0,0,0\n1,0,0\n", "line 3: 3 cells; give 4"),
    ("path.csv", "t,x,y,z\n0,0,0,0\n0,1,0,0\n", "line 3, t: 0.0 comes after 0.0"),
    ("path.csv", "t,x,y,z\n0,0,0,0\ninf,1,0,0\n", "line 3, t: `inf` is not a finite number"),
    ("path.csv", "t,x,y,z\n0,0,0,0\n1,1e308,0,0\n", "line 3, x: `1e308` is not a finite number of sane size"),
    ("path.csv", "t,x,y,z\n0,0,0,0\n1e-320,1,0,0\n", r"faster than 1e\+09 m/s; give it time"),
    ("path.csv", "t,x,y,z\n0,0,0,0\n1," + "9" * 200_000 + ",0,0\n", "line 3: field larger than field limit"),
    ("path.csv", "t,x,y,z\n0,0,0,0\n1," + "x" * 100_000 + ",0,0\n", "line 3, x: .* … .*correct the cell"),
    ("path.csv", 't,x,y,z\n0,0,0,0\n1,"0\n0",0,0\n', r"`0\\n0` is not a finite number"),
    ("path.csv", "\x1b[31m,x,y,z\n", r"header is `\\x1b\[31m,x,y,z`"),
    ("path.csv", "t,x,y,z\n" + "".join(f"{i},0,0,0\n" for i in range(1_000_000)), "more than 100000 rows"),
    ("path.csv", "0,0,0,0\n" * 3_000_000, "24000000 bytes; at most 20000000 are read"),
]
ONE_BY_ONE = [
    pytest.param(name, content, expected, id=f"{name}-{i}")
    for i, (names, content, expected) in enumerate(CASES)
    for name in ((names,) if isinstance(names, str) else names)
]


@pytest.mark.parametrize(("name", "content", "expected"), ONE_BY_ONE)
def test_file_is_refused(name, content, expected, tmp_path):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    assert re.search(expected, refusal(name, tmp_path))


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_what_is_no_ordinary_file_is_refused(name, make, tmp_path):
    make(tmp_path / name)
    if name == "arm.srdf":
        write_chain(tmp_path)
        (tmp_path / "robot.yaml").write_text("name: a\nurdf: chain.urdf\nsrdf: arm.srdf\n")
        with pytest.raises(ConfigError, match=r"robot\.yaml: srdf: no such file 'arm\.srdf'"):
            Robot.load(str(tmp_path / "robot.yaml"))
    else:
        assert re.search("folder|no such file|ordinary", refusal(name, tmp_path))


@pytest.mark.parametrize("name", ["a/" * 3000, "a\0/b", "\ud800/b"])
def test_names_that_no_file_can_have(name, tmp_path):
    for call in (load_scenario, Robot.load, Log.load):
        with pytest.raises(ConfigError, match="no such file") as error:
            call(name)
        assert str(error.value).isprintable()
    with pytest.raises(ConfigError, match=r"motion\.path: cannot be read"):
        build_motion(Csv(path=name), Sample.at([0.0, 0.0, 0.0]), tmp_path)
    (tmp_path / "robot.yaml").write_text("name: a\nurdf: a.urdf\n")
    with pytest.raises(ConfigError, match="no such file"):
        Robot.from_urdf(tmp_path / name)


def test_aliases_and_marks_that_do_no_harm_are_read(tmp_path):
    text = ORIGINALS["scene.yaml"].decode().replace("title:", "tags_: &tags [a]\ntitle:", 1)
    (tmp_path / "scene.yaml").write_text(
        "\ufeff" + text.replace("tags_: &tags [a]\n", "").replace("[panda, ", "[&p panda, *p, ")
    )
    assert load_scenario(tmp_path / "scene.yaml").tags[:2] == ["panda", "panda"]
    (tmp_path / "path.csv").write_text("\ufeff" + CSV, encoding="utf-8")
    assert refusal("path.csv", tmp_path) == ""


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("tags=" + "[" * 5000, "is not a YAML value"),
        ("tags=&a [*a]", "is not a YAML value"),
        ('tasks.0.frame="\\ud800"', "is not a YAML value"),
        ("tasks." + "9" * 5000 + ".gain=1", "is not an index below 1"),
        ("duration=1e8", r"duration / dt is 1e\+10 control steps; at most 1000000"),
        ("obstacles.0.motion.position=[1e308, 0, 0]", "less than or equal to 1000000000"),
        ("obstacles.0.shape.size=[1e308, 1, 1]", "less than or equal to 1000000000"),
    ],
)
def test_bad_set(override, expected):
    with pytest.raises(ConfigError, match=expected) as error:
        load_scenario("panda_line", [override])
    assert str(error.value).isprintable()


@pytest.mark.parametrize(
    "motion",
    [
        {"type": "circle", "center": [0, 0, 0], "radius": 1, "period": 1e-320},
        {"type": "waypoints", "times": [0, 1e-320], "positions": [[0, 0, 0], [1, 0, 0]]},
        {"type": "csv", "path": "/dev/zero"},
    ],
)
def test_motion_that_no_clock_can_follow(motion):
    scenario = load_scenario("panda_line", [f"obstacles.0.motion={json.dumps(motion)}"])
    with pytest.raises(ConfigError, match=r"panda_line\.yaml: obstacles\.0: .*(faster than 1e\+09|cannot be read)"):
        Controller.from_scenario(scenario)


def test_limits_of_absurd_size_are_none(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF.replace('lower="-2" upper="2"', 'lower="-1e308" upper="1e308"'))
    assert refusal("arm.urdf", tmp_path) == ""
    assert Robot.from_urdf(tmp_path / "arm.urdf").bounds().q_index.size == 0


def test_more_bodies_than_there_is_time_for(tmp_path):
    shape = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    (tmp_path / "arm.urdf").write_text(urdf('<link name="base"/>', f'<link name="base">{shape * 301}</link>'))
    assert "303 collision shapes; at most 300 are read" in refusal("arm.urdf", tmp_path)
    ball = {"frame": "link1", "shape": {"type": "sphere", "radius": 0.1}}
    with pytest.raises(ConfigError, match="301 bodies; at most 300 are read: list fewer under `bodies`"):
        Robot.from_urdf(write_chain(tmp_path), bodies=[{"name": f"b{i}", **ball} for i in range(301)])


# --- logs ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arrays(tmp_path_factory):
    path = simulate(load_scenario("situation1", ["duration=0.05"])).save(tmp_path_factory.mktemp("log") / "run")
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"q": np.zeros(3)}, r"q has shape \(3,\); must be \(N nq\)"),
        ({"v": np.zeros((2, 7))}, r"v has shape \(2, 7\); must be \(N nv\)"),
        ({"t": np.array("x")}, "t holds <U1"),
        ({"alpha": np.array(1.0)}, r"alpha has shape \(\)"),
        ({"target": np.full((6, 1, 3), 1j)}, "target holds complex128"),
        ({"closest_pair": np.full(6, 999)}, r"closest_pair points past the \d+ that there are"),
        ({"status": np.full(6, 99, dtype=np.int8)}, "status points past"),
        ({"closest_pair": np.zeros(6)}, "closest_pair holds float64"),
        ({"slack": np.array([None])}, "allow_pickle=False"),
        ({"zzz": np.zeros(3)}, "unexpected keyword argument 'zzz'"),
        ({"meta": np.array("[" * 100_000)}, "recursion"),
    ],
)
def test_log_whose_parts_do_not_belong_together(changes, expected, arrays, tmp_path):
    np.savez(tmp_path / "run.npz", **{**arrays, **changes})
    assert re.search(expected, refusal("run.npz", tmp_path))


def test_every_array_of_a_log_is_looked_at(arrays, tmp_path):
    for name in arrays.keys() - {"meta"}:
        np.savez(tmp_path / "run.npz", **{**arrays, name: arrays[name].reshape(-1, 1, 1, 1, 1)})
        assert f"{name} has shape" in refusal("run.npz", tmp_path)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"scenario": None}, "scenario is missing"),
        ({"pairs": None}, "pairs is missing"),
        ({"config": {}}, r"config\.dt is missing"),
        ({"format": 0}, "written by another version"),
        ({"format": [1]}, "written by another version"),
    ],
)
def test_log_whose_description_is_incomplete(changes, expected, arrays, tmp_path):
    meta = np.array(json.dumps({**json.loads(str(arrays["meta"])), **changes}))
    np.savez(tmp_path / "run.npz", **{**arrays, "meta": meta})
    assert re.search(expected, refusal("run.npz", tmp_path))


@pytest.mark.parametrize(
    "header",
    [
        b"(" * 3000,
        b"-" * 5000 + b"1",
        b"{'descr': '<f8'",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (10**15,), }\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1180591620717411303424,), }\n",
    ],
)
def test_log_with_an_array_of_any_header(header, arrays, tmp_path):
    np.savez(tmp_path / "run.npz", **{name: array for name, array in arrays.items() if name != "t"})
    with zipfile.ZipFile(tmp_path / "run.npz", "a") as archive:
        archive.writestr("t.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    assert "not a qpavoid log" in refusal("run.npz", tmp_path)


def test_log_that_unpacks_to_more_than_memory_holds(tmp_path, monkeypatch):
    monkeypatch.setattr("qpavoid.run.log._MAX_SIZE", 20_000_000)
    with zipfile.ZipFile(tmp_path / "run.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.npy", bytes(30_000_000))
    assert (tmp_path / "run.npz").stat().st_size < 100_000
    assert "unpacks to 30000000 bytes; at most 20000000 are read" in refusal("run.npz", tmp_path)


def test_log_that_is_encrypted(arrays, tmp_path):
    np.savez(tmp_path / "run.npz", **arrays)
    content = bytearray((tmp_path / "run.npz").read_bytes())
    for match in list(re.finditer(rb"PK\x01\x02", content)):
        content[match.start() + 8] |= 1
    (tmp_path / "run.npz").write_bytes(content)
    assert "encrypted" in refusal("run.npz", tmp_path)


# --- meshes ----------------------------------------------------------------------------------------------------------


def stl(*triangles, count=None) -> bytes:
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(corners), 0) for corners in triangles)
    return bytes(80) + struct.pack("<I", len(triangles) if count is None else count) + body


CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
FACES = [CORNERS[[0, 2, 1]], CORNERS[[0, 1, 3]], CORNERS[[0, 3, 2]], CORNERS[[1, 2, 3]]]
NAN = np.full((3, 3), np.nan)
NOT_A_NUMBER, READER = "a corner is NaN, infinite or beyond 1e.09 m", "; export it again"
MESHES = {
    "good.stl": (stl(*FACES), None),
    "one.stl": (stl(FACES[0]), None),
    "line.stl": (stl([[0, 0, 0], [0, 0, 1], [0, 0, 2]]), None),
    "point.stl": (stl(*[np.ones((3, 3))] * 4), READER),
    "quads.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3 4\n", None),
    "nan.stl": (stl(np.diag([np.nan, 1, 1]), *FACES), NOT_A_NUMBER),
    "inf.stl": (stl(np.diag([np.inf, 1, 1]), *FACES), NOT_A_NUMBER),
    "huge.stl": (stl(np.diag([3e38, 3e38, 3e38]), *FACES), NOT_A_NUMBER),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 2 3 4\n", NOT_A_NUMBER),
    "all_nan.stl": (stl(NAN), "has no triangle|a corner is NaN"),
    "empty.stl": (b"", READER),
    "none.stl": (stl(), READER),
    "garbage.stl": (bytes(range(256)) * 20, READER),
    "count.stl": (stl(*FACES, count=2**32 - 1), READER),
    "cut.stl": (stl(*FACES)[:-30], READER),
    "garbage.obj": (b"f 1 2 3\n", READER),
    "index.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999\n", READER),
    "garbage.dae": (b"<COLLADA", READER),
    "deep.dae": (b"<COLLADA>" + b"<node>" * 20_000, READER),
    "x.unknown": (b"zz", READER),
}
IN_A_CHILD = """
import json, sys, warnings
from pathlib import Path
from qpavoid import ConfigError, Robot
warnings.simplefilter("ignore")
answers = {}
for path in sorted(Path(sys.argv[1]).glob("*.urdf")):
    for kind in ("convex", "capsule", "mesh"):
        try:
            Robot.from_urdf(path, bodies=kind)
            answers[f"{path.stem} {kind}"] = None
        except ConfigError as error:
            answers[f"{path.stem} {kind}"] = str(error)
print(json.dumps(answers))
"""


@pytest.fixture(scope="module")
def mesh_answers(tmp_path_factory):
    """What a process says that reads all of the meshes; one that takes it down leaves no answer at all."""
    folder = tmp_path_factory.mktemp("meshes")
    for name, (content, _) in MESHES.items():
        (folder / name).write_bytes(content)
        write_chain(folder, shape=f'<mesh filename="{name}"/>').rename(folder / f"{name}.urdf")
    with (folder / "big.stl").open("wb") as file:
        file.truncate(200_000_000)
    write_chain(folder, shape='<mesh filename="big.stl"/>').rename(folder / "big.stl.urdf")
    command = [sys.executable, "-c", IN_A_CHILD, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", [*MESHES, "big.stl"])
@pytest.mark.parametrize("kind", ["convex", "capsule", "mesh"])
def test_mesh_is_read_or_refused(name, kind, mesh_answers):
    expected = "200000000 bytes; at most 100000000 are read" if name == "big.stl" else MESHES[name][1]
    answer = mesh_answers[f"{name} {kind}"]
    if expected is None:
        assert answer is None
    else:
        assert re.search(expected, answer)
        assert name in answer and "\n" not in answer
