"""URDFs of a small arm, with faults: base, forearm and b in a row, turned by j1 and j2 about y; and STL files."""

import numpy as np

CORNERS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
TETRAHEDRON = CORNERS[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
"""Triangles (4, 3, 3) [m]."""


def write_stl(path, triangles=TETRAHEDRON):
    """A file of triangles (t, 3, 3), and its path."""
    facets = ("".join(f"vertex {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in triangle) for triangle in triangles)
    text = "".join(f"facet normal 0 0 0\nouter loop\n{vertices}endloop\nendfacet\n" for vertices in facets)
    path.write_text(f"solid a\n{text}endsolid a\n")
    return path


BASE = '<collision><geometry><box size=".2 .2 .1"/></geometry></collision>'
ROD = '<collision><origin xyz="0 0 .2"/><geometry><cylinder radius=".04" length=".3"/></geometry></collision>'
SEEN_ROD = ROD.replace("collision", "visual")
LIMITS = 'lower="-1" upper="1" velocity="1" effort="1"'
HEAD = '<robot name="m">'


def arm(forearm=ROD, b=ROD, base=BASE, limits=LIMITS, inside="", head=HEAD, type_="revolute", joint_tags=""):
    """The arm.

    Args:
        forearm: elements of that link.
        b: elements of that link.
        base: elements of that link.
        limits: attributes of the limit of j2.
        inside: elements of the robot, after its joints.
        head: the opening tag.
        type_: that of joint j2.
        joint_tags: more elements of j2.
    """
    return (
        f'{head}<link name="base">{base}</link><link name="forearm">{forearm}</link><link name="b">{b}</link>'
        '<joint name="j1" type="revolute"><parent link="base"/><child link="forearm"/><origin xyz="0 0 .1"/>'
        f'<axis xyz="0 1 0"/><limit {LIMITS}/></joint><joint name="j2" type="{type_}"><parent link="forearm"/>'
        f'<child link="b"/><origin xyz="0 0 .4"/><axis xyz="0 1 0"/>{f"<limit {limits}/>" if limits else ""}'
        f"{joint_tags}</joint>{inside}</robot>"
    )


def write(folder, text, name="m.urdf"):
    """A file of that text, and its path."""
    path = folder / name
    path.write_text(text)
    return path
