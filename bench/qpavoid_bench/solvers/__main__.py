"""`python -m qpavoid_bench.solvers`, the same as `qpavoid bench solvers`."""

import typer

from qpavoid_bench.solvers.command import solvers

if __name__ == "__main__":
    typer.run(solvers)
