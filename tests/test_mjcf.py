"""MJCF files: every geom that collides is a body, and no element vanishes."""

from collections import Counter

import pytest
from test_loading import load
from urdfs import write

from qpavoid import ConfigError

mujoco = pytest.importorskip("mujoco")

OBJ = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SPHERE = '<geom type="sphere" size=".1"/>'


def mjcf(first=SPHERE, second=SPHERE, asset="", default=""):
    """Two bodies in a row on a floor, with one hinge each."""
    return (
        f'<mujoco><compiler angle="radian"/>{default}<asset>{asset}</asset><worldbody><geom type="plane" size="1 1 1"/>'
        f'<body name="one" pos="0 0 .5"><joint name="j1" type="hinge" axis="0 1 0" range="-1 1"/>{first}'
        f'<body name="two" pos="0 0 .5"><joint name="j2" type="hinge" axis="1 0 0" range="-1 1"/>{second}'
        "</body></body></worldbody></mujoco>"
    )


def speeds(*names):
    return {"velocity": dict.fromkeys(names or ("j1", "j2"), 1.0)}


def by_body(robot):
    return Counter(robot.model.frames[body.parentFrame].name for body in robot.bodies.geometryObjects)


GEOMS = {
    "two": SPHERE + '<geom type="box" size=".1 .2 .3" pos="1 0 0"/>',
    "named": '<geom name="a" type="capsule" size=".1 .2"/><geom name="two" type="cylinder" size=".1 .2" pos="1 0 0"/>',
    "ends": '<geom type="capsule" fromto="0 0 0 0 0 1" size=".1"/>',
    "ellipsoid": '<geom type="ellipsoid" size=".1 .2 .3"/>',
    "seen alone": SPHERE + '<geom type="box" size=".5 .5 .5" contype="0" conaffinity="0"/>',
    "one of the two": '<geom type="sphere" size=".1" contype="0" conaffinity="1"/>',
    "group": '<geom type="sphere" size=".1" group="3"/>',
    "class": '<geom class="c"/><geom class="v" size=".3"/>',
    "mesh": '<geom type="mesh" mesh="part"/>',
    "site": f'<site name="s"/>{SPHERE}<camera name="c"/>',
}
DEFAULT = (
    '<default><default class="c"><geom type="box" size=".1 .1 .1"/></default>'
    '<default class="v"><geom contype="0" conaffinity="0"/></default></default>'
)


@pytest.mark.parametrize("name", GEOMS)
def test_geoms_that_collide_are_those_of_mujoco(tmp_path, name):
    (tmp_path / "part.obj").write_text(OBJ)
    path = write(
        tmp_path, mjcf(second=GEOMS[name], asset='<mesh name="part" file="part.obj"/>', default=DEFAULT), "m.xml"
    )
    robot, serious = load(path, limits=speeds())
    model = mujoco.MjModel.from_xml_path(str(path))
    geoms = [model.geom(i) for i in range(model.ngeom)]
    colliding = [geom for geom in geoms if (geom.contype[0] or geom.conaffinity[0]) and geom.bodyid[0] > 0]
    assert by_body(robot) == Counter(model.body(geom.bodyid[0]).name for geom in colliding) and serious == []


def test_body_that_is_only_seen(tmp_path):
    seen = '<geom type="sphere" size=".1" contype="0" conaffinity="0"/>'
    path = write(tmp_path, mjcf(second=seen * 2), "m.xml")
    robot, (message,) = load(path, limits=speeds())
    assert by_body(robot) == {"one": 1, "two": 1}, "the second is the same again"
    assert "link two: no collision shape" in message
    assert by_body(load(path, limits=speeds(), visuals=False)[0]) == {"one": 1}


@pytest.mark.parametrize(
    ("geoms", "message"),
    [
        (f'<frame pos="0 0 1">{SPHERE}</frame>', "what is in a <frame> would be lost; save it as one plain file"),
        (f'<replicate count="2" offset="1 0 0">{SPHERE}</replicate>', "what is in a <replicate> would be lost"),
        (f'<body pos="1 0 0">{SPHERE}</body><body>{SPHERE}</body>', "0 of its 1 geoms can be read; give every body"),
        ('<geom name="g" size=".1"/><geom name="g" size=".2"/>', "body 'two': 1 of its 2 geoms can be read"),
        ('<geom name="floor" type="plane" size="1 1 1"/>', "geom 'floor': a plane that moves; make it a box"),
        ('<geom type="sdf" size=".1"/>', "geomType does not exist"),
    ],
)
def test_geom_that_would_be_lost_is_refused(tmp_path, geoms, message):
    with pytest.raises(ConfigError) as error:
        load(write(tmp_path, mjcf(second=geoms), "m.xml"), limits=speeds())
    assert "m.xml" in str(error.value) and message in str(error.value)
