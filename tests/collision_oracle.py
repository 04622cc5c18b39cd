"""Collisions of a robot's own geometry, found with Pinocchio and coal alone, against the pairs that a robot checks."""

from collections import Counter

import coal
import numpy as np
import pinocchio as pin


class Oracle:
    """The geometry of a URDF as its file has it."""

    def __init__(self, urdf, folders=(), visual=False):
        self.model = pin.buildModelFromUrdf(str(urdf), mimic=True)
        kind = pin.VISUAL if visual else pin.COLLISION
        self.geometry = pin.buildGeomFromUrdf(self.model, str(urdf), kind, package_dirs=[str(f) for f in folders])
        self.data, self.placed = self.model.createData(), self.geometry.createData()
        self.link = [self.model.frames[body.parentFrame].name for body in self.geometry.geometryObjects]
        joints = [body.parentJoint for body in self.geometry.geometryObjects]
        count = len(joints)
        self.pairs = [(i, j) for i in range(count) for j in range(i) if joints[i] != joints[j]]
        self.radius = []
        for body in self.geometry.geometryObjects:
            body.geometry.computeLocalAABB()
            self.radius.append((np.array(body.geometry.aabb_center), body.geometry.aabb_radius))

    def collisions(self, q):
        """Pairs of links that touch at q."""
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.placed, q)
        centers = np.array([p.act(c) for p, (c, _) in zip(self.placed.oMg, self.radius, strict=True)])
        at = [coal.Transform3s(pose.rotation, pose.translation) for pose in self.placed.oMg]
        found = set()
        for i, j in self.pairs:
            links = frozenset((self.link[i], self.link[j]))
            if links in found or np.linalg.norm(centers[i] - centers[j]) > self.radius[i][1] + self.radius[j][1]:
                continue
            a, b = (self.geometry.geometryObjects[k].geometry for k in (i, j))
            if coal.collide(a, at[i], b, at[j], coal.CollisionRequest(), coal.CollisionResult()):
                found.add(links)
        return found


def values(model, q):
    """Position of each joint of one coordinate."""
    found = {}
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        part = q[joint.idx_q : joint.idx_q + joint.nq]
        if joint.shortname() != "JointModelMimic":
            found[name] = float(part[0]) if joint.nq == 1 else float(np.arctan2(part[1], part[0]))
    return found


def configuration(model, positions):
    """A model's q at the joints' positions; what is missing stays neutral."""
    q = pin.neutral(model)
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if name in positions and joint.shortname() != "JointModelMimic":
            x = positions[name]
            q[joint.idx_q : joint.idx_q + joint.nq] = x if joint.nq == 1 else (np.cos(x), np.sin(x))
    return q


def draw(model, random):
    """Positions of all joints, even over their ranges; a full turn where they have none."""
    found = {}
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if joint.nv == 1 and joint.shortname() != "JointModelMimic":
            low, high = -np.pi, np.pi
            if joint.nq == 1:
                low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
                if not (abs(low) < 1e9 and abs(high) < 1e9):
                    low, high = -np.pi, np.pi
            found[name] = random.uniform(low, high)
    return found


def unseen(urdf, robot, held, samples, folders=(), visual=False, seed=11):
    """Links that touch without a pair of the robot's that does: how often, of how many samples.

    Args:
        urdf: the file.
        robot: with its own pairs, fixed to the world.
        held: positions of the joints that it locks.
        samples: configurations drawn, within the robot's limits.
        folders: where meshes are looked up.
        visual: whether the geometry is what is meant to be seen.
        seed: of the draw.
    """
    oracle, random, missed = Oracle(urdf, folders, visual), np.random.default_rng(seed), Counter()
    names = [robot.model.frames[body.parentFrame].name for body in robot.bodies.geometryObjects]
    pairs = [frozenset((names[p.first], names[p.second])) for p in robot.bodies.collisionPairs]
    data, placed = robot.model.createData(), robot.bodies.createData()
    for _ in range(samples):
        positions = draw(robot.model, random)
        touching = oracle.collisions(configuration(oracle.model, {**held, **positions}))
        q = configuration(robot.model, positions)
        pin.updateGeometryPlacements(robot.model, data, robot.bodies, placed, q)
        for request in placed.collisionRequests:
            request.security_margin = 1e-4  # sizes are rounded, up, in files
        pin.computeCollisions(robot.bodies, placed, False)
        seen = {pairs[i] for i, result in enumerate(placed.collisionResults) if result.isCollision()}
        missed.update(touching - seen)
    return missed
