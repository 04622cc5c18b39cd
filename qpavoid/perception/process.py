"""Perception beside a control loop: images go to a process of its own, voxels come back; the loop never waits."""

from __future__ import annotations

import atexit
import mmap
import os
import pickle
import subprocess
import sys
import tempfile
from bisect import bisect_right
from collections import deque
from pathlib import Path
from time import perf_counter, sleep
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

import qpavoid
from qpavoid.config import Shape
from qpavoid.errors import ConfigError, NumericalError
from qpavoid.model.cloud import Points
from qpavoid.model.robot import Robot
from qpavoid.perception.camera import Camera
from qpavoid.perception.depth_voxels import DepthVoxels
from qpavoid.perception.own_bodies import OwnBodiesAt
from qpavoid.perception.worker import Job, read_voxels
from qpavoid.problem import Array, as_vector

_STEPS = 2000
"""Control steps whose configurations are remembered [-]: two seconds at 1 kHz."""
_TIMED = 1000
"""Images whose times are remembered [-]."""
_START = 300.0
"""Time in which the process has to be ready [s]: on a machine without the compiled code it takes some 15 s."""


class Timing(NamedTuple):
    """Times of the images of late [s], and counts of all."""

    sorting: tuple[float, float]
    """Median and 99th percentile of the time that the process took for an image [s]."""
    latency: tuple[float, float]
    """The same of the age of the images, by their stamps, when `latest` returned their points [s]."""
    submitted: int
    """Number of images that `submit` took."""
    refused: int
    """Number of those that it did not take."""
    returned: int
    """Number of those whose points `latest` returned; the others were replaced by later ones."""


