"""Draw the figures of docs/concepts.md, from the package's own functions and runs: `make figures`."""

from pathlib import Path

import matplotlib as mpl

mpl.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch

from qpavoid import load_scenario, simulate
from qpavoid.kernels.rows import alpha, beta

FOLDER = Path(__file__).parent
BLUE, RED, GREEN, ORANGE, GREY = "#3949ab", "#c62828", "#2e7d32", "#ef6c00", "#78909c"
D1, D2, GAIN = 0.03, 0.15, 5.0
"""Defaults of `Avoidance`, and of its row [m, m, 1/s]."""
plt.rcParams |= {
    "svg.hashsalt": "qpavoid", "svg.fonttype": "path", "font.size": 10, "axes.spines.top": False,
    "axes.spines.right": False, "legend.frameon": False,
}  # fmt: skip


def save(figure, name):
    figure.savefig(FOLDER / f"{name}.svg", bbox_inches="tight", facecolor="white", metadata={"Date": None})
    plt.close(figure)


def mark_distances(axes, scale=1e3):
    for d, name in ((D1, "d1"), (D2, "d2")):
        axes.axvline(scale * d, color=GREY, linewidth=0.8, linestyle=":")
        axes.annotate(name, (scale * d, 1.0), xycoords=("data", "axes fraction"), color=GREY, ha="center", va="bottom")


def pair():
    """A link and an obstacle: witness points, normal, distance, and where d1 and d2 are."""
    figure, axes = plt.subplots(figsize=(6.4, 2.9))
    start, end, radius = np.array([-1.9, -0.75]), np.array([0.1, 0.35]), 0.28
    centre, size = np.array([1.75, 0.55]), 0.45
    axes.plot(*np.array([start, end]).T, color=BLUE, alpha=0.35, linewidth=40, solid_capstyle="round")
    axes.add_patch(Circle(centre, size, color=ORANGE, alpha=0.5))
    for margin, name in ((0.25, "d1"), (0.85, "d2")):
        axes.add_patch(Circle(centre, size + margin, fill=False, color=GREY, linestyle="--"))
        axes.annotate(name, centre + (size + margin) * np.array([0.42, -0.91]), color=GREY, ha="center", va="bottom")
    normal = (centre - end) / np.linalg.norm(centre - end)
    a, b = end + radius * normal, centre - size * normal
    axes.plot(*np.array([a, b]).T, "o-", color=RED, markersize=5)
    axes.annotate("d", (a + b) / 2 + [0.0, 0.08], color=RED, ha="center")
    axes.annotate("witness points", (a + b) / 2 + [-0.2, 0.75], ha="center", color="black")
    for point in (a, b):
        axes.plot(*np.array([(a + b) / 2 + [-0.2, 0.72], point]).T, color="black", linewidth=0.5)
    axes.annotate("", a, a - 0.8 * normal, arrowprops={"arrowstyle": "->", "color": "black"})
    axes.annotate("normal n", a - 0.8 * normal + [0.0, -0.22], ha="center")
    axes.annotate("", centre - [0.75, 0.0], centre, arrowprops={"arrowstyle": "-|>", "color": ORANGE})
    axes.annotate("its velocity: feed-forward", centre + [0.5, 0.12], color="#bf360c", ha="left")
    axes.annotate("link: a capsule", start + [0.35, -0.35], color=BLUE, ha="left")
    axes.set(xlim=(-2.4, 4.0), ylim=(-1.35, 1.95), aspect="equal")
    axes.axis("off")
    save(figure, "pair")


def gains():
    """α and β over the distance."""
    figure, axes = plt.subplots(figsize=(6.0, 2.6))
    d = np.linspace(0.02, 0.18, 400)
    axes.plot(1e3 * d, [min(alpha(x, D2), 2.0) for x in d], color=ORANGE, label="α: takes the approach out of the task")
    axes.plot(1e3 * d, [beta(x, D1, D2) for x in d], color=BLUE, label="β: backing away takes over")
    mark_distances(axes)
    axes.set(xlabel="distance d [mm]", ylabel="gain", ylim=(0, 2.05))
    axes.legend()
    save(figure, "gains")


