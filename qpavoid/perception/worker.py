"""The process that sorts depth images into voxels: `python -m qpavoid.perception.worker FILE`, as `Perception` does."""

from __future__ import annotations

import mmap
import os
import pickle
import sys
from dataclasses import dataclass
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from qpavoid.kernels import OwnBodies
from qpavoid.model.cloud import Voxels
from qpavoid.perception.camera import Camera
from qpavoid.perception.depth_voxels import DepthVoxels, GridFull
from qpavoid.perception.exchange import Fields, LatestSlot, slots_size
from qpavoid.problem import Array, IntArray

TEXT = 300
"""Bytes of a fault's text."""


@dataclass(frozen=True)
class Job:
    """What the process does, and how its memory is laid out."""

    camera: Camera
    options: dict[str, Any]
    """Further arguments of `DepthVoxels`."""
    capacity: int
    """Voxels, at most."""
    bodies: int
    """Number of bodies, those that may be held included."""
    planes: Array
    span: IntArray
    """See `OwnBodies`."""

    @property
    def image(self) -> Fields:
        """Arrays of an image."""
        numbers = {"stamp": 1, "pose": 12}
        arrays = {name: (np.float64, (count,)) for name, count in numbers.items()}
        parts = {"poses": 12, "core": 4, "sphere": 4}
        arrays |= {name: (np.float64, (self.bodies, width)) for name, width in parts.items()}  # type: ignore[misc]
        return {**arrays, "depth": (np.float32, (self.camera.height, self.camera.width))}

    @property
    def result(self) -> Fields:
        """Arrays of voxels: number of them and of their blocks, -1 where there are none for a fault."""
        most = self.capacity
        return {
            "stamp": (np.float64, (1,)), "seconds": (np.float64, (1,)), "counts": (np.int64, (2,)),
            "fault": (np.uint8, (TEXT,)), "centers": (np.float64, (most, 3)), "keys": (np.int64, (most,)),
            "blocks": (np.float64, (most, 4)), "starts": (np.int64, (most + 1,)),
        }  # fmt: skip

    def slots(self, memory: mmap.mmap, file: int) -> tuple[LatestSlot, LatestSlot]:
        """Return the slots of images and of results."""
        return LatestSlot(memory, file, 0, self.image), LatestSlot(memory, file, slots_size(self.image), self.result)

    @property
    def size(self) -> int:
        """Bytes of shared memory."""
        return slots_size(self.image) + slots_size(self.result)


def read_voxels(slot: SimpleNamespace, resolution: float) -> Voxels:
    """Copy the voxels of a result."""
    count, blocks = slot.counts.tolist()
    starts = slot.starts[: blocks + 1].astype(np.intp)
    keys = slot.keys[:count].astype(np.intp)
    return Voxels(resolution, slot.centers[:count].copy(), keys, slot.blocks[:blocks].copy(), starts, 0, count)


def _write_voxels(slot: SimpleNamespace, voxels: Voxels) -> None:
    count, blocks = len(voxels.centers), len(voxels.blocks)
    slot.counts[:] = count, blocks
    slot.centers[:count], slot.keys[:count] = voxels.centers, voxels.keys
    slot.blocks[:blocks], slot.starts[: blocks + 1] = voxels.blocks, voxels.starts


def main() -> None:
    """Sort images until the program that began this process closes its end of the pipe."""
    file = int(sys.argv[1])
    size = int.from_bytes(_read(8), "little")
    job: Job = pickle.loads(_read(size))  # by this process's own parent
    images, results = job.slots(mmap.mmap(file, job.size), file)
    sorter = DepthVoxels(job.camera, capacity=job.capacity, **job.options)
    _sort(job, sorter, images.back, results.back)  # of nothing: no image waits for the compiler
    results.back.stamp[0] = -np.inf
    results.publish()
    while os.read(0, 4096):
        image = images.read()
        if image is not None:
            _sort(job, sorter, image, results.back)
            results.publish()


def _sort(job: Job, sorter: DepthVoxels, image: SimpleNamespace, result: SimpleNamespace) -> None:
    """Write the voxels of an image, or why there are none."""
    begin = perf_counter()
    bodies = OwnBodies(image.poses, image.core, image.sphere, job.planes, job.span)
    result.stamp[0], result.fault[:] = image.stamp[0], 0
    try:
        _write_voxels(result, sorter.voxels(image.depth, bodies, image.pose, float(image.stamp[0])))
    except GridFull as fault:
        text = str(fault).encode()[:TEXT]
        result.fault[: len(text)], result.counts[:] = np.frombuffer(text, np.uint8), -1
    result.seconds[0] = perf_counter() - begin


def _read(size: int) -> bytes:
    """Read that many bytes from the pipe, and none after them."""
    content = b""
    while len(content) < size:
        part = os.read(0, size - len(content))
        if not part:
            raise SystemExit(1)
        content += part
    return content


if __name__ == "__main__":
    main()
