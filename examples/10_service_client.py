"""A client of `qpavoid serve panda_ball`: another process has the robot, this one has the commands for it."""

import sys

import msgpack
import zmq

ADDRESS = sys.argv[1] if len(sys.argv) > 1 else "tcp://127.0.0.1:5570"
socket = zmq.Context().socket(zmq.REQ)
socket.setsockopt(zmq.RCVTIMEO, 1000)  # no answer in a second: raises zmq.Again, and your robot has to stop by itself
socket.connect(ADDRESS)


def ask(kind, **fields):
    """Send a request; return its answer, or raise what the server says of it."""
    socket.send(msgpack.packb({"version": 1, "type": kind, **fields}))
    answer = msgpack.unpackb(socket.recv())
    if answer["type"] == "error":
        raise RuntimeError(f"{answer['error']}: {answer['text']}")
    return answer


hello = ask("hello")
ask("reset")
q, dt, start = list(hello["q0"]), hello["dt"], [0.31, 0.0, 0.49]
for k in range(300):
    ball = {"position": [0.6 - 0.1 * k * dt, 0.0, 0.5], "linear": [-0.1, 0.0, 0.0]}
    target = {"position": [start[0], start[1] + min(0.1 * k * dt, 0.2), start[2]]}
    command = ask("step", seq=k, q=q, t=k * dt, targets={hello["targets"][0]: target}, obstacles={"ball": ball})
    q = [angle + dt * v for angle, v in zip(q, command["v"], strict=True)]  # your robot goes here
print(f"{hello['robot']}: {command['status']} at {[round(angle, 2) for angle in q]}")
