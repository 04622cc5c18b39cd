"""Scene of the live view: robot, obstacles, targets, witness segments and paths as nodes of viser."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.model.visuals import read_visuals
from qpavoid.problem import Array
from qpavoid.viz.meshes import Mesh, decimated, of_visual
from qpavoid.viz.style import distance_colours
from qpavoid.viz.view_ghosts import Ghosts
from qpavoid.viz.view_link import Frame, PageSetup, SlotChange

Post = Callable[..., None]
"""Sends an event to the loop."""
SAME = 1e-6
"""Change of a pose that is not sent [m, -]."""
TRACE_FRAMES = 300
"""Frames whose tool positions stay visible."""
_TRACE_PERIOD = 6
"""Frames between two updates of the tools' paths, which are sent as a whole."""
_GAP = 1.0
"""Time between two frames from which the tools' paths begin anew [s]."""
_STILL = 1e-3
"""Extent of a planned path that is not drawn [m]."""
_PLANNED, _TOUCHING = (120, 90, 170), (220, 30, 30)
_NARROW = 0.8
"""Width of the picture in heights below which it is looked at from farther away [-]."""
_NAMED, _ABOVE = 6, 0.04
"""Obstacles whose names are written above them, at most, and how far above [m]."""
_SWELL = 2e-3
"""By how much collision bodies are drawn larger than they are [m]."""
_FEW_FACES = 1500
_COARSE = 0.012
"""Size of details that are left out where the quality is low [m]."""


