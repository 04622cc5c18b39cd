"""Films without a display: what is on the pictures, and the files that `qpavoid render` writes."""

import numpy as np
import pytest

from qpavoid import load_scenario, simulate
from qpavoid.run.log import Log

pytest.importorskip("matplotlib")
pytest.importorskip("trimesh")
pytest.importorskip("collada")
Image = pytest.importorskip("PIL.Image")

from qpavoid.viz.film import film_sight, stages_of  # noqa: E402
from qpavoid.viz.log_frames import LogFrames  # noqa: E402

SHORT = ["duration=2.4", "dt=0.02"]
"""The ball has come to the hand: tracking alone is in contact."""


@pytest.fixture(scope="module")
def tracking(tmp_path_factory):
    log = simulate(load_scenario("panda_ball", SHORT, "tracking"))
    return log.save(tmp_path_factory.mktemp("logs") / "tracking.npz")


def share_of(picture, colour):
    """How much of a picture has nearly the hue of a colour."""
    pixels = picture.astype(float) / np.maximum(picture.max(axis=2, keepdims=True), 1)
    return np.mean(np.abs(pixels - np.divide(colour, max(colour))).max(axis=2) < 0.25)


def test_picture_shows_contact_in_red_and_the_ball_where_it_is(tracking):
    log = Log.load(tracking)
    sight = film_sight([log], None, None)
    (stage,) = stages_of([log], 240)
    far, contact = (stage.picture(step, sight) for step in (0, len(log.t) - 1))
    assert share_of(contact[30:], (198, 47, 47)) > share_of(far[30:], (198, 47, 47)) + 0.02
    assert np.mean(far.min(axis=2) > 200) > 0.3  # sky, floor, and the white robot
    ball = [described["name"] for described in log.meta["obstacles"]].index("ball")
    place = sight.projection.flat(log.obstacle_position[-1, ball]) - sight.lower
    column, row = place / (sight.upper - sight.lower) * (contact.shape[1], contact.shape[0])
    pixel = contact[contact.shape[0] - 1 - int(row), int(column)].astype(float)
    assert pixel[0] > 1.4 * pixel[2]  # orange, or the red of the hand before it
    assert np.all(sight.projection.flat(log.tool) > sight.lower)
    assert np.all(sight.projection.flat(log.tool) < sight.upper)


def test_camera_looks_where_it_is_asked_to(tracking):
    log = Log.load(tracking)
    forward = film_sight([log], 90.0, -20.0).projection.forward
    np.testing.assert_allclose(forward, [0.0, np.cos(np.radians(20.0)), -np.sin(np.radians(20.0))], atol=1e-12)


def test_frames_of_a_log_have_its_distances(tracking):
    log = Log.load(tracking)
    frames = LogFrames(log)
    for step in (0, len(log.t) - 1):
        frame = frames.frame(step)
        distance = min(frame.witnesses[:, 0], default=np.inf)
        assert distance == pytest.approx(log.min_distance[step], abs=1e-6) or (
            distance == np.inf and log.min_distance[step] > frames.levels[1]
        )
        ends = np.linalg.norm(frame.witnesses[:, 1:4] - frame.witnesses[:, 4:7], axis=1)
        np.testing.assert_allclose(ends, np.abs(frame.witnesses[:, 0]), atol=1e-6)
    assert log.min_distance[-1] < 0.0


def test_render_writes_film_and_picture(cli, tracking, tmp_path):
    done = cli(
        "render", "panda_ball", *(word for field in SHORT for word in ("--set", field)),
        "--gif", "film.gif", "--png", "moment.png", "--width", 320, "--fps", 3,
    )  # fmt: skip
    assert done.status == 0, done.stderr
    with Image.open(tmp_path / "film.gif") as film, Image.open(tmp_path / "moment.png") as moment:
        durations = [film.seek(number) or film.info["duration"] for number in range(film.n_frames)]
        assert film.size[0] == moment.size[0] == 320
        picture = np.asarray(moment.convert("RGB"))
    assert 2400 < sum(durations) < 3000  # [ms]; equal pictures are one that stays longer
    left, right = picture[:, :160], picture[:, 160:]
    for panel in (left, right):
        assert share_of(panel[10:], (230, 107, 64)) > 0.01  # the ball, as far as the hand does not hide it
        assert np.mean(panel.min(axis=2) > 200) > 0.03  # sky, and the white robot
    assert np.abs(left.astype(int) - right.astype(int)).max(axis=2).mean() > 3.0  # tracking and qp do not do the same


def test_render_takes_a_law_of_ones_own(cli, tmp_path):
    (tmp_path / "laws.py").write_text("def same(problem):\n    return problem.v_tracking.copy()\n")
    fields = [word for field in SHORT for word in ("--set", field)]
    done = cli(
        "render", "panda_ball", *fields, "--solvers", "tracking,laws.py:same", "--png", "moment.png", "--width", 320
    )
    assert done.status == 0, done.stderr
    with Image.open(tmp_path / "moment.png") as moment:
        picture = np.asarray(moment.convert("RGB")).astype(int)
    assert np.abs(picture[20:, :160] - picture[20:, 160:]).max() < 5  # both track, and qp would do otherwise


def test_render_of_a_log_needs_no_simulation(cli, tracking, tmp_path):
    done = cli("render", tracking, "--png", "moment.png", "--width", 160)
    assert done.status == 0, done.stderr
    with Image.open(tmp_path / "moment.png") as moment:
        assert moment.size[0] == 160


@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        (["panda_ball"], "give --gif, --mp4 or --png"),
        (["panda_ball", "situation1", "--png", "a.png"], "give one"),
        (["panda_ball", "log.npz", "--png", "a.png"], "give one scenario, or logs alone"),
        (["log.npz", "--png", "a.png", "--set", "dt=0.02"], "are for scenarios"),
        (["log.npz", "--png", "a.png"], "no such file"),
    ],
)
def test_render_refuses_in_one_line(cli, words, remedy):
    done = cli("render", *words)
    assert done.status == 2
    assert len(done.lines) == 1
    assert remedy in done.stderr


def test_render_looks_for_the_folder_before_the_work(cli, tracking):
    done = cli("render", tracking, "--png", "missing/a.png")
    assert done.status == 2
    assert "no such folder" in done.stderr