def rows():
    """How fast a pair may close in, over its distance, by form of the row."""
    figure, axes = plt.subplots(figsize=(6.0, 3.0))
    d = np.linspace(D1, 0.17, 400)
    damper = GAIN * (d - D1)
    slowed = np.array([(1.0 - beta(x, D1, D2)) for x in d]) * damper
    near = d <= D2
    for speed, style, label in (
        (0.02, {"color": BLUE, "linewidth": 2.0}, "beta, near_speed 20 mm/s (default)"),
        (0.0, {"color": BLUE, "linestyle": "--"}, "beta, near_speed 0: creeps"),
        (10.0, {"color": RED}, "beta, near_speed 10 m/s: velocity damper"),
    ):
        allowed = np.maximum(slowed, np.minimum(damper, speed))
        axes.plot(1e3 * d[near], 1e3 * allowed[near], label=label, **style)
    mark_distances(axes)
    axes.annotate("beyond d2: no row", (152, 40), color=GREY)
    axes.set(xlabel="distance d [mm]", ylabel="closing speed allowed [mm/s]", xlim=(15, 190), ylim=(0, 640))
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.06))
    save(figure, "rows")


def run():
    """One scenario with and without avoidance: the closest surfaces over time."""
    figure, axes = plt.subplots(figsize=(6.4, 2.8))
    scenario = load_scenario("panda_ball")
    for solver, color in (("tracking", RED), ("qp", BLUE)):
        log = simulate(load_scenario("panda_ball", solver=solver))
        axes.plot(log.t, 1e3 * log.min_distance, color=color, label=solver)
    axes.axhline(0.0, color="black", linewidth=0.8)
    for d, name in ((scenario.avoidance.d1, "d1"), (scenario.avoidance.d2, "d2")):
        axes.axhline(1e3 * d, color=GREY, linestyle=":", linewidth=1.0)
        axes.annotate(name, (log.t[-1], 1e3 * d), color=GREY, ha="right", va="bottom")
    axes.set(xlabel="time [s]", ylabel="closest surfaces [mm]")
    axes.legend(loc="lower right")
    save(figure, "run")


def step():
    """What a control step does, from left to right."""
    figure, axes = plt.subplots(figsize=(8.6, 2.5))
    boxes = (
        ("state q\ntargets\nobstacles", GREY), ("kinematics,\nnear pairs,\ndistances", BLUE),
        ("rows of tasks\nand avoidance,\nbounds", BLUE), ("solver:\nqp, eq10, …", GREEN),
        ("look-ahead,\nbackup\ntrajectory", ORANGE), ("v, status,\nreasons", GREY),
    )  # fmt: skip
    for number, (text, color) in enumerate(boxes):
        x = 1.45 * number
        box = FancyBboxPatch((x, 0), 1.1, 0.9, boxstyle="round,pad=0.05", facecolor=color, alpha=0.18, edgecolor=color)
        axes.add_patch(box)
        axes.annotate(text, (x + 0.55, 0.45), ha="center", va="center", fontsize=8.5)
        if number:
            axes.add_patch(FancyArrowPatch((x - 0.29, 0.45), (x - 0.06, 0.45), arrowstyle="-|>", mutation_scale=11))
    axes.annotate("exchangeable", (4.9, -0.22), ha="center", color=GREEN, fontsize=8.5)
    axes.annotate("a Problem", (3.45, 1.08), ha="center", fontsize=8.5)
    axes.annotate("a Solution", (5.6, 1.08), ha="center", fontsize=8.5)
    axes.set(xlim=(-0.15, 8.5), ylim=(-0.4, 1.3), aspect="equal")
    axes.axis("off")
    save(figure, "step")


if __name__ == "__main__":
    for draw in (pair, gains, rows, step, run):
        draw()
