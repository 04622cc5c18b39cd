"""A loop at 100 Hz in real time: a camera in a thread of its own, a deadline that is counted, a watchdog that stops."""

import gc
import threading

import numpy as np
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Pose, Robot, build_scene, build_tasks
from qpavoid.adapters.handover import Handover
from qpavoid.adapters.timing import Rate, Watchdog
from qpavoid.config import PostureTask, Sphere, Task

robot, dt = Robot.load("panda"), 0.01
scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.06), [0.5, 0.3, 0.5])], spare_obstacles=2)
tasks = build_tasks([Task(frame="panda_hand_tcp"), PostureTask(weight=1e-3)], robot, robot.home)
controller = Controller(scene, tasks, dt=dt, avoidance=Avoidance(d1=0.03, d2=0.15))
seen, stop = Handover(), threading.Event()
rate = Rate(dt)


def camera() -> None:
    """See the ball at 30 Hz; a real one gives the time at which the picture was taken."""
    while not stop.wait(1.0 / 30.0):
        t = rate.t
        seen.put("ball", Pose.at([0.5, 0.3 - 0.1 * t, 0.5], t=t))


gc.collect()
gc.freeze()  # what is there now is never looked at again: no pauses of tens of milliseconds
q, late, closest, rate = robot.home.copy(), 0, np.inf, Rate(dt)
threading.Thread(target=camera, daemon=True).start()
pole = seen.ask(controller.add_obstacle, Obstacle.at("pole", Sphere(radius=0.04), [0.4, -0.3, 0.4]))
with Watchdog(0.5, lambda: print("the loop hangs: stop the drives")) as watchdog:
    for _ in range(300):
        tick = controller.tick(q, rate.t, {"panda_hand_tcp": [0.5, 0.0, 0.45]}, seen.take())
        closest = tick.proximity.distance.min(initial=closest)
        q = pin.integrate(robot.model, q, tick.solution.v * dt)  # your robot goes here
        late += tick.solution.build_time + tick.solution.solve_time > 0.5 * dt
        watchdog.feed()
        rate.wait()
stop.set()
pole.result(timeout=0.0)  # raises here what `add_obstacle` raised in the loop
print(f"closest {1e3 * closest:.1f} mm; {late} steps took more than half a period, {rate.missed} periods were missed")
