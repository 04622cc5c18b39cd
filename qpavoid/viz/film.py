"""Films of runs without a display: the robot with its visual meshes, runs side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from qpavoid.errors import ConfigError
from qpavoid.problem import Array
from qpavoid.run.log import Log
from qpavoid.viz.log_frames import LogFrames
from qpavoid.viz.motion import Sight, instants, points_of_interest, sight_of
from qpavoid.viz.raster import Canvas, Projection, Surface
from qpavoid.viz.robot_pictures import RobotPictures
from qpavoid.viz.style import GROUND, OBSTACLES, TOOL_PATH, distance_colours, rgb
from qpavoid.viz.surfaces import capsule_faces, is_endless, obstacle_faces, triangulated

Picture = npt.NDArray[np.uint8]

_PATH_TIME = 2.0
"""Length of the tools' paths that stays visible [s]."""
_THICKNESS = 0.003
"""Half the thickness of segments between witness points and of paths [m]."""
_MAX_SEGMENTS = 8
"""Pairs whose witness points are joined, the closest ones."""
_BASE = 0.2
"""Depth of bodies below z = 0 up to which these are parts of a base that stands there [m]."""
_BELOW = 0.004
"""How much lower the floor is than the ground, if that is an obstacle, which would flicker [m]."""
_TILE, _TILES = 0.25, 12
"""Side of a tile of the floor [m], and how many there are in each direction from the middle."""
_FLOOR, _SHADOW = ((1.0, 1.0, 1.0), (0.95, 0.955, 0.965)), (0.78, 0.79, 0.82)
_LIGHT = np.array([-0.35, 0.25, -1.0])
"""Direction of the light that casts shadows."""
_SKY = (np.array([236.0, 242.0, 248.0]), np.array([252.0, 253.0, 254.0]))
"""Colours at the top of a picture and at its bottom."""
_ASPECT = 0.85
"""Height of a run's picture, in widths."""
_MARGIN = 0.06
"""Margin around what fills a picture, as a share of its size."""
_COLOURS = 128
"""Colours of a GIF: more make it larger, fewer show in the sky."""
_CONTACT, _CLEAR, _CAPTION = (198, 47, 47), (0, 105, 92), (40, 40, 40)


class LogStage:
    """A run that can be drawn at any of its steps."""

    def __init__(self, log: Log, height: int) -> None:
        """Build what its pictures show.

        Args:
            log: the run.
            height: of a picture [pixels].

        Raises:
            ConfigError: a file of the robot or scenario is missing.
        """
        self.frames, self._robot, self._height = LogFrames(log), RobotPictures.of(log), height
        lowest = log.body_ends[..., 2].min(axis=(0, 2), initial=0.0) - np.array(log.meta["body_radii"])
        self._floor = min(0.0, float(lowest[lowest < -_BASE].min(initial=0.0))) - _BELOW

    def steps(self, rate: float) -> list[int]:
        """Return the steps that a film of some pictures a second shows."""
        t = self.frames.log.t
        return [int(np.searchsorted(t, time - 1e-9)) for time in np.arange(t[0], t[-1] + 1e-9, 1.0 / rate)]

    def picture(self, step: int, sight: Sight) -> Picture:
        """Return the picture of a step, with solver and distance in words."""
        log = self.frames.log
        canvas = Canvas(*sight, self._height)
        canvas.draw(_floor(self._floor))
        solid = self._robot.surfaces(log, step)
        for i in range(len(log.meta["obstacles"])):
            surface: Surface = (*triangulated(obstacle_faces(log, i, step)), OBSTACLES[i % len(OBSTACLES)])
            if is_endless(log, i):
                canvas.draw([(*surface[:2], rgb(GROUND))])
            else:
                solid.append(surface)
        canvas.draw([_shadow(surface, self._floor + 2.0 * _BELOW) for surface in solid])
        canvas.draw([*solid, *self._witnesses(step), *self._paths(step)])
        pixels = canvas.picture().astype(np.float64)
        downwards = np.linspace(0.0, 1.0, len(pixels))[:, None, None]
        sky, opacity = _SKY[0] + downwards * (_SKY[1] - _SKY[0]), pixels[..., 3:] / 255.0
        picture = (opacity * pixels[..., :3] + (1.0 - opacity) * sky).astype(np.uint8)
        return _with_caption(picture, str(log.meta["solver"]), float(log.min_distance[step]))

    def _witnesses(self, step: int) -> list[Surface]:
        witnesses = self.frames.frame(step).witnesses
        witnesses = witnesses[np.argsort(witnesses[:, 0])[:_MAX_SEGMENTS]]
        colours = distance_colours(witnesses[:, 0], *self.frames.levels)
        return [_segment(row[1:4], row[4:7], tuple(colour)) for row, colour in zip(witnesses, colours, strict=True)]

    def _paths(self, step: int) -> list[Surface]:
        log = self.frames.log
        first = int(np.searchsorted(log.t, log.t[step] - _PATH_TIME))
        points = log.tool[np.unique(np.linspace(first, step, 60).astype(int))]
        return [
            _segment(begin, end, rgb(TOOL_PATH))
            for old, new in pairwise(points)
            for begin, end in zip(old, new, strict=True)
            if np.linalg.norm(end - begin) > 1e-4
        ]


