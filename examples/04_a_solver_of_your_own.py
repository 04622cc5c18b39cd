"""A law of your own: a `Solver` with `solve` runs on every scenario, against the laws that ship."""

import numpy as np
import pinocchio as pin

from qpavoid import Controller, Problem, Solution, Solver, load_scenario


class SlowDown(Solver):
    """Tracks, and slows down in proportion to the distance that is left; never leaves its path."""

    bounded = False

    def solve(self, problem: Problem) -> Solution:
        """J⁺ẋ, scaled."""
        v, d = problem.v_tracking, problem.avoidance.d
        # d is the distance between surfaces plus the offset of the scenario, here 0.10 m:
        # it begins to slow down at 0.14 m between surfaces, and stands at 0.02 m
        return Solution(v * np.clip((d.min() - 0.12) / 0.12, 0.0, 1.0) if d.size else v)


controller, q = Controller.from_scenario(load_scenario("situation1"))
controller.solver = SlowDown()
closest = np.inf
for k in range(1300):
    tick = controller.tick(q, k * controller.dt)
    closest = tick.proximity.distance.min(initial=closest)
    q = pin.integrate(controller.scene.robot.model, q, tick.solution.v * controller.dt)

left = np.linalg.norm(tick.targets[0].position - tick.kinematics.position[0])
print(f"closest {1e3 * closest:.1f} mm, but {1e3 * left:.0f} mm short of the goal: it never goes round")
