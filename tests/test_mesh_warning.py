"""Triangle meshes are taken only on request, and then with a word about what they cost."""

import warnings

import pytest
from conftest import write_chain

from qpavoid import Robot
from qpavoid.files.shipped import robot_names
from qpavoid.notes import NoteKind, RobotWarning

FACET = "facet normal 0 0 1\nouter loop\nvertex {}\nvertex {}\nvertex {}\nendloop\nendfacet\n"


@pytest.fixture
def urdf(tmp_path):
    o, x, y, z = "0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"
    facets = "".join(FACET.format(*f) for f in ((o, y, x), (o, x, z), (o, z, y), (x, y, z)))
    (tmp_path / "part.stl").write_text(f"solid a\n{facets}endsolid a\n")
    return write_chain(tmp_path, shape='<mesh filename="part.stl"/>')


def test_meshes_warn_with_cost_and_remedy(urdf):
    with pytest.warns(
        RobotWarning, match=r"4 triangle meshes .* 100 to 500 µs a pair .* set `bodies` to convex"
    ) as caught:
        robot = Robot.from_urdf(urdf, bodies="mesh")
    assert len(caught) == 1
    meshes = [note.subject for note in robot.notes if note.kind is NoteKind.MESH]
    assert meshes == [("link0_0", "link1_0", "link2_0", "link3_0")]
    assert caught[0].filename == __file__


def test_other_bodies_do_not_warn(urdf, tmp_path):
    chain = write_chain(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for bodies in ("convex", "capsule"):
            Robot.from_urdf(urdf, bodies=bodies)
        Robot.from_urdf(chain, bodies="mesh")  # of cylinders: there is nothing slow in it


@pytest.mark.parametrize("name", robot_names())
def test_shipped_robots_do_not_warn(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Robot.load(name)
