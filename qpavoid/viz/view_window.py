"""Process that serves the page of a view: `python -m qpavoid.viz.view_window DESCRIPTOR FILE`."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import socket
import sys
import time
from pathlib import Path

from qpavoid.viz.view_controls import Controls
from qpavoid.viz.view_link import PageSetup, SlotChange, received, send_event, unpack
from qpavoid.viz.view_page import Page

_NICE = 5
"""How much less urgent than the loop the page is."""


def main(descriptor: int, path: str) -> None:
    """Serve the page until the process that asked for it is gone.

    Args:
        descriptor: of this end of the link.
        path: file with the pickled `PageSetup`, which is deleted.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the loop, which ends this process
    os.nice(_NICE)
    with open(path, "rb") as file:  # of this user alone, written by the process that started this one
        setup: PageSetup = pickle.load(file)
    Path(path).unlink(missing_ok=True)
    link = socket.socket(fileno=descriptor)
    link.setblocking(False)
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115 -- viser prints tables; the loop's own output may be read by programs
    try:
        page, controls, url = build(setup, link)
    except Exception as error:
        send_event(link, type="failed", reason=" ".join(str(error).split()))
        raise
    print(f"view: {url}", file=sys.stderr, flush=True)
    send_event(link, type="ready", url=url)
    serve(setup, link, page, controls)


def build(setup: PageSetup, link: socket.socket) -> tuple[Page, Controls, str]:
    """Return scene and controls of a page, and its address."""
    import viser

    def post(**event: object) -> None:
        send_event(link, **event)

    server = viser.ViserServer(host=setup.host, port=setup.port, verbose=False)
    page, controls = Page(server, setup, post), Controls(server, setup, post)
    controls.on_body_toggle(page.show_bodies)
    if setup.controls.get("shows bodies"):
        page.show_bodies(True)
    controls.on_reset(page.let_go)
    controls.name_obstacles(page.obstacle_names)
    if setup.port and server.get_port() != setup.port:
        print(f"view: port {setup.port} is taken", file=sys.stderr)
    return page, controls, f"http://{setup.host}:{server.get_port()}"


def serve(setup: PageSetup, link: socket.socket, page: Page, controls: Controls) -> None:
    """Show the newest frame, again and again, while the loop's process runs."""
    text = ""
    clients, start, is_waiting = 0, time.perf_counter(), bool(setup.waiting)
    while os.getppid() == setup.parent:
        begin, newest = time.perf_counter(), None
        for datagram in received(link):
            if isinstance(item := unpack(datagram), SlotChange):
                page.change(item)
                controls.name_obstacles(page.obstacle_names)
            else:
                newest, text = item, item.text or text
        count = len(page.server.get_clients())
        if count != clients and send_event(link, type="clients", count=count):
            clients = count
        if is_waiting:
            is_waiting = newest is None or not newest.text
            controls.wait(f"{setup.waiting}: {time.perf_counter() - start:.0f} s")
        if newest is not None:
            newest = newest._replace(text=text)
            with page.server.atomic():
                page.show(newest)
                controls.show(newest)
        time.sleep(
            max(0.0, 1.0 / setup.rate - (time.perf_counter() - begin))
        )  # frames do not wake it, in the loop's time


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
