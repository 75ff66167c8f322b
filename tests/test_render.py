"""Animations: who is drawn, in which colour, and what is refused."""

import gc
import importlib
import io

import jax
import numpy as np
import pytest
from commands import refused
from PIL import Image

import fleetjax
from fleetjax import cli, envs
from fleetjax.io import render

WIDTH, HEIGHT = 96, 72


@pytest.fixture(scope="module")
def scene():
    return envs.make("humanoid").scene


def can_draw() -> bool:
    try:
        render.check_gl()
    except ValueError:
        return False
    return True


needs_gl = pytest.mark.skipif(not can_draw(), reason=render.NEED_GL)


def film(scene, *, violating, teleoperated):
    """Return a film of one timestep: robots that stand, with the given marks."""
    pose = np.broadcast_to(scene.model.qpos0, (1, len(violating), scene.model.nq))
    return render.Film((pose, np.zeros((1, len(violating), 0, 7))), np.array([violating]), np.array([teleoperated]))


@needs_gl
def test_marks_are_colours(scene):
    marks = {"violating": [False, True, False], "teleoperated": [False, False, True]}
    (picture,) = render.draw(film(scene, **marks), scene, width=WIDTH, every=1)
    assert picture.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    plain, red, blue, empty = (picture[i : i + HEIGHT, j : j + WIDTH].astype(int) for i in (0, HEIGHT) for j in (0, WIDTH))
    assert np.all(empty == 255)
    robot = np.any(plain != red, axis=2) | np.any(plain != blue, axis=2)
    assert 0.005 < robot.mean() < 0.5  # the robots, and nothing else, look different
    assert red[robot, 0].mean() > red[robot, 2].mean() + 30
    assert blue[robot, 2].mean() > blue[robot, 0].mean() + 30


@needs_gl
def test_bodies_are_drawn_where_they_are(scene):
    standing = film(scene, violating=[False], teleoperated=[False])
    lying = standing.seen[0].copy()
    lying[..., 2:7] = 0.1, np.sqrt(0.5), 0, np.sqrt(0.5), 0
    pictures = [
        next(render.draw(x, scene, width=WIDTH, every=1)) for x in (standing, standing._replace(seen=(lying, standing.seen[1])))
    ]
    assert np.mean(pictures[0] != pictures[1]) > 0.01
    again = next(render.draw(standing, scene, width=WIDTH, every=1))
    np.testing.assert_array_equal(again, pictures[0])


@pytest.mark.slow
def test_a_film_is_that_of_the_run():
    small = {"num_robots": 3, "num_humans": 3, "num_steps": 4}
    config = fleetjax.make_config("humanoid", "expert", **small)
    key = jax.random.key(3)
    _, state = render.start(config, key, None, skip=2)
    shot = render.shoot(config, key, state, num_shown=2)
    expected = jax.jit(fleetjax.run)(
        config.replace(num_steps=5), key
    ).state  # the last picture is taken before the last timestep
    assert shot.seen[0].shape == (4, 2, 28)
    np.testing.assert_allclose(shot.seen[0][-1], expected.env.physics.qpos[:2], atol=1e-4)  # two programs
    assert shot.teleoperated.all()
    assert not shot.violating.any()


def test_pictures_from_above_are_framed():
    """Blue under teleoperation, red in violation, else white; the picture itself stays."""
    pictures = np.full((1, 4, 80, 80, 3), 200, np.uint8)
    marks = np.array([[False, True, False, True]]), np.array([[False, False, True, True]])
    (grid,) = render.draw(render.Film((pictures,), *marks), None, width=40, every=1)
    assert grid.shape == (80, 80, 3)
    corners = [grid[0, 0], grid[0, 40], grid[40, 0], grid[40, 40]]
    red, blue = (np.round(255 * np.array(colour)) for colour in (render.VIOLATING, render.TELEOPERATED))
    np.testing.assert_array_equal(corners, [[255] * 3, red, blue, red])
    np.testing.assert_array_equal(grid[20, 60], [200] * 3)


