"""A browser that draws nothing: it reads what a page sends, so that a view has somebody to send frames to."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

_CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 0.0, 0.0), "fov": 1.3,
    "near": 0.01, "far": 100.0, "image_height": 480, "image_width": 640, "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip
"""First message of a browser, without which viser does not count it."""


@contextmanager
def reader(port: int) -> Iterator[list[int]]:
    """Connect to the page at a port of this machine; yield a list whose only number counts the messages so far."""
    import msgspec
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    count, protocol = [0], Subprotocol(f"viser-v{viser.__version__}")
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, compression=None) as link:
        link.send(msgspec.msgpack.encode(_CAMERA))

        def read() -> None:
            try:
                for _ in link:
                    count[0] += 1
            except ConnectionClosed:
                pass

        thread = threading.Thread(target=read, daemon=True)
        thread.start()
        yield count
    thread.join(10.0)
