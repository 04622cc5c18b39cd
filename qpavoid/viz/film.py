"""Films of runs without a display: the robot with its visual meshes, by MuJoCo, runs side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.model.visuals import GREY, read_visuals
from qpavoid.run.log import Log
from qpavoid.run.mujoco_stage import Camera, Part, Segment, Stage
from qpavoid.viz.log_frames import LogFrames
from qpavoid.viz.meshes import of_geometry, of_obstacle, of_visual
from qpavoid.viz.view_link import Frame
from qpavoid.viz.view_page import distance_colours

Picture = npt.NDArray[np.uint8]

_PATH_TIME = 2.0
"""Length of the tools' paths that stays visible [s]."""
_WITNESS_RADIUS, _PATH_RADIUS = 0.004, 0.004
"""Half the thickness of segments between witness points and of paths [m]."""
_MAX_SEGMENTS = 8
"""Pairs whose witness points are joined, the closest ones."""
_PATH_COLOUR = (0.0, 0.48, 0.34)
_BASE = 0.2
"""Depth of bodies below z = 0 up to which these are parts of a base that stands there [m]."""
_BELOW = 0.004
"""How much lower the floor is than the ground, if that is an obstacle, which would flicker [m]."""
_ASPECT = 0.85
"""Height of a run's picture, in widths."""
_COLOURS = 96
"""Colours of a GIF: more make it larger, fewer show in the sky."""
_CONTACT, _CLEAR, _CAPTION = (198, 47, 47), (0, 105, 92), (40, 40, 40)


class LogStage:
    """A run on a stage."""

    def __init__(self, log: Log, width: int, height: int) -> None:
        """Build the stage; a picture has `width` by `height` pixels.

        Raises:
            ConfigError: MuJoCo is missing or renders nothing, or a file of the robot is missing.
        """
        self.frames, self._caption = LogFrames(log), str(log.meta["solver"])
        robot = self.frames.robot
        self._model, self._data = robot.model, robot.model.createData()
        visuals = read_visuals(robot.model, robot.urdf, robot.package_dirs)
        places = [(visual.joint, visual.placement, of_visual(visual)) for visual in visuals]
        if not places:
            bodies = robot.bodies.geometryObjects
            places = [(body.parentJoint, body.placement, [of_geometry(body.geometry, GREY)]) for body in bodies]
        self._places = [(joint, placement) for joint, placement, _ in places]
        obstacles = [[of_obstacle(described, i)] for i, described in enumerate(log.meta["obstacles"])]
        parts = [Part(meshes) for meshes in [*(meshes for *_, meshes in places), *obstacles]]
        lowest = log.body_ends[..., 2].min(axis=(0, 2), initial=0.0) - np.array(log.meta["body_radii"])
        self._stage = Stage(parts, width, height, min(0.0, float(lowest[lowest < -_BASE].min(initial=0.0))) - _BELOW)

    def steps(self, rate: float) -> list[int]:
        """Return the steps that a film of some pictures a second shows."""
        t = self.frames.log.t
        return [int(np.searchsorted(t, time - 1e-9)) for time in np.arange(t[0], t[-1] + 1e-9, 1.0 / rate)]

    def picture(self, step: int, camera: Camera) -> Picture:
        """Return the picture of a step, with solver and distance in words."""
        frame, log = self.frames.frame(step), self.frames.log
        pin.forwardKinematics(self._model, self._data, frame.q)
        poses = [self._data.oMi[joint] * placement for joint, placement in self._places]
        placed = [(pose.rotation, pose.translation) for pose in poses]
        placed += [(pose[:9].reshape(3, 3).T, pose[9:]) for pose in frame.obstacles]
        self._stage.place(placed)
        picture = self._stage.render(camera, [*self._witnesses(frame), *self._paths(step)])
        return _with_caption(picture, self._caption, float(log.min_distance[step]))

    def _witnesses(self, frame: Frame) -> list[Segment]:
        order = np.argsort(frame.witnesses[:, 0])[:_MAX_SEGMENTS]
        witnesses = frame.witnesses[order]
        colours = distance_colours(witnesses[:, 0], *self.frames.levels)
        return [
            Segment(row[1:4], row[4:7], _WITNESS_RADIUS, tuple(colour))
            for row, colour in zip(witnesses, colours, strict=True)
        ]

    def _paths(self, step: int) -> list[Segment]:
        log = self.frames.log
        first = int(np.searchsorted(log.t, log.t[step] - _PATH_TIME))
        points = log.tool[np.unique(np.linspace(first, step, 60).astype(int))]
        return [
            Segment(begin, end, _PATH_RADIUS, _PATH_COLOUR)
            for old, new in pairwise(points)
            for begin, end in zip(old, new, strict=True)
            if np.linalg.norm(end - begin) > 1e-4
        ]

    def close(self) -> None:
        """Free the renderer."""
        self._stage.close()