def _segment(begin: Array, end: Array, colour: tuple[float, ...]) -> Surface:
    return (*triangulated(capsule_faces(np.array([begin, end]), _THICKNESS)), colour)


def _floor(height: float) -> list[Surface]:
    """Return the tiles of a floor of some height [m], those of each colour."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    tiles = np.array([(i, j) for i in range(-_TILES, _TILES) for j in range(-_TILES, _TILES)])
    faces = np.full((len(tiles), 4, 3), height)
    faces[..., :2] = _TILE * (tiles[:, None] + corners)
    return [(*triangulated(faces[tiles.sum(axis=1) % 2 == k]), colour) for k, colour in enumerate(_FLOOR)]


def _shadow(surface: Surface, height: float) -> Surface:
    """Return the shadow of a surface on the floor, of some height [m]."""
    vertices = np.asarray(surface[0], dtype=np.float64)
    fallen = vertices + (height - vertices[:, 2:]) / _LIGHT[2] * _LIGHT
    return fallen, surface[1], _SHADOW


def film_sight(logs: Sequence[Log], azimuth: float | None, elevation: float | None) -> Sight:
    """Return a sight in which the robots fill the pictures at all times.

    Args:
        logs: the runs.
        azimuth: direction in which the camera looks, about z [deg]; None: the one that sees most of the tools.
        elevation: angle above the horizon in which it looks [deg]; None: the same.
    """
    projection = sight_of(logs[-1]).projection
    if azimuth is not None or elevation is not None:
        forward = projection.forward
        heading = float(np.degrees(np.arctan2(forward[1], forward[0]))) if azimuth is None else azimuth
        pitch = float(np.degrees(np.arcsin(forward[2]))) if elevation is None else elevation
        projection = Projection.looking(heading + 180.0, -pitch)
    flat = projection.flat(np.concatenate([points_of_interest(log, instants(log)) for log in logs]))
    middle, half = 0.5 * (flat.min(axis=0) + flat.max(axis=0)), 0.5 * np.ptp(flat, axis=0)
    width = (1.0 + 2.0 * _MARGIN) * max(float(half[0]), float(half[1]) / _ASPECT)
    return Sight(projection, middle - width * np.array([1.0, _ASPECT]), middle + width * np.array([1.0, _ASPECT]))


def stages_of(logs: Sequence[Log], width: int) -> list[LogStage]:
    """Return stages of runs that are shown side by side, `width` pixels in all; see `LogStage`."""
    return [LogStage(log, int(_ASPECT * width / len(logs)) // 2 * 2) for log in logs]


def render_film(
    stages: Sequence[LogStage], rate: float, sight: Sight, progress: Callable[[int, int], None] | None = None
) -> list[Picture]:
    """Return the pictures of a film of runs, side by side.

    Args:
        stages: the runs; a run that has ended stands still.
        rate: pictures a second of the run.
        sight: that of all of them.
        progress: called with the number of pictures done, and in all.
    """
    steps = [stage.steps(rate) for stage in stages]
    total, done, columns = sum(map(len, steps)), 0, []
    for stage, shown in zip(stages, steps, strict=True):
        pictures = []
        for step in shown:
            pictures.append(stage.picture(step, sight))
            done += 1
            if progress is not None:
                progress(done, total)
        columns.append(pictures + [pictures[-1]] * (max(map(len, steps)) - len(pictures)))
    return [np.concatenate(row, axis=1) for row in zip(*columns, strict=True)]


def render_moment(stages: Sequence[LogStage], sight: Sight) -> Picture:
    """Return one picture of runs side by side, at the time when the first one is closest to anything."""
    first, row = stages[0].frames.log, []
    t = first.t[int(np.argmin(first.min_distance))]
    for stage in stages:
        log = stage.frames.log
        row.append(stage.picture(min(int(np.searchsorted(log.t, t)), len(log.t) - 1), sight))
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
    sample = image_module.fromarray(np.concatenate(pictures[:: max(1, len(pictures) // 16)], axis=0))
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