def test_render_draws_what_has_no_bodies(tmp_path, capsys):
    path = tmp_path / "rooms.gif"
    few = ("--num-shown", "3", "--num-steps", "5", "--every", "2", "--width", "64")
    assert cli.main(["render", "navigation", *few, "--output", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        assert (image.size, image.n_frames) == ((128, 128), 3)
        assert np.asarray(image.convert("RGB"))[0, 0, 2] > 200  # the frame: the expert acts


@pytest.mark.slow
@needs_gl
def test_render_writes_a_gif(tmp_path, capsys):
    path = tmp_path / "robots.gif"
    few = ("--num-shown", "2", "--num-steps", "5", "--every", "2", "--width", "64")
    assert cli.main(["render", "humanoid", *few, "--output", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        assert (image.size, image.n_frames) == ((128, 48), 3)
    assert "already exists" in refused(capsys, "render", "humanoid", "--output", path)


@pytest.mark.slow
@needs_gl
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio leaves ffmpeg's pipe to the collector
def test_render_writes_an_mp4(tmp_path, capsys):
    """Every third of seven timesteps at 33 timesteps a second: three pictures in 3 / 11 seconds."""
    from imageio import v3

    path = tmp_path / "robots.mp4"
    few = ("--num-shown", "1", "--num-steps", "7", "--every", "3", "--width", "64")
    assert cli.main(["render", "humanoid", *few, "--output", str(path)]) == 0
    pictures, about = v3.imread(path), v3.immeta(path)
    gc.collect()
    assert pictures.shape == (3, 48, 64, 3)
    assert about["fps"] == pytest.approx(1 / (3 * envs.make("humanoid").spec.control_step), rel=0.01)
    assert pictures.std() > 10
    assert np.mean(pictures[0] != pictures[-1]) > 0.01


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("humanoid", "--output", "x.avi"), "x.avi must end in one of .gif, .mp4"),
        (("humanoid", "--num-shown", 0), "num_shown = 0 must be at least 1"),
        (("humanoid", "--skip", -1), "skip = -1 must be at least 0"),
        (("humanoid", "--policy", "robot"), "--policy robot needs a run folder"),
        (("nowhere",), "nowhere is not a run folder"),
    ],
)
def test_what_cannot_be_drawn_is_refused(arguments, reason, capsys):
    assert reason in refused(capsys, "render", *arguments)


def test_a_machine_without_opengl_is_told_what_to_install_before_anything_runs(monkeypatch, capsys):
    def missing(name, package=None):
        if name.startswith("mujoco."):
            raise ImportError(name)
        return real(name, package)

    real = importlib.import_module
    monkeypatch.setattr(importlib, "import_module", missing)
    monkeypatch.setattr(render, "start", None)
    assert "libosmesa6" in refused(capsys, "render", "humanoid")


def test_a_notebook_shows_the_robots_of_a_run(tmp_path):
    config = fleetjax.make_config("navigation", "expert", num_robots=3, num_humans=3, num_steps=6)
    shown = fleetjax.animate(config, jax.random.key(0), num_shown=2, every=2, width=40)
    shown.save(tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as picture:
        assert (picture.n_frames, picture.width) == (3, 2 * 40)
    assert shown._repr_html_().startswith('<img alt="animated robots" src="data:image/gif;base64,R0lGOD')
    with pytest.raises(ValueError, match="every = 0"):
        fleetjax.animate(config, jax.random.key(0), every=0)
    result = jax.jit(fleetjax.run)(config, jax.random.key(0))
    assert fleetjax.animate(config, jax.random.key(1), result.state, num_shown=1, width=20).gif
    with pytest.raises(ValueError, match="num_robots = 4, but the state was prepared for 3"):
        fleetjax.animate(config.replace(num_robots=4, num_humans=4), jax.random.key(1), result.state)