def camera_of(logs: Sequence[Log], azimuth: float, elevation: float) -> Camera:
    """Return a camera that sees the robots at all times, from some direction [deg]; see `Camera`."""
    ends = np.concatenate([log.body_ends.reshape(-1, 3) for log in logs])
    lower, upper = ends.min(axis=0), ends.max(axis=0)
    middle = 0.5 * (lower + upper)
    return Camera(
        look_at=(float(middle[0]), float(middle[1]), float(middle[2])),
        distance=1.3 * float(np.linalg.norm(upper - lower)),
        azimuth=azimuth,
        elevation=elevation,
    )


def stages_of(logs: Sequence[Log], width: int) -> list[LogStage]:
    """Return stages of runs that are shown side by side, `width` pixels in all; see `LogStage`."""
    panel = width // len(logs) // 2 * 2
    return [LogStage(log, panel, int(_ASPECT * panel) // 2 * 2) for log in logs]


def render_film(
    stages: Sequence[LogStage], rate: float, camera: Camera, progress: Callable[[int, int], None] | None = None
) -> list[Picture]:
    """Return the pictures of a film of runs, side by side.

    Args:
        stages: the runs; a run that has ended stands still.
        rate: pictures a second of the run.
        camera: that of all of them.
        progress: called with the number of pictures done, and in all.
    """
    steps = [stage.steps(rate) for stage in stages]
    total, done, columns = sum(map(len, steps)), 0, []
    for stage, shown in zip(stages, steps, strict=True):
        pictures = []
        for step in shown:
            pictures.append(stage.picture(step, camera))
            done += 1
            if progress is not None:
                progress(done, total)
        columns.append(pictures + [pictures[-1]] * (max(map(len, steps)) - len(pictures)))
    return [np.concatenate(row, axis=1) for row in zip(*columns, strict=True)]


def render_moment(stages: Sequence[LogStage], camera: Camera) -> Picture:
    """Return one picture of runs side by side, at the time when the first one is closest to anything."""
    first, row = stages[0].frames.log, []
    t = first.t[int(np.argmin(first.min_distance))]
    for stage in stages:
        log = stage.frames.log
        row.append(stage.picture(min(int(np.searchsorted(log.t, t)), len(log.t) - 1), camera))
    return np.concatenate(row, axis=1)


def _with_caption(picture: Picture, name: str, distance: float) -> Picture:
    """Return a picture with the solver's name and the smallest distance [m] in its upper left corner."""
    image_module, draw_module, font_module = _pillow()
    image = image_module.fromarray(picture)
    draw, size = draw_module.Draw(image), max(12, picture.shape[0] // 18)
    font, colour = font_module.load_default(size), _CONTACT if distance < 0.0 else _CLEAR
    text = "" if not np.isfinite(distance) else f"{1e3 * distance:.0f} mm" + (", in contact" * (distance < 0.0))
    draw.text((size // 2, size // 3), name, fill=_CAPTION, font=font)
    draw.text((size // 2, size // 3 + round(1.25 * size)), text, fill=colour, font=font)
    if distance < 0.0:
        draw.rectangle((0, 0, picture.shape[1] - 1, picture.shape[0] - 1), outline=_CONTACT, width=3)
    return np.asarray(image)


def write_png(picture: Picture, path: Path) -> None:
    """Write a picture."""
    _pillow()[0].fromarray(picture).save(path)


def write_gif(pictures: Sequence[Picture], path: Path, rate: float) -> None:
    """Write a GIF that repeats for ever, with one palette for all pictures."""
    image_module = _pillow()[0]
    images = [image_module.fromarray(picture) for picture in pictures]
    sample = image_module.fromarray(np.concatenate(pictures[:: max(1, len(pictures) // 6)], axis=0))
    palette = sample.quantize(_COLOURS, method=image_module.Quantize.MEDIANCUT)
    images = [image.quantize(palette=palette, dither=image_module.Dither.NONE) for image in images]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=round(1000.0 / rate), loop=0, optimize=True
    )  # fmt: skip


def write_mp4(pictures: Sequence[Picture], path: Path, rate: float) -> None:
    """Write an MP4.

    Raises:
        ConfigError: there is no encoder.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ConfigError("an MP4 needs an encoder: pip install imageio-ffmpeg") from None
    height, width = pictures[0].shape[:2]
    writer = imageio_ffmpeg.write_frames(str(path), (width, height), fps=rate, quality=7, macro_block_size=2)
    writer.send(None)
    for picture in pictures:
        writer.send(np.ascontiguousarray(picture))
    writer.close()


def _pillow() -> tuple[Any, Any, Any]:
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError:
        raise ConfigError("pictures are written by Pillow: pip install 'qpavoid[film]'") from None
    return Image, ImageDraw, ImageFont
