"""A client of `qpavoid serve panda_ball`: another process has the robot, this one has the commands for it."""

import sys

import msgpack
import zmq

socket = zmq.Context().socket(zmq.REQ)
socket.setsockopt(zmq.RCVTIMEO, 1000)  # no answer in a second: raises zmq.Again, and your robot has to stop by itself
socket.connect(sys.argv[1] if len(sys.argv) > 1 else "tcp://127.0.0.1:5570")


def ask(kind, **fields):
    """Send a request; return its answer, or raise what the server says of it."""
    socket.send(msgpack.packb({"version": 1, "type": kind, **fields}))
    answer = msgpack.unpackb(socket.recv())
    if answer["type"] == "error":
        raise RuntimeError(f"{answer['error']}: {answer['text']}")
    return answer


hello = ask("hello")
ask("reset")
q, dt = hello["q0"], hello["dt"]
for k in range(300):
    target = {hello["targets"][0]: {"position": [0.31, 0.0006 * k, 0.49]}}
    ball = {"ball": {"position": [0.6 - 0.1 * k * dt, 0.0, 0.5], "linear": [-0.1, 0.0, 0.0]}}
    command = ask("step", seq=k, q=q, t=k * dt, targets=target, obstacles=ball)
    q = [angle + dt * v for angle, v in zip(q, command["v"], strict=True)]  # your robot goes here
print(f"{hello['robot']}: {command['status']}")
