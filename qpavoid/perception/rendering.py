"""Depth images of a MuJoCo model, with the camera that sees them: what stands for a real one in simulations.

MuJoCo renders with the library that `MUJOCO_GL` names when `mujoco` is imported: `egl` or `osmesa` without a display.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.errors import ConfigError
from qpavoid.perception.camera import Camera
from qpavoid.problem import Array

try:
    import mujoco
except ImportError:
    raise ConfigError("MuJoCo is not installed: pip install mujoco, or 'qpavoid[arena]'") from None


class RenderedCamera:
    """A depth camera in a MuJoCo model."""

    def __init__(
        self, model: Any, data: Any, camera: Any, size: tuple[int, int] = (640, 480),
        ranges: tuple[float, float] = (0.1, 4.0),
    ) -> None:  # fmt: skip
        """Make the renderer; the camera is where it is in `data` now.

        Args:
            model: `mujoco.MjModel`.
            data: `mujoco.MjData`, where kinematics were computed.
            camera: name or number of one of the model's, or a `mujoco.MjvCamera`.
            size: width and height [pixels].
            ranges: least and largest depth that counts [m].

        Raises:
            ConfigError: no graphics library, an image that is larger than the model's buffer, no such camera.
        """
        width, height = size
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        try:
            self._renderer = mujoco.Renderer(model, height, width)
            self._renderer.update_scene(data, camera)
        except (ImportError, RuntimeError, ValueError, AttributeError, mujoco.FatalError) as error:
            raise ConfigError(f"no image: {error}; without a display, set MUJOCO_GL=egl or osmesa") from None
        self._renderer.enable_depth_rendering()
        self._camera, self._far = camera, model.vis.map.zfar * model.stat.extent
        eyes = self._renderer.scene.camera
        forward, up = np.array(eyes[0].forward), np.array(eyes[0].up)
        focal = 0.5 * height * eyes[0].frustum_near / (0.5 * (eyes[0].frustum_top - eyes[0].frustum_bottom))
        self.camera = Camera.at(
            0.5 * (np.array(eyes[0].pos) + np.array(eyes[1].pos)),
            np.column_stack((np.cross(forward, up), -up, forward)),
            (focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)),
            size,
            ranges=ranges,
        )
        """Lens and pose."""

    def depth(self, data: Any) -> Array:
        """Render the model as it is in `data`: depth of each pixel (h, w), infinite where nothing is [m]."""
        self._renderer.update_scene(data, self._camera)
        depth = self._renderer.render()
        return np.where(depth < 0.999 * self._far, depth, np.inf).astype(np.float32)

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()
