"""Write the URDF of the paper's dual-arm robot (Fig. 1, Table 1): ``python generate.py``.

Every link frame is parallel to the world at q = 0, so a joint's axis in the file is its omega_i of Table 1
as printed, and its origin is a point of that axis. Lengths are in metres, angles in radians.
"""

from pathlib import Path
from xml.etree import ElementTree as ET

URDF = Path(__file__).with_name("paper_dual_arm.urdf")

# The paper prints no lengths; these are ours.
L0 = 1.20  # floor to shoulder
L1 = 0.30  # mid-plane to shoulder
L2 = 0.35  # shoulder to elbow
L3 = 0.30  # elbow to wrist
L4 = 0.25  # wrist to tool

RADIUS = 0.05  # of the arm bodies
LINEAR_DENSITY = 8.0  # kg/m of an arm body; the paper gives no masses, and velocity control uses none
HUB_MASS = 0.5  # kg of a link that has no length

Y_SIDE = {"left": 1.0, "right": -1.0}
# Right arm: only omega_1 is flipped, the other six axes are those of the left arm.
OMEGA_1 = {"left": "0 1 0", "right": "0 -1 0"}
OMEGA_2_TO_7 = ("1 0 0", "0 0 -1", "1 0 0", "0 0 -1", "1 0 0", "0 0 -1")

# How far a joint's centre lies below the previous one's. Axes 1-3 meet in the shoulder, 4-5 in the elbow, 6-7
# in the wrist. s1 of Table 1 is along the axis and q_3, q_5, q_7 slide along theirs: neither moves the robot.
DROP = {4: L2, 6: L3}
# Length of the body that hangs from a link's origin.
LENGTH = {3: L2, 5: L3, 7: L4}


def text(*values: float) -> str:
    """Numbers as an attribute: the shortest decimals that read back as the same doubles."""
    return " ".join("0" if value == 0 else repr(float(value)) for value in values)


def add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    """Append ``<tag attributes>`` to `parent` and return it."""
    return ET.SubElement(parent, tag, attributes)


def add_cylinder(link: ET.Element, kind: str, length: float, centre: str, rpy: str = "0 0 0") -> ET.Element:
    """Append a ``visual`` or ``collision`` cylinder around `centre`, along z if `rpy` is zero; return it."""
    element = add(link, kind)
    add(element, "origin", xyz=centre, rpy=rpy)
    add(add(element, "geometry"), "cylinder", radius=text(RADIUS), length=text(length))
    return element


def add_inertial(link: ET.Element, length: float) -> None:
    """Append the inertia of a solid cylinder that hangs from the origin, or of a sphere if `length` is 0."""
    if length:
        mass = LINEAR_DENSITY * length
        across = mass * (3 * RADIUS * RADIUS + length * length) / 12
        along = mass * RADIUS * RADIUS / 2
    else:
        mass = HUB_MASS
        across = along = mass * RADIUS * RADIUS * 2 / 5
    inertial = add(link, "inertial")
    add(inertial, "origin", xyz=text(0, 0, -length / 2), rpy="0 0 0")
    add(inertial, "mass", value=text(mass))
    add(inertial, "inertia", ixx=text(across), ixy="0", ixz="0", iyy=text(across), iyz="0", izz=text(along))


def add_joint(robot: ET.Element, name: str, kind: str, parent: str, child: str, xyz: str) -> ET.Element:
    """Append a joint whose frame is parallel to its parent's and sits at `xyz` in it."""
    joint = add(robot, "joint", name=name, type=kind)
    add(joint, "parent", link=parent)
    add(joint, "child", link=child)
    add(joint, "origin", xyz=xyz, rpy="0 0 0")
    return joint


def add_base(robot: ET.Element) -> None:
    """Append the fixed root: a column and a shoulder bar to look at, nothing to collide with.

    It has no inertia on purpose: it never moves, and several tools warn about a root that has one.
    """
    base = add(robot, "link", name="base")
    column = add_cylinder(base, "visual", L0, text(0, 0, L0 / 2))
    bar = add_cylinder(base, "visual", 2 * L1, text(0, 0, L0), rpy="1.5707963267948966 0 0")
    for visual in (column, bar):
        add(visual, "material", name="base")


def add_arm(robot: ET.Element, side: str) -> None:
    """Append links 1-7, joints 1-7 and the tool frame of the arm `side` ("left" or "right")."""
    parent = "base"
    for i, axis in enumerate((OMEGA_1[side], *OMEGA_2_TO_7), start=1):
        name = f"{side}_link{i}"
        length = LENGTH.get(i, 0.0)
        link = add(robot, "link", name=name)
        add_inertial(link, length)
        if length:
            centre = text(0, 0, -length / 2)
            add(add_cylinder(link, "visual", length, centre), "material", name=side)
            add_cylinder(link, "collision", length, centre)

        origin = text(0, Y_SIDE[side] * L1, L0) if i == 1 else text(0, 0, -DROP.get(i, 0.0))
        joint = add_joint(robot, f"{side}_joint{i}", "revolute", parent, name, origin)
        add(joint, "axis", xyz=axis)
        add(joint, "limit", lower="-3.1415926", upper="3.1415926", velocity="2.0", effort="100")
        parent = name
    add(robot, "link", name=f"{side}_tool")
    add_joint(robot, f"{side}_tool_joint", "fixed", parent, f"{side}_tool", text(0, 0, -L4))


def render() -> str:
    """Return the URDF as text, the same on every call."""
    robot = ET.Element("robot", name="paper_dual_arm")
    robot.append(ET.Comment(" Written by generate.py from Table 1 of the paper: edit that instead. "))
    for name, rgba in (("base", "0.6 0.6 0.6 1"), ("left", "0.2 0.4 0.8 1"), ("right", "0.9 0.5 0.1 1")):
        add(add(robot, "material", name=name), "color", rgba=rgba)
    add_base(robot)
    for side in Y_SIDE:
        add_arm(robot, side)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


if __name__ == "__main__":
    URDF.write_text(render(), encoding="utf-8", newline="\n")