class Page:
    """The nodes of a page."""

    def __init__(self, server: Any, setup: PageSetup, post: Post) -> None:
        """Add all nodes to a viser server."""
        self.server, self._setup, self._post = server, setup, post
        self._model, self._data = setup.model, setup.model.createData()
        scene = server.scene
        scene.set_up_direction("+z")
        scene.add_grid("/grid", 6.0, 6.0, cell_size=0.25)
        server.initial_camera.position, server.initial_camera.look_at = setup.camera

        @server.on_client_connect  # type: ignore[untyped-decorator]
        async def _(client: Any) -> None:
            if client.camera.aspect < _NARROW:  # so that what is seen in other windows is not cut off at the sides
                position, look_at = setup.camera
                client.camera.position = look_at + (position - look_at) * _NARROW / client.camera.aspect

        if setup.quality == "low":
            scene.configure_default_lights(True, cast_shadow=False)
            scene.configure_environment_map(None)
            scene.add_light_ambient("/ambient", intensity=0.9)
        self._nodes: list[tuple[Any, int, Any]] = []
        visuals = [
            (visual.name, visual.joint, visual.placement, of_visual(visual))
            for visual in read_visuals(setup.model, setup.urdf, setup.package_dirs)
        ]
        for name, joint, placement, meshes in visuals:
            self._add_part(f"/robot/{name}", joint, placement, meshes)
        self._bodies = scene.add_frame("/bodies", show_axes=False, visible=not visuals)
        self._body_meshes = [
            self._add_part(f"/bodies/{number}", joint, placement, [_swollen(mesh) if visuals else mesh])[0]
            for number, (joint, placement, mesh) in enumerate(setup.bodies)
        ]
        self._touching: set[int] = set()
        parts = [part[1:] for part in visuals] or [(joint, at, [mesh]) for joint, at, mesh in setup.bodies]
        self._ghosts = Ghosts(scene, parts, len(setup.others))
        self._ghost_data = setup.model.createData()
        self._obstacles: list[tuple[str, Any]] = []
        for index, (name, mesh) in enumerate(setup.obstacles):
            self.change(SlotChange(index, name, mesh))
        for number, path in enumerate(setup.planned):
            if np.ptp(path, axis=0).max() > _STILL:
                segments = np.stack((path[:-1], path[1:]), axis=1).astype(np.float32)
                scene.add_line_segments(f"/planned/{number}", segments, _PLANNED, line_width=2.0)
        self._grips: dict[str, Array] = {}  # from the point where an obstacle is held to its origin
        self._targets: list[Any] = []
        self._pulled: set[str] = set()  # targets that follow the mouse and no longer the loop
        no_segment = np.zeros((1, 2, 3), np.float32)
        self._witnesses = scene.add_line_segments(
            "/witnesses", no_segment, np.zeros((1, 2, 3), np.uint8), line_width=4.0, visible=False
        )
        self._trace = scene.add_line_segments("/paths", no_segment, (0, 122, 86), line_width=2.5, visible=False)
        self._tools: deque[Array] = deque(maxlen=TRACE_FRAMES)
        self._count, self._t = 0, -np.inf
        self._place_robot(pin.neutral(setup.model))

    def show(self, frame: Frame) -> None:
        """Show a frame; what is where it was is not sent again."""
        self._place_robot(frame.q)
        for (_, node), pose in zip(self._obstacles, frame.obstacles, strict=False):
            _place(node, pose[:9].reshape(3, 3).T, pose[9:])
        self._colour_bodies({int(number) for number in frame.touching})
        self._ghosts.show(self._model, self._ghost_data, frame.ghosts)
        self._place_targets(frame.targets)
        self._show_witnesses(frame.witnesses, frame.levels)
        if not self._t <= frame.t < self._t + _GAP:
            self._tools.clear()
        self._t = frame.t
        self._tools.append(frame.tools)
        self._count += 1
        if self._count % _TRACE_PERIOD == 0:
            self._show_paths()

    def show_bodies(self, visible: bool) -> None:
        """Show the collision bodies, or hide them."""
        self._bodies.visible = visible

    def let_go(self) -> None:
        """Let all targets follow the loop again."""
        self._pulled.clear()
        self._tools.clear()

    def change(self, change: SlotChange) -> None:
        """Show another obstacle in a slot, or none."""
        while len(self._obstacles) <= change.slot:
            node = self.server.scene.add_frame(f"/obstacles/{len(self._obstacles)}", show_axes=False)
            self._obstacles.append(("", node))
        node = self._obstacles[change.slot][1]
        if self._obstacles[change.slot][0]:
            self.server.scene.remove_by_name(f"/obstacles/{change.slot}/shape")
            self.server.scene.remove_by_name(f"/obstacles/{change.slot}/name")
        self._obstacles[change.slot] = change.name, node
        if change.name and len(change.mesh.faces):
            self._add_obstacle(change.slot, change.name, change.mesh)

    @property
    def obstacle_names(self) -> list[tuple[int, str]]:
        """Return slot and name of each obstacle."""
        return [(index, name) for index, (name, _) in enumerate(self._obstacles) if name]

    def _add_part(self, name: str, joint: int, placement: Any, meshes: list[Mesh]) -> list[Any]:
        node = self.server.scene.add_frame(name, show_axes=False)
        self._nodes.append((node, joint, placement))
        return [self._add_mesh(f"{name}/{index}", mesh) for index, mesh in enumerate(meshes)]

    def _colour_bodies(self, touching: set[int]) -> None:
        """Draw the bodies that touch something in red."""
        for number in touching ^ self._touching:
            mesh, node = self._setup.bodies[number][2], self._body_meshes[number]
            node.color = _TOUCHING if number in touching else _bytes(mesh.colour)
        self._touching = touching

    def _add_mesh(self, name: str, mesh: Mesh) -> Any:
        if self._setup.quality == "low" and len(mesh.faces) > _FEW_FACES:
            mesh = decimated(mesh, _COARSE)
        opacity = mesh.colour[3]
        return self.server.scene.add_mesh_simple(
            name, mesh.vertices, mesh.faces, color=_bytes(mesh.colour), opacity=opacity if opacity < 1.0 else None,
            side="double",
        )  # fmt: skip

    def _add_obstacle(self, index: int, name: str, mesh: Mesh) -> None:
        node, shape = self._obstacles[index][1], self._add_mesh(f"/obstacles/{index}/shape", mesh)

        async def drag(event: Any) -> None:
            if event.phase == "start":
                self._grips[name] = np.array(node.position) - event.start_position
            elif name in self._grips:
                position = self._grips[name] + event.end_position
                self._post(
                    type="obstacle", name=name, position=position.tolist(), rotation=_rotation(node.wxyz).tolist()
                )

        shape.on_drag(drag)
        if len(self.obstacle_names) <= _NAMED:
            top = np.array([0.0, 0.0, mesh.vertices[:, 2].max() + _ABOVE])
            self.server.scene.add_label(f"/obstacles/{index}/name", name, position=top)

    def _add_target(self, name: str, can_turn: bool) -> Any:
        gizmo = self.server.scene.add_transform_controls(
            f"/targets/{name}", scale=0.2, depth_test=False, disable_rotations=not can_turn
        )

        async def pull(event: Any) -> None:
            self._pulled.add(name)
            rotation = _rotation(event.target.wxyz)
            self._post(
                type="target", name=name, position=list(map(float, event.target.position)), rotation=rotation.tolist()
            )

        gizmo.on_update(pull)
        return gizmo

    def _place_robot(self, q: Array) -> None:
        pin.forwardKinematics(self._model, self._data, q)
        for node, joint, placement in self._nodes:
            pose = self._data.oMi[joint] * placement
            _place(node, pose.rotation, pose.translation)

    def _place_targets(self, targets: Array) -> None:
        pullable = self._setup.targets
        while len(self._targets) < len(targets):
            index = len(self._targets)
            marker = (
                self._add_target(*pullable[index])
                if index < len(pullable)
                else self.server.scene.add_frame(f"/targets/{index}", axes_length=0.08, axes_radius=0.004)
            )
            self._targets.append(marker)
        for index, (node, pose) in enumerate(zip(self._targets, targets, strict=True)):
            name, can_turn = pullable[index] if index < len(pullable) else ("", True)
            if name not in self._pulled:
                _place(node, pose[:9].reshape(3, 3).T if can_turn else np.eye(3), pose[9:])

    def _show_witnesses(self, witnesses: Array, levels: Array) -> None:
        is_visible = len(witnesses) > 0
        if is_visible:
            self._witnesses.points = witnesses[:, 1:7].reshape(-1, 2, 3).astype(np.float32)
            colours = 255.0 * distance_colours(witnesses[:, 0], *levels)
            self._witnesses.colors = np.repeat(colours.astype(np.uint8)[:, None], 2, axis=1)
        if self._witnesses.visible != is_visible:
            self._witnesses.visible = is_visible

    def _show_paths(self) -> None:
        points = np.array([tools for tools in self._tools if len(tools) == len(self._tools[-1])], np.float32)
        segments = np.stack((points[:-1], points[1:]), axis=2).reshape(-1, 2, 3)
        is_visible = len(segments) > 0
        if is_visible:
            self._trace.points = segments
        if self._trace.visible != is_visible:
            self._trace.visible = is_visible


def _swollen(mesh: Mesh) -> Mesh:
    """Return a convex mesh that is a little larger: where it would lie in the surface of another one, it flickers."""
    outward = mesh.vertices - mesh.vertices.mean(axis=0)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    return mesh._replace(vertices=(mesh.vertices + _SWELL * outward / np.maximum(length, 1e-9)).astype(np.float32))


def _bytes(colour: tuple[float, ...]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour[:3])
    return red, green, blue


def _place(node: Any, rotation: Array, position: Array) -> None:
    """Put a node to a pose, unless it is there."""
    quaternion = pin.Quaternion(np.asarray(rotation))
    wxyz = np.array([quaternion.w, quaternion.x, quaternion.y, quaternion.z])
    if np.abs(np.asarray(node.position) - position).max() > SAME:
        node.position = position
    if abs(np.dot(node.wxyz, wxyz)) < 1.0 - SAME**2 and np.abs(node.wxyz - wxyz).max() > SAME:
        node.wxyz = wxyz


def _rotation(wxyz: Any) -> Array:
    w, x, y, z = wxyz
    return np.asarray(pin.Quaternion(float(w), float(x), float(y), float(z)).normalized().matrix())
