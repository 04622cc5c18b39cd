"""The page on cameras: its loop gets pictures, and its world of MuJoCo is seen without the arm."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = (Path(__file__).parent.parent / "docs" / "camera.md").read_text(encoding="utf-8")
LOOP, OWN_MODEL = re.findall(r"```python\n(.*?)```", PAGE, re.S)
ARM = """<mujoco model="arm"><worldbody><body name="upper" pos="0 0 .3">
  <joint name="shoulder" axis="0 1 0" range="-2 2" limited="true"/>
  <geom type="capsule" fromto="0 0 0 0 0 .4" size=".05"/>
  <body name="lower" pos="0 0 .5"><joint name="elbow" axis="0 1 0" range="-2 2" limited="true"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/></body></body></worldbody></mujoco>"""
WORLD = """<mujoco><include file="arm.xml"/><worldbody><geom name="ball" type="sphere" size=".08" pos=".1 .4 .5"/>
  <camera name="eye" pos="1.5 .2 .6" xyaxes="0 1 0 0 0 1"/></worldbody></mujoco>"""


def test_loop_of_the_page_runs():
    names = {}
    exec(compile(LOOP, "camera.md", "exec"), names)
    timing = names["timing"]
    assert (timing.submitted, timing.refused) == (9, 1)  # the first one was taken before the loop began


@pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
def test_world_of_the_page_is_seen_without_the_arm(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "world.xml").write_text(WORLD)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(LOOP.split("robot =")[0] + OWN_MODEL, "camera.md", "exec"), names)
    names["rendered"].close()
    off = np.linalg.norm(names["points"].points.centers - [0.1, 0.4, 0.5], axis=1)
    assert len(off) > 20 and np.abs(off - 0.08).max() < 0.02 and "voxels" in capsys.readouterr().out
