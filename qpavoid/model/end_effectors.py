"""Frames of a robot that are likely tools, hands or feet."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import pinocchio as pin

_LIMB = 3
"""Joints in a row that make a limb: two move a head, one turns a wheel or a finger."""
_FINGER = 4
"""Joints of a finger at most: what branches into shorter chains is a hand."""
_DIGITS = 4, 5
"""Chains from which on a branching is a hand even if they are longer, and how long: a thumb may have five joints."""
_FINGERS = re.compile(
    r"hand|finger|thumb|grip|jaw|knuckle|(?:^|[^a-z])(?:index|middle|ring|little|pinky)(?:[^a-z]|$)", re.IGNORECASE
)
"""Names of fingers' joints: some hands have only one joint, and others chains longer than those of a leg."""
_TOOL_WORDS = ("tcp", "tool", "end_effector", "ee", "grasp", "gripper", "palm", "hand", "sole", "foot", "tip")
"""Parts of a frame's name that make it the tool among those that move together, the best first."""
_LINKS = (pin.BODY, pin.OP_FRAME)
_NO_TOOLS = re.compile(r"head|eye|camera|neck|wheel|caster|laser|imu|lidar|sensor|optical", re.IGNORECASE)


def end_effectors(model: Any, srdf_ends: Sequence[str] = ()) -> list[str]:
    """Find the frames at the ends of a robot's limbs: first those that an SRDF names, then others in the joints' order.

    A limb is a chain of at least three joints since the last branch; where it branches into fingers, its hand is the
    end. Where no limb is that long, every end counts.
    """
    frames = {f.name: f.parentJoint for f in model.frames if f.type in _LINKS}
    ends = [_tool(model, frames[name], name) or name for name in srdf_ends if name in frames]
    used_joints = {joint for name in ends for joint in list(model.supports[frames[name]])[1:]}
    root = 1 if model.njoints > 1 and model.names[1] == "root_joint" else 0
    for least in (_LIMB, 1):
        joints = _ends(model, root, 0, least)
        tools = [_tool(model, joint) for joint in joints if joint not in used_joints]
        ends += [name for name in tools if name is not None and not _NO_TOOLS.search(name)]
        if ends:
            break
    return ends


def _ends(model: Any, joint: int, above: int, least: int) -> list[int]:
    """Find the joints that carry the ends of the tree below a joint, with `above` joints in a row above it."""
    children = list(model.children[joint])
    if not children:
        return [joint] if above >= least else []
    fingers = any(_FINGERS.search(model.names[child]) for child in children)
    count, longest = len(children), max(_depth(model, child) for child in children)
    has_short_chains = count > 1 and longest <= (_DIGITS[1] if count >= _DIGITS[0] else _FINGER)
    if above >= _LIMB and (fingers or has_short_chains):
        return [joint]
    if len(children) == 1:
        return _ends(model, children[0], above + 1, least)
    return [end for child in children for end in _ends(model, child, 1, least)]


def _depth(model: Any, joint: int) -> int:
    """Count the joints in the longest chain that begins with a joint."""
    return 1 + max((_depth(model, child) for child in model.children[joint]), default=0)


def _tool(model: Any, joint: int, default: str | None = None) -> str | None:
    """Find the frame of a joint whose name is that of a tool, else the default, else the joint's own link."""
    names = [str(f.name) for f in model.frames if f.parentJoint == joint and f.type in _LINKS]
    for word in _TOOL_WORDS:
        pattern = re.compile(rf"(?:^|[^a-z]){word}(?:[^a-z]|$)", re.IGNORECASE)
        if named := [name for name in names if pattern.search(name)]:
            return min(named, key=len)
    return default or (names[0] if names else None)
