"""Time TSID on given states of a robot that stands: `python tsid_loop.py FILE.npz`; prints JSON. Needs tsid alone.

The wheels of TSID 1.7.1 lay their package out so that it is not found: its compiled module is looked for beside.
"""

import json
import sys
from pathlib import Path
from time import thread_time

import numpy as np
import pinocchio as pin

try:
    import tsid
except ImportError:
    tsid = None
if not hasattr(tsid, "SolverHQuadProgFast"):
    sys.path += [str(Path(folder) / "tsid") for folder in sys.path if (Path(folder) / "tsid").is_dir()]
    import tsid_pywrap as tsid


def main() -> None:
    """Time `computeProblemData` and `solve` at every state of the file."""
    given = np.load(sys.argv[1])
    settings = json.loads(str(given["settings"]))
    robot = tsid.RobotWrapper(settings["urdf"], [settings["folder"]], pin.JointModelFreeFlyer(), False)
    model, q, v = robot.model(), given["q"], given["v"]
    problem = tsid.InverseDynamicsFormulationAccForce("tsid", robot, False)
    problem.computeProblemData(0.0, q[0], v[0])
    data, n = problem.data(), model.nv
    owned = []  # it keeps no references: what Python frees crashes it
    corners, gains = np.array(settings["corners"]).T, (settings["stiffness"], settings["damping"])

    def tuned(task, size):
        task.setKp(gains[0] * np.ones(size))
        task.setKd(gains[1] * np.ones(size))
        owned.append(task)
        return task

    for frame in settings["feet"]:
        normal, friction = np.array([0.0, 0.0, 1.0]), settings["friction"]
        contact = tuned(tsid.Contact6d(frame, robot, frame, corners, normal, friction, 2.0, 1000.0), 6)
        contact.setReference(robot.framePosition(data, model.getFrameId(frame)))
        problem.addRigidContact(contact, 1e-5)
    for frame, mask in ((settings["hand"], [1, 1, 1, 0, 0, 0]), (settings["pelvis"], [0, 0, 0, 1, 1, 1])):
        task = tuned(tsid.TaskSE3Equality(frame, robot, frame), 6)
        task.setMask(np.array(mask, dtype=float))
        place = robot.framePosition(data, model.getFrameId(frame))
        reference = tsid.TrajectorySE3Constant(f"{frame} at rest", place).computeNext()
        task.setReference(reference)
        problem.addMotionTask(task, 1.0, 1, 0.0)
        owned.append(reference)
    com = tuned(tsid.TaskComEquality("com", robot), 3)
    com.setReference(tsid.TrajectoryEuclidianConstant("com at rest", robot.com(data)).computeNext())
    problem.addMotionTask(com, 1.0, 1, 0.0)
    posture = tuned(tsid.TaskJointPosture("posture", robot), n - 6)
    posture.setReference(tsid.TrajectoryEuclidianConstant("posture at rest", q[0][7:]).computeNext())
    problem.addMotionTask(posture, 0.01, 1, 0.0)
    bounds = tsid.TaskActuationBounds("torques", robot)
    bounds.setBounds(-given["torque"], given["torque"])
    owned.append(bounds)
    problem.addActuationTask(bounds, 1.0, 0, 0.0)
    solver = tsid.SolverHQuadProgFast("qp")
    solver.resize(problem.nVar, problem.nEq, problem.nIn)
    data_times, solve_times, solved = [], [], 0
    for k in range(len(q)):
        begin = thread_time()
        quadratic = problem.computeProblemData(1e-3 * k, q[k], v[k])
        middle = thread_time()
        solution = solver.solve(quadratic)
        end = thread_time()
        data_times.append(middle - begin)
        solve_times.append(end - middle)
        solved += solution.status == 0
    size = {"unknowns": problem.nVar, "equations": problem.nEq, "inequalities": problem.nIn}
    print(json.dumps({**size, "data": data_times, "solve": solve_times, "solved": int(solved)}))


if __name__ == "__main__":
    main()
