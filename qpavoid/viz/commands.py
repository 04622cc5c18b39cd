"""Commands that show runs: `qpavoid view`."""

from __future__ import annotations

from typing import Annotated

import typer

Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a field: avoidance.d2=0.30")
]
Solver = Annotated[str | None, typer.Option(help="Such as eq10 or qp:proxqp; as in the file if left out.")]


def view(
    scenario: Annotated[str, typer.Argument(help="Shipped name or path of a YAML file.")],
    solver: Solver = None,
    set_: Sets = None,
    port: Annotated[int, typer.Option(help="Of the page; the next free one if it is taken.")] = 8080,
    host: Annotated[str, typer.Option(help="Address that serves the page; 0.0.0.0: every machine can see it.")] = (
        "127.0.0.1"
    ),
    low: Annotated[bool, typer.Option("--low", help="Coarse meshes and plain lights, for weak graphics.")] = False,
) -> None:
    """Run a scenario in a browser: drag targets and obstacles, change the solver while it runs; Ctrl-C ends it."""
    from qpavoid.viz.view_session import Session

    Session(scenario, set_ or (), solver, port=port, host=host, quality="low" if low else "high").run()
