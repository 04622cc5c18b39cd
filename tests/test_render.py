"""Films without a display: what is on the pictures, and the files that `qpavoid render` writes."""

import numpy as np
import pytest

from qpavoid import load_scenario, simulate
from qpavoid.run.log import Log

pytest.importorskip("mujoco")
pytest.importorskip("trimesh")
pytest.importorskip("collada")
Image = pytest.importorskip("PIL.Image")

from qpavoid.errors import ConfigError  # noqa: E402
from qpavoid.run.mujoco_stage import Camera, Part, Segment, Stage, find_back_end  # noqa: E402
from qpavoid.viz.log_frames import LogFrames  # noqa: E402

SHORT = ["duration=2.4", "dt=0.02"]
"""The ball has come to the hand: tracking alone is in contact."""


@pytest.fixture(scope="module", autouse=True)
def back_end():
    try:
        return find_back_end()
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def tracking(tmp_path_factory):
    log = simulate(load_scenario("panda_ball", SHORT, "tracking"))
    return log.save(tmp_path_factory.mktemp("logs") / "tracking.npz")


def share_of(picture, colour):
    """How much of a picture has nearly the hue of a colour."""
    pixels = picture.astype(float) / np.maximum(picture.max(axis=2, keepdims=True), 1)
    return np.mean(np.abs(pixels - np.divide(colour, max(colour))).max(axis=2) < 0.25)


def test_stage_shows_what_is_placed_where_it_is_placed():
    vertices = 0.2 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    stage = Stage([Part([(vertices, faces, (1.0, 0.0, 0.0, 1.0))])], 96, 64)
    camera = Camera((0.0, 0.0, 0.5), 2.0, 90.0, -10.0)  # looks along y: x is to the right
    columns = []
    for x in (-0.4, 0.4):
        stage.place([(np.eye(3), np.array([x, 0.0, 0.5]))])
        picture = stage.render(camera).astype(int)
        red = (picture[..., 0] > 90) & (picture[..., 1] < 40)
        assert 0.01 < red.mean() < 0.2
        columns.append(np.nonzero(red)[1].mean())
    assert columns[0] < 40 < 56 < columns[1]
    stage.place([(np.eye(3), np.array([0.0, 5.0, -5.0]))])
    line = Segment(np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 0.7]), 0.05, (0.0, 0.0, 1.0))
    with_line, without = (stage.render(camera, segments).astype(int) for segments in ([line], []))
    blue = [np.mean((picture[..., 2] > 90) & (picture[..., 0] < 40)) for picture in (with_line, without)]
    assert blue[0] > 0.01 > blue[1]
    stage.close()


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
        assert share_of(panel[30:], (230, 107, 64)) > 0.01  # the ball
        assert np.mean(panel.min(axis=2) > 200) > 0.03  # sky, and the white robot
    assert np.abs(left.astype(int) - right.astype(int)).max(axis=2).mean() > 3.0  # tracking and qp do not do the same


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
