"""`python -m qpavoid_bench.endurance`, the same as `qpavoid bench endurance`."""

import typer

from qpavoid_bench.endurance.command import endurance

if __name__ == "__main__":
    typer.run(endurance)
