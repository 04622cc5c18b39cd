"""The command `qpavoid serve`."""

from __future__ import annotations

import gc
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from qpavoid.errors import ConfigError
from qpavoid.run.terminal import ERR, OUT
from qpavoid.solvers.python_file import scenario_with_law

if TYPE_CHECKING:
    from qpavoid.service.server import Service

_LOOPBACK = ("127.", "localhost", "[::1]")


def serve(
    scenario: Annotated[str, typer.Argument(help="Shipped name or path of a YAML file.")],
    solver: Annotated[
        str | None, typer.Option(help="Such as eq10, qp:proxqp or my_law.py:MyLaw; as in the file if left out.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a field: avoidance.d2=0.30")
    ] = None,
    heartbeat: Annotated[float, typer.Option(help="Time without a step after which the robot is stopped [s].")] = 0.1,
    port: Annotated[int, typer.Option(min=0, max=65534, help="Of requests; the next one has the commands.")] = 5570,
    host: Annotated[str, typer.Option(help="Address to be reached at; who reaches it moves the robot.")] = "127.0.0.1",
    motions: Annotated[
        bool, typer.Option("--motions", help="What a step leaves out moves as in the scenario, instead of resting.")
    ] = False,
) -> None:
    """Answer control steps of other programs, over ZeroMQ and msgpack. Ctrl-C stops the robot and ends it."""
    try:
        from qpavoid.service.holding import moving_obstacles
        from qpavoid.service.server import Service
    except ModuleNotFoundError as missing:
        if missing.name not in ("zmq", "msgpack"):
            raise
        raise ConfigError("qpavoid serve needs pyzmq and msgpack: pip install 'qpavoid[serve]'") from None
    config, law = scenario_with_law(scenario, set_ or (), solver)
    service = Service(config, heartbeat, host, port, motions, law)
    if moving := moving_obstacles(config):
        rule = "moves as the scenario has it" if motions else "stands where the scenario has it at t = 0 (--motions)"
        ERR.print(f"until it is sent, each of these {rule}: {', '.join(moving)}", highlight=False, markup=False)
    if not host.startswith(_LOOPBACK):
        ERR.print(f"{host}: there is no password: who reaches this port moves the robot", highlight=False)
    gc.collect()
    gc.freeze()  # what was imported is not walked through in the middle of the loop
    addresses = f"steps: {service.endpoint}, commands: {service.commands_endpoint}"
    OUT.print(f"serving {scenario}: {addresses}", highlight=False, soft_wrap=True, markup=False)
    with _ended_by_signals(service):
        service.run()
    service.close()


@contextmanager
def _ended_by_signals(service: Service) -> Iterator[None]:
    """End a service at Ctrl-C or SIGTERM, once the robot stands; at once at the second one."""

    def end(number: int, _: object) -> None:
        signal.signal(number, handlers[signal.Signals(number)])
        service.end()

    handlers = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
