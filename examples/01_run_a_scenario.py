"""Run a shipped scenario with two solvers and print what came out."""

from qpavoid.run.simulate import simulate

for solver in ("eq10", "qp"):
    log = simulate("situation1", solver=solver)
    metrics = log.metrics()
    print(f"{solver:5} closest {1e3 * metrics['min_distance']:.1f} mm ({' - '.join(metrics['min_pair'])}), ", end="")
    print(f"final error {1e3 * metrics['final_error']:.4f} mm, fastest joint {metrics['peak_velocity']:.2f} rad/s")
