"""Figures carry the data of the log, and every kind of log can be drawn."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from qpavoid import Log, Status, load_scenario
from qpavoid.run.log import STATUSES
from qpavoid.run.simulate import simulate

pytest.importorskip("matplotlib")

from qpavoid.viz.compare import compare_time_figure, path_figure, solver_styles
from qpavoid.viz.figures import distances_figure, joints_figure, plot_compare, plot_run, speeds_figure
from qpavoid.viz.index_page import write_index
from qpavoid.viz.motion import instants, motion_figure, sight_of
from qpavoid.viz.raster import Canvas, Projection
from qpavoid.viz.robot_pictures import RobotPictures
from qpavoid.viz.surfaces import inflated_outline, shape_faces
from qpavoid.viz.torque_figures import torque_figures

LIMITS = ((2.175, 4), (2.61, 3))
"""Speed limits of a Panda [rad/s], and of how many joints."""


def run(scenario: str, solver: str) -> Log:
    return simulate(load_scenario(scenario, overrides=["duration=0.3"]), solver=solver)


@pytest.fixture(scope="module")
def sphere() -> list[Log]:
    return [run("situation1", solver) for solver in ("tracking", "eq10", "qp", "qp:proxqp")]


@pytest.fixture(scope="module")
def panda() -> Log:
    return run("panda_line", "qp")


def lines(ax):
    return {line.get_label(): line for line in ax.get_lines()}


def entries(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_distances_are_those_of_the_log_between_levels_of_surfaces(sphere):
    """The offset of 0.1 m of the paper is taken off d1 and d2."""
    log = sphere[2]
    ax, gains = distances_figure(log).axes
    drawn = lines(ax)
    for i, body in enumerate(log.meta["bodies"]):
        named = [line for name, line in drawn.items() if body in name.split(" – ")[0]]
        named += [line for name, line in drawn.items() if body in name]  # the line of its partner, if it is the same
        assert any(np.allclose(line.get_ydata(), log.body_distance[:, i], atol=1e-15) for line in named)
        for distance, pair in zip(log.body_distance[:, i], log.body_pair[:, i], strict=True):
            assert body in log.meta["pairs"][pair] and distance >= 0.0
    assert "left_hand – fist" in drawn
    levels = [line.get_ydata()[0] for name, line in drawn.items() if "$" in name or "collision" in name]
    assert sorted(levels) == pytest.approx([0.0, 0.08, 0.26])
    bottom, top = ax.get_ylim()
    assert all(bottom <= np.min(line.get_ydata()) and np.max(line.get_ydata()) <= top for line in ax.get_lines())
    alpha, beta = (line.get_ydata() for line in gains.get_lines())
    assert_allclose(alpha, log.alpha)
    assert_allclose(beta, log.beta)


def test_joint_panels_hold_q_and_its_limits(panda):
    meta = {**panda.meta, "position_limits": [*panda.meta["position_limits"][1:], ["panda_joint1", -1.0, np.inf]]}
    limits = {name: [lower, upper] for name, lower, upper in meta["position_limits"]}
    axes = joints_figure(replace(panda, meta=meta)).axes
    assert len(axes) == panda.q.shape[1]
    for i, ax in enumerate(axes):
        position, *bounds = ax.get_lines()
        assert_allclose(position.get_ydata(), panda.q[:, i])
        assert [line.get_ydata()[0] for line in bounds] == [x for x in limits[ax.get_title()] if np.isfinite(x)]


@pytest.mark.parametrize(
    ("solver", "row", "gains"),
    [
        ("eq10", "beta", ["α", "β"]),
        ("qp", "beta", ["β"]),
        ("qp", "task-switching", ["α", "β"]),
        ("tracking", "beta", []),
        ("potential-field", "task-switching", []),
    ],
)
def test_gains_are_those_of_the_law(panda, solver, row, gains):
    config = panda.meta["config"]
    config = {**config, "solver": {"name": solver}, "avoidance": {**config["avoidance"], "row": {"type": row}}}
    figure = distances_figure(replace(panda, meta={**panda.meta, "config": config}))
    assert len(figure.axes) == 1 + bool(gains)
    assert [line.get_label()[0] for line in figure.axes[-1].get_lines()] == gains or not gains


def test_speeds_show_limits_and_steps_that_are_not_solved(panda):
    limits, v, status = panda.meta["velocity_limit"], np.zeros_like(panda.v), panda.status.copy()
    status[:] = STATUSES.index(Status.SOLVED)
    ax = speeds_figure(replace(panda, v=v, status=status)).axes[0]
    assert {name for name in entries(ax) if "limit" in name} == {f"limit ±{x:g} of {k} joints" for x, k in LIMITS}
    assert not ax.patches
    assert max(limits) < ax.get_ylim()[1]
    v[:, 6] = -0.9 * limits[6]
    status[[4, 5, 6, 20]] = STATUSES.index(Status.RELAXED)
    ax = speeds_figure(replace(panda, v=v, status=status)).axes[0]
    assert_allclose(lines(ax)["panda_joint7"].get_ydata(), v[:, 6])
    assert "RELAXED: 4 steps" in entries(ax)
    spans = sorted((patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches)
    assert_allclose(spans, [(0.04, 0.07), (0.20, 0.21)])


@pytest.mark.parametrize(
    ("shape", "exact"),
    [
        ({"type": "sphere", "radius": 0.3}, 4 / 3 * np.pi * 0.3**3),
        ({"type": "capsule", "radius": 0.1, "length": 0.5}, np.pi * 0.1**2 * 0.5 + 4 / 3 * np.pi * 0.1**3),
        ({"type": "cylinder", "radius": 0.1, "length": 0.5}, np.pi * 0.1**2 * 0.5),
        ({"type": "box", "size": [0.1, 0.2, 0.3]}, 0.006),
    ],
)
def test_surfaces_are_closed_outward_and_of_the_right_size(shape, exact):
    """By the divergence theorem over their triangles."""
    a, b, c, d = np.moveaxis(shape_faces(shape), 1, 0)
    volume = sum(np.sum(np.einsum("ij,ij->i", u, np.cross(v, w))) for u, v, w in ((a, b, c), (a, c, d))) / 6.0
    assert 0.94 * exact < volume <= exact * (1 + 1e-12)


def test_motion_panels_share_one_view_that_shows_tool_and_paths(sphere, panda):
    for log in (sphere[0], sphere[2], panda):
        distance = log.body_distance.copy()
        distance[17] = -0.01
        log = replace(log, body_distance=distance)
        steps, sight = instants(log), sight_of(log)
        assert {0, 17, len(log.t) - 1} <= set(steps.tolist()) and np.all(np.diff(steps) > 0)
        axes = motion_figure(log, sight).axes
        assert len({(*ax.get_xlim(), *ax.get_ylim()) for ax in axes}) == 1
        assert np.linalg.norm(sight.projection.forward) == pytest.approx(1.0)
        for step, ax in zip(steps, axes, strict=True):
            title = ax.get_title()
            assert title.startswith(f"t = {log.t[step]:.2f} s")
            assert " – ".join(log.meta["pairs"][log.closest_pair[step]]) in title
            tools = sight.projection.flat(log.tool[step])
            assert np.all((tools > sight.lower) & (tools < sight.upper))


def test_robot_fills_its_panel_in_its_own_colours_and_red_where_it_touches(panda):
    sight, step = sight_of(panda), len(panda.t) - 1
    for distance, is_red in ((0.1, False), (-0.01, True)):
        log = replace(panda, body_distance=np.full_like(panda.body_distance, distance))
        canvas = Canvas(*sight, 160)
        canvas.draw(RobotPictures.of(log).surfaces(log, step))
        picture = canvas.picture().astype(float)
        inside = picture[..., 3] > 250.0
        assert inside.mean() > 0.12
        red = inside & (picture[..., 0] > 2.0 * picture[..., 1])
        assert (red.sum() > 0.3 * inside.sum()) == is_red
        if not is_red:  # white, with black joints
            assert (picture[inside, :3].min(axis=1) > 120.0).mean() > 0.4


def test_what_is_nearer_hides_what_is_farther():
    """In any order; a pixel has the colour of the surface that a ray through it meets first."""
    square = np.array([[0.0, -1.0, -1.0], [0.0, 1.0, -1.0], [0.0, 1.0, 1.0], [0.0, -1.0, 1.0]])
    faces, projection = np.array([[0, 1, 2], [0, 2, 3]]), Projection.looking(0.0, 0.0)  # from +x
    near, far = (square * 0.5 + [1.0, 0.0, 0.0], faces, (1.0, 0.0, 0.0)), (square, faces, (0.0, 0.0, 1.0))
    for surfaces in ([near, far], [far, near]):
        canvas = Canvas(projection, np.array([-2.0, -2.0]), np.array([2.0, 2.0]), 40)
        canvas.draw(surfaces)
        picture = canvas.picture()
        assert picture.shape == (40, 40, 4)
        areas = [np.mean((picture[..., i] > 60) & (picture[..., 3] == 255)) for i in (0, 2)]
        assert areas == pytest.approx([1.0 / 16.0, 4.0 / 16.0 - 1.0 / 16.0], abs=0.02)
        assert canvas.is_visible(np.array([[1.1, 0.0, 0.0], [0.5, 0.0, 0.0], [0.1, 0.8, 0.0]]), 0.0).tolist() == [
            True, False, True,
        ]  # fmt: skip


def test_outline_around_a_sphere_is_a_circle_of_its_radius_and_d1(sphere):
    log, projection = sphere[0], Projection.looking(30.0, 20.0)
    outline = inflated_outline(log, 0, 0, projection.flat, 0.08)
    radius = np.linalg.norm(outline - projection.flat(log.obstacle_position[0, 0]), axis=1)
    assert_allclose(radius, 0.05 + 0.08, rtol=0.02)


def test_styles_of_runs_differ(sphere):
    """Of two runs with one course, neither line is hidden: they differ in colour and dash, and dashes lie on top."""
    tracking, eq10, qp, proxqp = sphere
    for logs in ([qp, qp], [proxqp, qp], [qp, proxqp, proxqp, tracking, eq10, proxqp, qp]):
        styles = solver_styles(logs)
        for key in ("label", "color", "linestyle"):
            assert len({str(style[key]) for style in styles}) == len(logs)
        solid = [style["zorder"] for style in styles if style["linestyle"] == "-"]
        assert solid and all(style["zorder"] > max(solid) for style in styles if style["linestyle"] != "-")
    assert len({(style["color"], str(style["linestyle"])) for style in solver_styles(sphere * 10)}) == 40


def test_compared_curves_are_those_of_the_logs(sphere):
    distance, _, error, speed = compare_time_figure(sphere).axes
    figure = path_figure(sphere, solver_styles(sphere))
    for log in sphere:
        name = log.meta["solver"]
        assert_allclose(lines(distance)[name].get_ydata(), log.min_distance)
        assert_allclose(lines(error)[name].get_ydata(), np.linalg.norm(log.target - log.tool, axis=2)[:, 0], atol=1e-8)
        assert_allclose(lines(speed)[name].get_ydata(), np.abs(log.v).max(axis=1))
        for ax, up in zip(figure.axes, (2, 0), strict=True):  # the path runs along y
            assert_allclose(lines(ax)[name].get_data(), log.tool[:, 0, [1, up]].T)
            assert ax.get_aspect() == 1.0
            assert_allclose(np.ptp(ax.patches[-1].get_xy(), axis=0), 0.10, rtol=0.01)  # the fist, 0.05 m in radius


def test_files_are_named_and_not_blank(sphere, panda, tmp_path):
    from matplotlib.image import imread

    paths = plot_run(sphere[3], tmp_path / "new" / "folder") + plot_compare(sphere, tmp_path)
    assert [path.name for path in paths] == [
        *(f"situation1_qp-proxqp_{name}.png" for name in ("motion", "joints", "distances", "speeds")),
        *(f"situation1_compare_{name}.png" for name in ("time", "path")),
    ]
    for path in paths:
        ink = np.any(imread(path)[..., :3] < 0.9, axis=-1)
        assert ink.mean() > 0.01
        assert not any(edge.any() for edge in (ink[:3], ink[-3:], ink[:, :3], ink[:, -3:])), "cut off"
    for logs in ([sphere[0], panda], []):
        with pytest.raises(ValueError, match="one scenario"):
            plot_compare(logs, tmp_path)


@pytest.mark.parametrize("steps", [0, 1])
def test_logs_without_steps_obstacles_or_bodies_can_be_drawn(sphere, steps, tmp_path):
    """The second arm of situation 2 is the obstacle; it is shown where it rests."""
    log = sphere[2].until(sphere[2].t[steps]) if steps else run("situation2", "eq10")
    if steps:
        assert len(log.t) == steps
    else:
        assert len(path_figure([log], solver_styles([log])).axes[0].patches) > 0
        none, count = {"bodies": [], "body_radii": [], "pairs": [], "completed": False}, len(log.t)
        bare = {
            "body_distance": np.zeros((count, 0)),
            "body_pair": np.zeros((count, 0), int),
            "body_ends": np.zeros((count, 0, 2, 3)),
        }
        log = replace(log, closest_pair=np.full_like(log.closest_pair, -1), meta={**log.meta, **none}, **bare)
    assert all(path.stat().st_size > 1000 for path in plot_run(log, tmp_path) + plot_compare([log], tmp_path))
    empty = sphere[2].until(0.0)
    assert len(empty.t) == 0 and len(plot_run(empty, tmp_path)) == 4


def test_page_shows_every_figure_the_table_and_the_settings(sphere, panda, tmp_path):
    """It refers to nothing but the pictures beside it."""
    logs = [*sphere[:3], panda]
    files = [path for log in logs for path in plot_run(log, tmp_path)] + plot_compare(sphere[:3], tmp_path)
    text = write_index(logs, files, tmp_path).read_text(encoding="utf-8")
    assert set(re.findall(r'<img src="([^"]*)"', text)) == {path.name for path in files}
    own = {f"{log.meta['scenario']}_{log.meta['solver'].replace(':', '-')}.npz" for log in logs}
    assert all(name in text for name in own) and "of other commands" not in text
    (tmp_path / "older_qp.npz").touch()
    assert "of other commands: older_qp.npz." in write_index(logs, files, tmp_path).read_text(encoding="utf-8")
    assert "http" not in re.sub(r"<pre>.*?</pre>", "", text, flags=re.DOTALL)
    for log in logs:
        assert f"<td>{log.meta['solver']}</td>" in text
        assert f"d1: {log.meta['config']['avoidance']['d1']}" in text
    assert f"<td>{1e3 * panda.metrics()['min_distance']:.1f}</td>" in text


def test_figures_of_a_robot_that_stands_show_torques_between_limits_and_forces_in_cones(panda, tmp_path):
    pytest.importorskip("mujoco")
    log = simulate(load_scenario("g1_wave", ["duration=0.05"]))
    figures = torque_figures(log)
    assert list(figures) == ["torques", "contacts"] and not torque_figures(panda)
    panels = {ax.get_title(): ax.get_lines() for ax in figures["torques"].axes}
    assert len(panels) == 29
    torque, *limits = panels["left_knee_joint"]
    assert_allclose(torque.get_ydata(), log.torque[:, log.meta["coordinates"][6:].index("left_knee_joint")])
    assert sorted(line.get_ydata()[0] for line in limits) == [-139.0, 139.0]
    cones, bearing, slip = figures["contacts"].axes
    slopes = [line.get_ydata()[1] / line.get_xdata()[1] for line in cones.get_lines()[2:]]
    assert_allclose(slopes, [0.5, 0.7])
    weight = sum(line.get_ydata() for line in bearing.get_lines())
    assert_allclose(weight, log.contact_force[:, :, 2].sum(axis=1))
    assert len(slip.get_lines()) == 8
    paths = plot_run(log, tmp_path)
    assert [path.stem.rpartition("_")[2] for path in paths[-2:]] == ["torques", "contacts"]
    assert all(f'"{path.name}"' in write_index([log], paths, tmp_path).read_text() for path in paths)
