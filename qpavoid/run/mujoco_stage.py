"""Pictures of meshes by MuJoCo's renderer, without a display: by EGL, or by OSMesa where that is missing."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from qpavoid.errors import ConfigError
from qpavoid.problem import Array

_PROBE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"
_BACK_ENDS = ("egl", "osmesa")
_MAX_GEOMS = 10_000
"""Bodies and segments in a picture, at most."""


class Part(NamedTuple):
    """A body of a stage."""

    meshes: Sequence[tuple[Any, Any, tuple[float, ...]]]
    """Vertices (n, 3) [m], triangles (t, 3), and colour: red, green, blue, opacity, 0 to 1."""


class Camera(NamedTuple):
    """Where a stage is looked at from."""

    look_at: tuple[float, float, float]
    """Point in the middle of the picture [m]."""
    distance: float
    """From that point [m]."""
    azimuth: float
    """Direction in which it looks, about z [deg]."""
    elevation: float
    """Angle above the horizon in which it looks [deg]."""


class Segment(NamedTuple):
    """A straight line to be drawn."""

    begin: Array
    end: Array
    """(3,) its ends [m]."""
    radius: float
    """Half its thickness [m]."""
    colour: tuple[float, ...]


@cache
def find_back_end() -> str:
    """Return the name of what MuJoCo renders with on this machine; a choice in MUJOCO_GL stands.

    Raises:
        ConfigError: MuJoCo is missing, or renders with nothing that this machine has.
    """
    if chosen := os.environ.get("MUJOCO_GL", "").lower():
        return chosen
    faults = []
    for name in _BACK_ENDS:  # a process each: one that fails leaves libraries behind that the next one cannot use
        environment = {**os.environ, "MUJOCO_GL": name}
        probe = [sys.executable, "-c", _PROBE]
        done = subprocess.run(probe, env=environment, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return name
        faults.append(f"{name}: {(done.stderr.strip().splitlines() or ['no reason'])[-1]}")
    if "No module named 'mujoco'" in faults[0]:
        raise ConfigError("films are rendered by MuJoCo: pip install 'qpavoid[film]'")
    raise ConfigError(
        f"MuJoCo can render with neither EGL nor OSMesa: {'; '.join(faults)}; on Debian: apt-get install libegl1 "
        "libegl-mesa0 libgl1-mesa-dri"
    )


class Stage:
    """Bodies on a floor, which are placed by hand and rendered."""

    def __init__(self, parts: Sequence[Part], width: int, height: int, floor: float = 0.0) -> None:
        """Build the model and its renderer.

        Args:
            parts: bodies, which `place` is given the poses of.
            width: of a picture [pixels].
            height: of a picture [pixels].
            floor: its height [m].
        """
        back_end = find_back_end()
        import mujoco

        self._mujoco = mujoco
        spec = self._spec(width, height, floor)
        for number, part in enumerate(parts):
            body = spec.worldbody.add_body(name=f"part {number}", mocap=True)
            for index, (vertices, faces, colour) in enumerate(part.meshes):
                if len(faces) < 4:
                    continue  # MuJoCo refuses meshes of fewer triangles
                name = f"mesh {number} {index}"
                spec.add_mesh(
                    name=name, uservert=np.ravel(vertices), userface=np.ravel(faces).astype(np.int32),
                    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,  # of flat parts, no other one is accepted
                )  # fmt: skip
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=list(colour), contype=0, conaffinity=0
                )  # fmt: skip
        self._model = spec.compile()
        self._data, self._scene = mujoco.MjData(self._model), mujoco.MjvScene(self._model, _MAX_GEOMS)
        # not mujoco.Renderer, whose kind of context is settled by whatever imported MuJoCo first
        self._gl = import_module(f"mujoco.{back_end}").GLContext(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._size = width, height

    def _spec(self, width: int, height: int, floor: float) -> Any:
        """Return sky, floor and lights."""
        mujoco = self._mujoco
        spec = mujoco.MjSpec()
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        spec.visual.quality.shadowsize, spec.visual.quality.offsamples = 2048, 4
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.55] * 3, [0.32] * 3
        spec.add_texture(
            name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[1.0, 1.0, 1.0], rgb2=[0.86, 0.91, 0.96], width=256, height=256,
        )  # fmt: skip
        spec.add_texture(
            name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            rgb1=[1.0, 1.0, 1.0], rgb2=[0.93, 0.94, 0.96], width=256, height=256,
        )  # fmt: skip
        material = spec.add_material(name="floor")
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
        material.texrepeat, material.reflectance = [12, 12], 0.0  # reflections double the time
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, pos=[0.0, 0.0, floor], size=[3.0, 3.0, 0.1], material="floor"
        )
        spec.worldbody.add_light(
            pos=[1.0, -1.5, 3.5], dir=[-0.28, 0.42, -1.0], castshadow=True, diffuse=[0.65] * 3
        )  # fmt: skip
        return spec

    def place(self, poses: Sequence[tuple[Array, Array]]) -> None:
        """Put the bodies, in their order, to rotations (3, 3) and positions (3,) [m]."""
        for number, (rotation, position) in enumerate(poses):
            self._data.mocap_pos[number] = position
            self._mujoco.mju_mat2Quat(self._data.mocap_quat[number], np.ascontiguousarray(rotation).ravel())
        self._mujoco.mj_kinematics(self._model, self._data)

    def render(self, camera: Camera, segments: Sequence[Segment] = ()) -> npt.NDArray[np.uint8]:
        """Return a picture (height, width, 3)."""
        mujoco, view, scene, (width, height) = self._mujoco, self._mujoco.MjvCamera(), self._scene, self._size
        view.lookat[:], view.distance = camera.look_at, camera.distance
        view.azimuth, view.elevation = camera.azimuth, camera.elevation
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model, self._data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL.value, scene
        )  # fmt: skip
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = True
        for segment in segments:
            if scene.ngeom == scene.maxgeom:
                break
            geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CAPSULE
            colour = np.array([*segment.colour[:3], 1.0], np.float32)
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
            mujoco.mjv_connector(geom, kind, segment.radius, segment.begin, segment.end)
            scene.ngeom += 1
        picture = np.empty((height, width, 3), np.uint8)
        rectangle = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rectangle, scene, self._context)
        mujoco.mjr_readPixels(picture, None, rectangle, self._context)
        return np.flipud(picture)

    def close(self) -> None:
        """Free the renderer."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
