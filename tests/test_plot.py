"""Figures carry the data of the log, and every kind of log can be drawn."""

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
from qpavoid.viz.motion import instants, motion_figure
from qpavoid.viz.surfaces import capsule_faces, obstacle_faces, shape_faces


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
        assert_allclose(drawn[body].get_ydata(), log.body_distance[:, i], atol=1e-15)
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


def test_speeds_show_limits_that_are_near_and_steps_that_are_not_solved(panda):
    limits, v, status = panda.meta["velocity_limit"], np.zeros_like(panda.v), panda.status.copy()
    status[:] = STATUSES.index(Status.SOLVED)
    ax = speeds_figure(replace(panda, v=v, status=status)).axes[0]
    assert not any("limit" in name for name in lines(ax)) and not ax.patches
    v[:, 6] = -0.9 * limits[6]
    status[[4, 5, 6, 20]] = STATUSES.index(Status.RELAXED)
    ax = speeds_figure(replace(panda, v=v, status=status)).axes[0]
    assert_allclose(lines(ax)["panda_joint7"].get_ydata(), v[:, 6])
    assert f"limit ±{limits[6]:g} of panda_joint7" in entries(ax) and "RELAXED: 4 steps" in entries(ax)
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


def test_motion_panels_share_one_view_and_hold_everything(sphere, panda):
    for log in (sphere[0], sphere[2], panda):
        distance = log.body_distance.copy()
        distance[17] = -0.01
        log = replace(log, body_distance=distance)
        steps, axes = instants(log), motion_figure(log).axes
        assert {0, 17, len(log.t) - 1} <= set(steps.tolist()) and np.all(np.diff(steps) > 0)
        assert len({(ax.elev, ax.azim, *ax.get_w_lims()) for ax in axes}) == 1
        lower, upper = np.array(axes[0].get_w_lims()).reshape(3, 2).T
        for step, ax in zip(steps, axes, strict=True):
            assert ax.get_title().startswith(f"t = {log.t[step]:.2f} s")
            bodies = [capsule_faces(e, r) for e, r in zip(log.body_ends[step], log.meta["body_radii"], strict=True)]
            bodies += [obstacle_faces(log, i, step) for i in range(len(log.meta["obstacles"]))]
            points = np.concatenate(bodies).reshape(-1, 3)
            assert np.all(points >= lower) and np.all(points <= upper)


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
        bare = {"body_distance": np.zeros((count, 0)), "body_ends": np.zeros((count, 0, 2, 3))}
        log = replace(log, closest_pair=np.full_like(log.closest_pair, -1), meta={**log.meta, **none}, **bare)
    assert all(path.stat().st_size > 1000 for path in plot_run(log, tmp_path) + plot_compare([log], tmp_path))
    empty = sphere[2].until(0.0)
    assert len(empty.t) == 0 and len(plot_run(empty, tmp_path)) == 4
