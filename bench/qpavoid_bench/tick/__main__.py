"""`python -m qpavoid_bench.tick`, the same as `qpavoid bench tick`."""

import typer

from qpavoid_bench.tick.command import tick

if __name__ == "__main__":
    typer.run(tick)