class Perception:
    """A depth camera beside a control loop.

    `record` gets the robot's configurations, `submit` the images, `latest` returns the points of the newest one that is
    done. A thread of the camera may call `submit`, `hold` and `release` while the loop calls the other two.
    """

    def __init__(
        self, robot: Robot, camera: Camera, resolution: float = 0.02, capacity: int = 30_000, **options: Any
    ) -> None:
        """Begin the process; it is ready when this returns, which takes some seconds.

        Args:
            robot: that may be in the picture.
            camera: its lens, and where it is.
            resolution: edge of a voxel [m]; that of the cloud's configuration.
            capacity: voxels, at most.
            options: `margin`, `region`, `memory`, `least_pixels`, see `DepthVoxels`.

        Raises:
            ConfigError: an argument that cannot be meant, or a process that does not start.
            UnknownName: the camera's frame.
        """
        if not hasattr(os, "memfd_create"):
            raise ConfigError("Perception needs Linux; elsewhere, use DepthVoxels in a thread of the camera")
        options["resolution"] = float(resolution)
        DepthVoxels(camera, capacity=capacity, **options)  # wrong options are refused here
        self._robot, self._camera, self._resolution = robot, camera, float(resolution)
        self._own, self._past = OwnBodiesAt(robot, camera), deque[tuple[float, Array]](maxlen=_STEPS)
        self._own.place(robot.home)
        own = self._own.arrays
        self._job = Job(camera, options, capacity, len(own.core), own.planes, own.span)
        self._sorting, self._latency = deque[float](maxlen=_TIMED), deque[float](maxlen=_TIMED)
        self._submitted, self._refused, self._returned = 0, 0, 0
        self.fault = ""
        """Why the newest image gave no points; empty where it did."""
        self._is_closed = False
        self._begin()
        atexit.register(self.close)

    def _begin(self) -> None:
        job = self._job
        self._file = os.memfd_create("qpavoid-perception")
        os.truncate(self._file, job.size)
        self._images, self._results = job.slots(mmap.mmap(self._file, job.size), self._file)
        self._images.clear()
        self._results.clear()
        path = os.pathsep.join(filter(None, (str(Path(qpavoid.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
        command = [sys.executable, "-m", "qpavoid.perception.worker", str(self._file)]
        with tempfile.TemporaryFile() as errors:
            self._process = subprocess.Popen(
                command, pass_fds=[self._file], stdin=subprocess.PIPE, stderr=errors,
                env={**os.environ, "PYTHONPATH": path},
            )  # fmt: skip
            content, end = pickle.dumps(job), perf_counter() + _START
            assert self._process.stdin is not None
            self._pipe = self._process.stdin.fileno()
            try:
                self._process.stdin.write(len(content).to_bytes(8, "little") + content)
                self._process.stdin.flush()
            except BrokenPipeError:
                pass
            os.set_blocking(self._pipe, False)
            while self._results.read() is None:
                if self._process.poll() is not None or perf_counter() > end:
                    self._process.kill()
                    errors.seek(0)
                    text = errors.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
                    raise ConfigError(f"the perception process did not start: {text[-1]}")
                sleep(0.01)

    @property
    def is_alive(self) -> bool:
        """Whether the process runs; where it does not, the cloud becomes stale, and the robot stops."""
        return self._process.poll() is None

    def record(self, q: Array, t: float) -> None:
        """Remember a measured configuration (nq,) at a time [s], in every control step; costs 1 µs."""
        if self._past and t <= self._past[-1][0]:
            self._past.clear()  # the clock was set back
        self._past.append((float(t), np.array(q, dtype=np.float64)))

    def configuration(self, t: float) -> Array | None:
        """Return the configuration (nq,) at a time [s], interpolated; None where the loop did not record it.

        Up to a control period, as measured, after the last one that was recorded, it is taken as that.
        """
        past = list(self._past)
        k = bisect_right(past, t, key=lambda step: step[0])
        if k == 0:
            return None
        t0, q0 = past[k - 1]
        if k == len(past):
            period = t0 - past[k - 2][0] if k > 1 else 0.0
            return q0 if t - t0 <= 1.5 * period + 1e-9 else None
        t1, q1 = past[k]
        return np.asarray(pin.interpolate(self._robot.model, q0, q1, (t - t0) / (t1 - t0)))

    def submit(self, depth: Any, t: float, q: Array | None = None) -> bool:
        """Hand an image over; one that was not begun yet is replaced. Costs 0.3 ms, mostly of copying.

        Args:
            depth: of each pixel (h, w), in the camera's `unit`; 0 or NaN where unknown, infinite where nothing is in
                sight.
            t: when it was taken, on the loop's clock [s].
            q: configuration (nq,) at that time; as `record` has it, if left out.

        Returns:
            False where the image is not used: nothing is known of the robot at its time, or the process is gone.

        Raises:
            NumericalError: wrong shape or type of number.
        """
        image = np.asarray(depth)
        if image.shape != (self._camera.height, self._camera.width) or image.dtype.kind not in "fiu":
            expected = f"({self._camera.height}, {self._camera.width}) of numbers"
            raise NumericalError(f"depth: shape {image.shape} of {image.dtype}, expected {expected}")
        shape = (self._robot.model.nq,)
        q = self.configuration(t) if q is None else as_vector("q", q, shape)
        if q is None or not np.isfinite(q).all() or not np.isfinite(t) or self._is_closed:
            self._refused += 1
            return False
        slot = self._images.back
        slot.pose[:] = self._own.place(q)
        slot.stamp[0], own = t, self._own.arrays
        slot.poses[:], slot.core[:], slot.sphere[:] = own.poses, own.core, own.sphere
        np.multiply(image, self._camera.unit, out=slot.depth, casting="same_kind")
        accepted = self._images.publish()
        try:
            os.write(self._pipe, b".")
        except BlockingIOError:
            pass  # it has been woken often enough
        except OSError:
            accepted = False
        self._submitted, self._refused = self._submitted + accepted, self._refused + (not accepted)
        return accepted

    def latest(self, t: float) -> Points | None:
        """Return the points of the newest image that is done, for `Controller.step`; None where there is no newer one.

        They have the image's time stamp, so that their age counts. Costs 0.5 µs where there is nothing new, and some 30
        µs of copying where there is.

        Args:
            t: time of the control step [s].
        """
        slot = None if self._is_closed else self._results.read()
        if slot is None:
            return None
        stamp = float(slot.stamp[0])
        self._sorting.append(float(slot.seconds[0]))
        if slot.counts[0] < 0:
            self.fault = bytes(slot.fault).rstrip(b"\0").decode(errors="replace")
            return None
        self.fault, self._returned = "", self._returned + 1
        self._latency.append(t - stamp)
        return Points(read_voxels(slot, self._resolution), t=stamp)

    def hold(self, name: str, shape: Shape, frame: str, position: Any, rotation: Any) -> None:
        """Leave out an object that the robot holds from now on, at a pose in one of its frames.

        Args:
            name: by which `release` knows it.
            shape: its shape; of other ones than sphere, capsule and box, the capsule around it.
            frame: of the robot.
            position: (3,) in that frame [m].
            rotation: (3, 3).

        Raises:
            ConfigError: too many are held, or it is already.
            UnknownName: no such frame.
        """
        self._own.hold(name, shape, frame, position, rotation)

    def release(self, name: str) -> None:
        """Take an object that was held as one of the surroundings again.

        Raises:
            UnknownName: it is not held.
        """
        self._own.release(name)

    @property
    def timing(self) -> Timing:
        """Measured times and counts."""
        sorting, latency = (
            (float(np.median(times)), float(np.percentile(times, 99))) if len(times) else (np.nan, np.nan)
            for times in (self._sorting, self._latency)
        )
        return Timing(sorting, latency, self._submitted, self._refused, self._returned)

    def close(self) -> None:
        """End the process."""
        atexit.unregister(self.close)
        if self._is_closed:
            return
        self._is_closed = True
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(3.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._file)

    def __enter__(self) -> Perception:
        """Return the perception itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()
