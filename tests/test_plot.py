"""Figures carry the data of the log, and every kind of log can be drawn."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from numpy.testing import assert_allclose

from qpavoid import Log, Status, load_scenario
from qpavoid.run.log import STATUSES
from qpavoid.run.simulate import simulate

pytest.importorskip("matplotlib")

from qpavoid.viz.compare import SOLVER_STYLES, compare_time_figure, path_figure, solver_styles
from qpavoid.viz.figures import (
    ALPHA_SHOWN,
    distances_figure,
    joints_figure,
    plot_compare,
    plot_run,
    position_names,
    speeds_figure,
)
from qpavoid.viz.motion import (
    capsule_faces,
    instants,
    motion_figure,
    obstacle_faces,
    shape_faces,
    view_angles,
)


def run(scenario: str, solver: str) -> Log:
    return simulate(load_scenario(scenario, overrides=["duration=0.3"]), solver=solver)


@pytest.fixture(scope="module")
def sphere() -> list[Log]:
    return [run("situation1", solver) for solver in ("tracking", "eq10", "qp", "qp:proxqp")]


@pytest.fixture(scope="module")
def arms() -> Log:
    return run("situation2", "eq10")


@pytest.fixture(scope="module")
def panda() -> Log:
    return run("panda_line", "qp")


def lines(ax):
    return {line.get_label(): line for line in ax.get_lines()}


def volume(faces):
    """Volume enclosed by outward quadrilaterals (divergence theorem over their triangles)."""
    a, b, c, d = np.moveaxis(faces, 1, 0)
    return sum(np.sum(np.einsum("ij,ij->i", u, np.cross(v, w))) for u, v, w in ((a, b, c), (a, c, d))) / 6.0


# --- one run ------------------------------------------------------------------------------------------------


def test_distance_lines_are_the_logged_distances(sphere):
    log = sphere[2]
    drawn = lines(distances_figure(log).axes[0])
    for i, body in enumerate(log.meta["bodies"]):
        assert_allclose(drawn[body].get_xdata(), log.t)
        assert_allclose(drawn[body].get_ydata(), log.body_distance[:, i], atol=1e-15)


def test_levels_lie_at_d1_d2_d_safe_and_collision(sphere, panda):
    def heights(log):
        ax = distances_figure(log).axes[0]
        drawn = {line.get_ydata()[0] for name, line in lines(ax).items() if "$" in name or "collision" in name}
        return sorted(drawn), ax.get_ylabel()

    config = {**sphere[2].meta["config"]}
    config["avoidance"] = {**config["avoidance"], "row": {"type": "damper", "d_safe": 0.12}}
    surfaces = "distance between surfaces [m]"  # the offset of 0.1 m is taken off
    assert heights(sphere[2]) == (pytest.approx([0.0, 0.08, 0.26]), surfaces)
    held = replace(sphere[2], meta={**sphere[2].meta, "config": config})
    assert heights(held) == (pytest.approx([0.0, 0.02, 0.08, 0.26]), surfaces)
    levels, label = heights(panda)
    avoidance = panda.meta["config"]["avoidance"]
    assert label == "distance between surfaces [m]"
    assert {0.0, avoidance["d1"], avoidance["d2"]} <= set(levels)


def test_collision_and_every_coloured_body_are_in_view(sphere, panda):
    for log in (*sphere, panda):
        ax = distances_figure(log).axes[0]
        bottom, top = ax.get_ylim()
        for line in ax.get_lines():
            assert bottom <= np.min(line.get_ydata()) and np.max(line.get_ydata()) <= top


def test_distant_bodies_are_grey_with_one_entry(panda):
    """Bodies that stay far are grey and share one entry."""
    limit = 1.5 * panda.meta["config"]["avoidance"]["d2"]
    distance = panda.body_distance.copy()
    distance[:, :3] = 2.0 * limit
    distance[:, 3:] = np.minimum(distance[:, 3:], 0.9 * limit)
    ax = distances_figure(replace(panda, body_distance=distance)).axes[0]
    entries = [text.get_text() for text in ax.get_legend().get_texts()]
    assert f"3 bodies never within {limit:g} m" in entries
    assert not set(panda.meta["bodies"][:3]) & set(entries)
    assert set(panda.meta["bodies"][3:]) <= set(entries)
    assert len(ax.get_lines()) == len(panda.meta["bodies"]) + 3  # the far ones are still drawn


def test_a_legend_of_many_bodies_stays_within_its_panel(panda):
    bodies = [f"body{i}" for i in range(40)]
    distance = np.tile(0.05 + 0.001 * np.arange(40)[::-1], (len(panda.t), 1))
    figure = distances_figure(replace(panda, body_distance=distance, meta={**panda.meta, "bodies": bodies}))
    FigureCanvasAgg(figure).draw()
    legend = figure.axes[0].get_legend()
    named = [text.get_text() for text in legend.get_texts()]
    assert named[:14] == bodies[26:]
    assert named[14] == "26 bodies farther away"
    assert legend.get_window_extent().y0 > figure.axes[0].get_window_extent().y0


def test_gains_are_drawn_and_alpha_is_cut_off_where_it_is_infinite(sphere):
    alpha = sphere[0].alpha.copy()
    alpha[3] = np.inf
    ax = distances_figure(replace(sphere[0], alpha=alpha)).axes[1]
    drawn_alpha, drawn_beta = (line.get_ydata() for line in ax.get_lines())
    assert drawn_alpha[3] == ALPHA_SHOWN <= ax.get_ylim()[1]
    assert_allclose(np.delete(drawn_alpha, 3), np.delete(alpha, 3))
    assert_allclose(drawn_beta, sphere[0].beta)


def test_joint_panels_hold_q_and_its_limits(panda):
    figure = joints_figure(panda)
    assert len(figure.axes) == panda.q.shape[1]
    for i, (ax, (name, lower, upper)) in enumerate(zip(figure.axes, panda.meta["position_limits"], strict=True)):
        position, *limits = ax.get_lines()
        assert ax.get_title() == name
        assert_allclose(position.get_ydata(), panda.q[:, i])
        assert [line.get_ydata()[0] for line in limits] == [lower, upper]
        assert ax.get_ylim()[0] < lower and upper < ax.get_ylim()[1]


def test_bodies_of_one_pair_do_not_hide_each_other(arms):
    """Both hands are at the same distance: the line drawn later is the thinner one."""
    shown = [line for line in distances_figure(arms).axes[0].get_lines() if line.get_label() in arms.meta["bodies"]]
    left, right = (next(x for x in shown if x.get_label() == name) for name in ("left_hand", "right_hand"))
    assert_allclose(left.get_ydata()[0], right.get_ydata()[0])
    widths = [line.get_linewidth() for line in shown]
    assert np.all(np.diff(widths) < 0.0)


def test_one_sided_position_limit(panda):
    meta = {**panda.meta, "position_limits": [["panda_joint1", -1.0, np.inf]]}
    ax = joints_figure(replace(panda, meta=meta)).axes[0]
    assert [line.get_ydata()[0] for line in ax.get_lines()[1:]] == [-1.0]


@pytest.mark.parametrize(
    ("velocities", "limited", "nq", "expected"),
    [
        ([f"r.{i}" for i in range(6)] + ["knee"], ["knee"], 8, "r.x r.y r.z r.qx r.qy r.qz r.qw knee"),
        (["wheel", "knee"], ["knee"], 3, "wheel.cos wheel.sin knee"),
        (["wheel", "knee"], ["knee"], 2, "wheel knee"),
        (["wheel", "knee"], ["knee"], 5, "q[0] q[1] q[2] q[3] q[4]"),
    ],
)  # fmt: skip
def test_coordinates_are_named_where_nq_is_not_nv(panda, velocities, limited, nq, expected):
    meta = {**panda.meta, "coordinates": velocities, "position_limits": [[name, -1.0, 1.0] for name in limited]}
    log = replace(panda, q=np.zeros((len(panda.t), nq)), meta=meta)
    assert position_names(log) == expected.split()
    assert len(joints_figure(log).axes) == nq


def test_velocity_limits_are_drawn_where_they_are_near(panda):
    limits = panda.meta["velocity_limit"]
    v = np.zeros_like(panda.v)
    assert not any("limit" in name for name in lines(speeds_figure(replace(panda, v=v)).axes[0]))
    v[:, 6] = -0.9 * limits[6]
    ax = speeds_figure(replace(panda, v=v)).axes[0]
    assert_allclose(lines(ax)["panda_joint7"].get_ydata(), v[:, 6])
    assert {limits[6], -limits[6]} <= {line.get_ydata()[0] for line in ax.get_lines()}
    assert ax.get_ylim()[0] <= -limits[6] and limits[6] <= ax.get_ylim()[1]


def test_a_velocity_limit_names_its_joint(panda):
    limits, v = panda.meta["velocity_limit"], np.zeros_like(panda.v)
    v[:, 6] = limits[6]
    shown = [text.get_text() for text in speeds_figure(replace(panda, v=v)).axes[0].get_legend().get_texts()]
    assert f"limit ±{limits[6]:g} of panda_joint7" in shown
    v[:, 4:] = limits[6]
    shown = [text.get_text() for text in speeds_figure(replace(panda, v=v)).axes[0].get_legend().get_texts()]
    assert limits[4] == limits[6] and f"limit ±{limits[6]:g} of 3 joints near it" in shown


def test_ticks_that_are_not_solved_are_shaded(panda):
    status = panda.status.copy()
    status[[4, 5, 6, 20]] = STATUSES.index(Status.RELAXED)
    ax = speeds_figure(replace(panda, status=status)).axes[0]
    spans = sorted((patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches)
    assert_allclose(spans, [(0.04, 0.07), (0.20, 0.21)])
    assert "RELAXED: 4 ticks" in [text.get_text() for text in ax.get_legend().get_texts()]
    assert not speeds_figure(panda).axes[0].patches
    status[[4, 5, 6]] = panda.status[0]
    ax = speeds_figure(replace(panda, status=status)).axes[0]
    assert "RELAXED: 1 tick" in [text.get_text() for text in ax.get_legend().get_texts()]


# --- motion -------------------------------------------------------------------------------------------------


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
    assert 0.94 * exact < volume(shape_faces(shape)) <= exact * (1 + 1e-12)


def test_capsule_surface_lies_at_its_radius_from_the_axis():
    ends = np.array([[0.1, -0.2, 0.3], [0.5, 0.4, -0.1]])
    points = capsule_faces(ends, 0.07).reshape(-1, 3)
    t = np.clip((points - ends[0]) @ (ends[1] - ends[0]) / np.sum((ends[1] - ends[0]) ** 2), 0.0, 1.0)
    assert_allclose(np.linalg.norm(points - ends[0] - t[:, None] * (ends[1] - ends[0]), axis=1), 0.07, atol=1e-12)
    assert volume(capsule_faces(ends, 0.07)) > 0.0


def test_obstacle_is_drawn_where_it_is(panda):
    position, rotation = panda.obstacle_position.copy(), panda.obstacle_rotation.copy()
    position[-1, 0] += [0.1, -0.2, 0.3]
    rotation[-1, 0] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    moved = replace(panda, obstacle_position=position, obstacle_rotation=rotation)
    size = np.array(panda.meta["obstacles"][0]["shape"]["size"])
    for tick, sides in ((0, size), (len(panda.t) - 1, size[[1, 0, 2]])):
        points = obstacle_faces(moved, 0, tick).reshape(-1, 3)
        assert_allclose(0.5 * (points.min(axis=0) + points.max(axis=0)), position[tick, 0], atol=1e-12)
        assert_allclose(np.ptp(points, axis=0), sides, atol=1e-12)


def test_instants_hold_start_end_and_closest_approach(sphere):
    log = sphere[0]
    distance = log.body_distance.copy()
    distance[17] = -0.01
    ticks = instants(replace(log, body_distance=distance))
    assert len(ticks) == 6 and {0, 17, len(log.t) - 1} <= set(ticks.tolist())
    assert np.all(np.diff(ticks) > 0)


def test_solvers_share_one_view(sphere):
    assert len({view_angles(log) for log in sphere}) == 1


def test_motion_panels_share_view_scale_and_hold_everything(sphere, arms, panda):
    for log in (sphere[0], arms, panda):
        figure = motion_figure(log)
        limits = np.array([ax.get_w_lims() for ax in figure.axes])
        assert np.all(limits == limits[0])
        assert {(ax.elev, ax.azim) for ax in figure.axes} == {view_angles(log)}
        x0, x1, y0, y1, z0, z1 = limits[0]
        aspect = np.array(figure.axes[0]._box_aspect)
        size = np.array([x1 - x0, y1 - y0, z1 - z0])
        assert_allclose(aspect / np.linalg.norm(aspect), size / np.linalg.norm(size), rtol=1e-9)  # one scale
        for tick, ax in zip(instants(log), figure.axes, strict=True):
            assert ax.get_title().startswith(f"t = {log.t[tick]:.2f} s")
            bodies = [capsule_faces(e, r) for e, r in zip(log.body_ends[tick], log.meta["body_radii"], strict=True)]
            bodies += [obstacle_faces(log, i, tick) for i in range(len(log.meta["obstacles"]))]
            points = np.concatenate(bodies).reshape(-1, 3)
            assert np.all(points.min(axis=0) >= (x0, y0, z0)) and np.all(points.max(axis=0) <= (x1, y1, z1))


def test_view_does_not_put_an_obstacle_before_the_path(sphere):
    log = sphere[2]
    path = log.target[:, 0]
    along = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
    meta = {**log.meta, "obstacles": [{"name": "ball", "shape": {"type": "sphere", "radius": 0.25}}]}
    for side in (-1.0, 1.0):
        place = np.broadcast_to(path.mean(axis=0) + np.array([0.4 * side, 0.0, 0.1]), log.obstacle_position.shape)
        elevation, azimuth = np.radians(view_angles(replace(log, obstacle_position=place, meta=meta)))
        towards = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        ball = place[0, 0] - path
        seen_from_here = ball - np.outer(ball @ towards, towards)
        assert np.all((np.linalg.norm(seen_from_here, axis=1) > 0.25) | (ball @ towards < 0.0))
        assert abs(towards @ along) < 0.8  # nor is the path foreshortened to a point


def test_view_is_not_from_behind_a_wall(sphere):
    """A board before the robot hides all of it, though its middle is nowhere near what is behind it."""
    log = sphere[2]
    board = {"name": "board", "shape": {"type": "box", "size": [0.02, 3.0, 3.0]}}
    for side in (-1.0, 1.0):
        place = np.broadcast_to([0.8 * side, 1.2, 0.5], log.obstacle_position.shape)
        views = view_angles(replace(log, obstacle_position=place, meta={**log.meta, "obstacles": [board]}))
        assert np.cos(np.radians(views[1])) * side < 0.0


def test_numbers_and_names_of_axes_do_not_overlap(sphere, arms):
    size = np.array([0.2, 1.0, 1.0])  # of a body that is thin across, as a humanoid is
    thin = replace(arms, **{name: getattr(arms, name) * size for name in ("body_ends", "target", "tool")})
    for log in (sphere[0], arms, thin):
        figure = motion_figure(log)
        FigureCanvasAgg(figure).draw()
        ax = figure.axes[0]
        numbers = [tick.label1 for axis in (ax.xaxis, ax.yaxis, ax.zaxis) for tick in axis.get_major_ticks()]
        names = [axis.label for axis in (ax.xaxis, ax.yaxis, ax.zaxis)]
        boxes = [text.get_window_extent() for text in (*numbers, *names) if text.get_text()]
        assert len(boxes) > 5
        assert not any(a.padded(-2).overlaps(b.padded(-2)) for a, b in combinations(boxes, 2))


# --- several solvers ----------------------------------------------------------------------------------------


def test_each_solver_keeps_its_own_colour_and_dash_in_all_panels(sphere):
    styles = solver_styles(sphere)
    assert len({style["color"] for style in styles}) == len({str(style["linestyle"]) for style in styles[:3]}) + 1 == 4
    panels = [*compare_time_figure(sphere).axes, *path_figure(sphere, styles).axes]
    assert len(panels) == 6
    for ax in panels:
        colours = {name: to_hex(line.get_color()) for name, line in lines(ax).items()}
        for style in styles:
            assert colours[style["label"]] == style["color"].lower()


def test_known_solvers_differ_in_colour_and_dash():
    assert len({colour for colour, _ in SOLVER_STYLES.values()}) == len(SOLVER_STYLES)
    assert len({str(dash) for _, dash in SOLVER_STYLES.values()}) == len(SOLVER_STYLES)


def test_styles_of_equal_runs_differ(sphere):
    """Of two runs with one course, neither line is hidden: they differ in colour and dash, and dashes lie on top."""
    tracking, eq10, qp, proxqp = sphere
    for logs in ([qp, qp], [proxqp, qp], [qp, proxqp, proxqp, tracking, eq10, proxqp, qp]):
        styles = solver_styles(logs)
        assert len({style["label"] for style in styles}) == len(logs)
        assert len({style["color"] for style in styles}) == len(logs)
        assert len({str(style["linestyle"]) for style in styles}) == len(logs)
        solid = [style["zorder"] for style in styles if style["linestyle"] == "-"]
        assert solid and all(style["zorder"] > max(solid) for style in styles if style["linestyle"] != "-")


def test_many_runs_all_look_different(sphere):
    styles = solver_styles([log for log in sphere for _ in range(10)])
    assert len({(style["color"], str(style["linestyle"])) for style in styles}) == 40


def test_compared_curves_are_those_of_the_logs(sphere):
    distance, _, error, speed = compare_time_figure(sphere).axes
    for log in sphere:
        name = log.meta["solver"]
        assert_allclose(lines(distance)[name].get_ydata(), log.min_distance)
        assert_allclose(lines(error)[name].get_ydata(), np.linalg.norm(log.target - log.tool, axis=2)[:, 0], atol=1e-8)
        assert_allclose(lines(speed)[name].get_ydata(), np.abs(log.v).max(axis=1))


def test_path_views_show_two_planes_of_the_tool_path_at_one_scale(sphere):
    figure = path_figure(sphere, solver_styles(sphere))
    width, height = figure.get_size_inches()
    log, axes = sphere[1], figure.axes
    for ax, up in zip(axes, (2, 0), strict=True):  # the path runs along y
        assert_allclose(lines(ax)["eq10"].get_xdata(), log.tool[:, 0, 1])
        assert_allclose(lines(ax)["eq10"].get_ydata(), log.tool[:, 0, up])
        box = ax.get_position()
        assert_allclose(box.width * width / np.ptp(ax.get_xlim()), box.height * height / np.ptp(ax.get_ylim()))
        circle = ax.patches[0].get_xy()
        assert_allclose(np.ptp(circle, axis=0), 0.10, rtol=0.01)  # the fist, 0.05 m in radius


def test_path_shows_arm_that_is_the_obstacle(arms):
    """Arm at rest is shown where it is the obstacle."""
    assert len(path_figure([arms], solver_styles([arms])).axes[0].patches) > 0


def test_logs_of_different_scenarios_are_refused(sphere, arms, tmp_path):
    with pytest.raises(ValueError, match="one scenario"):
        plot_compare([sphere[0], arms], tmp_path)
    with pytest.raises(ValueError, match="one scenario"):
        plot_compare([], tmp_path)


# --- files --------------------------------------------------------------------------------------------------


def test_files_are_named_and_not_blank(sphere, tmp_path):
    from matplotlib.image import imread

    paths = plot_run(sphere[3], tmp_path / "new" / "folder") + plot_compare(sphere, tmp_path)
    assert [path.name for path in paths] == [
        *(f"situation1_qp-proxqp_{name}.png" for name in ("motion", "joints", "distances", "speeds")),
        "situation1_compare_time.png",
        "situation1_compare_path.png",
    ]
    for path in paths:
        pixels = imread(path)[..., :3]
        ink = np.any(pixels < 0.9, axis=-1)
        assert ink.mean() > 0.01
        assert (
            not ink[:3].any() and not ink[-3:].any() and not ink[:, :3].any() and not ink[:, -3:].any()
        )  # not cut off


@pytest.mark.parametrize("ticks", [0, 1, 2])
def test_short_logs_can_be_drawn(sphere, panda, ticks, tmp_path):
    log = panda if ticks == 1 else sphere[2]
    short = log.until(log.t[ticks])
    assert len(short.t) == ticks
    assert all(path.stat().st_size > 1000 for path in plot_run(short, tmp_path) + plot_compare([short], tmp_path))


def test_runs_without_obstacles_pairs_or_bodies_can_be_drawn(arms, tmp_path):
    none = replace(
        arms,
        body_distance=np.full_like(arms.body_distance, np.inf),
        closest_pair=np.full_like(arms.closest_pair, -1),
        meta={**arms.meta, "pairs": []},
    )
    bare = replace(
        none,
        body_distance=np.zeros((len(arms.t), 0)),
        body_ends=np.zeros((len(arms.t), 0, 2, 3)),
        meta={**none.meta, "bodies": [], "body_radii": [], "completed": False, "stopped_by": "v is NaN"},
    )
    for log in (none, bare):
        assert len(plot_run(log, tmp_path) + plot_compare([log, arms], tmp_path)) == 6
