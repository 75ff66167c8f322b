"""Moving pictures of a fleet: a grid of robots, each with its own camera, tinted under teleoperation or in violation."""

import contextlib
import importlib.util
import io
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from fleetjax import envs
from fleetjax.allocation import helper_of
from fleetjax.config import Config
from fleetjax.experiment import evaluate, prepare, run, without_teleoperation
from fleetjax.fleet import FleetState, make_fleet
from fleetjax.keys import key_at
from fleetjax.learning.imitation import PolicyState
from fleetjax.types import EnvState

FORMATS = (".gif", ".mp4")
CAMERA = "track"  # that every model has
TELEOPERATED, VIOLATING, WHITE = (0.1, 0.45, 0.9), (0.9, 0.25, 0.1), (1.0, 1.0, 1.0)  # red, green, blue
NEED_GL = (
    "no OpenGL library for drawing without a screen; install one of Debian's packages libegl1 (with libgl1-mesa-dri) or "
    "libosmesa6, or what your system calls them"
)


class Film(NamedTuple):
    """What there is to see, in numpy arrays.

    Attributes:
        seen: arrays [T, K, ...]: positions of the joints, and of what is only shown; or a picture from above.
        violating: bool[T, K].
        teleoperated: bool[T, K].
    """

    seen: tuple[np.ndarray, ...]
    violating: np.ndarray
    teleoperated: np.ndarray


def check_format(path: Path) -> None:
    """Check that films can be written to such a file.

    Raises:
        ValueError: if the format is unknown, or its writer is not installed.
    """
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path} must end in one of {', '.join(FORMATS)}")
    if path.suffix.lower() == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ValueError(f'{path} needs imageio with ffmpeg; run pip install ".[video]" in the source folder, or choose a .gif')


def check(config: Config) -> None:
    """Check that there is something to draw, and with what.

    Raises:
        ValueError: if the environment has nothing to draw, or an OpenGL library is needed and there is none.
    """
    env = envs.make(config.environment, config.backend)
    if env.scene is None and env.picture is None:
        raise ValueError(f"environment = {config.environment!r} has nothing to draw; choose another")
    if env.scene:
        check_gl()


def start(config: Config, key: jax.Array, policy: PolicyState | None, *, skip: int) -> tuple[Config, FleetState]:
    """Return the configuration of a film, and the state in which it begins.

    Args:
        config: configuration.
        key: random key.
        policy: a trained policy that acts alone; None pre-trains, and humans help.
        skip: timesteps to run first.
    """
    if policy is not None:
        state = jax.jit(evaluate)(config.replace(num_steps=max(1, skip)), key, policy).state
        return without_teleoperation(config), state
    state = jax.jit(prepare)(config, key)
    return config, jax.jit(run)(config.replace(num_steps=skip), key, state).state if skip else state


def shoot(config: Config, key: jax.Array, state: FleetState, *, num_shown: int) -> Film:
    """Run `config.num_steps` timesteps from `state`, as `fleetjax.run` does, and keep what the first robots look like."""
    env = envs.make(config.environment, config.backend)
    draw = env.picture
    look: Callable[[EnvState], Any] = env.scene.pose if env.scene else lambda state: (draw(state),) if draw else ()
    fleet = make_fleet(config, env)

    def timestep(state: FleetState, _: None):
        after, _metrics = fleet.step(state, key_at(key, state.timestep))
        helped = helper_of(after.humans, config.num_robots) >= 0
        seen = jax.tree.map(lambda x: x[:num_shown], (state.env, helped & ~after.resetting))
        return after, Film(jax.vmap(look)(seen[0]), seen[0].violation, seen[1])

    film = jax.jit(lambda state: jax.lax.scan(timestep, state, length=config.num_steps)[1])
    return jax.device_get(film(state))


def draw(film: Film, scene: envs.Scene | None, *, width: int, every: int) -> Iterator[np.ndarray]:
    """Yield a picture u8[H, W, 3] of every `every`-th timestep: a grid of tiles `width` pixels wide.

    Args:
        film: what there is to see.
        scene: how bodies are drawn; None if the film holds pictures.
        width: of a tile.
        every: timesteps from one picture to the next.

    Raises:
        ValueError: if no OpenGL library is found.
    """
    length, number = film.violating.shape
    columns = int(np.ceil(np.sqrt(number)))
    with _painter(scene.model, width, 3 * width // 4) if scene else contextlib.nullcontext(_frame(width)) as paint:
        for t in range(0, length, every):
            tiles = [paint(*robot) for robot in zip(*(x[t] for x in (*film.seen, *film[1:])), strict=True)]
            tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
            yield np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])


def _frame(width: int) -> Callable[..., np.ndarray]:
    """Return a function from a picture from above and the robot's two marks to a tile, in a frame of its mark's colour."""
    from PIL import Image

    def paint(picture: np.ndarray, violating: bool, teleoperated: bool) -> np.ndarray:
        picture = np.array(Image.fromarray(picture).resize((width, width)))
        colour = VIOLATING if violating else TELEOPERATED if teleoperated else WHITE
        edge = max(1, width // (80 if colour is WHITE else 40))
        tile = np.tile(np.round(255 * np.array(colour)).astype(np.uint8), (width, width, 1))
        tile[edge:-edge, edge:-edge] = picture[edge:-edge, edge:-edge]
        return tile

    return paint


@contextlib.contextmanager
def _painter(model: mujoco.MjModel, width: int, height: int) -> Iterator[Callable[..., np.ndarray]]:
    """Yield a function from a pose and the robot's two marks to a picture."""
    context = _gl_context(width, height)
    context.make_current()
    plain = model.geom_rgba.copy()
    robot = (model.geom_bodyid > 0) & (model.geom_group == 0)  # group 1: what robots handle
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
    target = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, target)
    camera, options = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED.value, model.camera(CAMERA).id
    place = mujoco.MjrRect(0, 0, width, height)
    pixels = np.empty((height, width, 3), np.uint8)

    def paint(pose: np.ndarray, mocap: np.ndarray, violating: bool, teleoperated: bool) -> np.ndarray:
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = pose, mocap[:, :3], mocap[:, 3:]
        model.geom_rgba[:] = plain
        if violating or teleoperated:
            model.geom_rgba[robot, :3] = 0.3 * plain[robot, :3] + 0.7 * np.array(VIOLATING if violating else TELEOPERATED)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(model, data, options, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
        mujoco.mjr_render(place, scene, target)
        mujoco.mjr_readPixels(pixels, None, place, target)
        return pixels[::-1].copy()

    try:
        yield paint
    finally:
        model.geom_rgba[:] = plain
        target.free()
        context.free()


def check_gl() -> None:
    """Check that drawing without a screen works here.

    Raises:
        ValueError: if no OpenGL library is found.
    """
    _gl_context(16, 16).free()


def _gl_context(width: int, height: int) -> Any:
    """Return an OpenGL context for drawing without a screen: EGL, else OSMesa; MUJOCO_GL picks one.

    Raises:
        ValueError: if there is none.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    for name in [wanted] if wanted in ("egl", "osmesa") else ["egl", "osmesa"]:
        with contextlib.suppress(ImportError, AttributeError, RuntimeError, OSError):
            return importlib.import_module(f"mujoco.{name}").GLContext(width, height)
    raise ValueError(NEED_GL)


def _sample(images: list[Any]) -> Any:
    """Return one image with the colours of a film: some of its pictures, and those of the marks."""
    from PIL import Image

    some = images[:: max(1, len(images) // 6)]
    width, height = images[0].size
    sample = Image.new("RGB", (width, height * (len(some) + 1)))
    for i, image in enumerate(some):
        sample.paste(image, (0, i * height))
    marks = [tuple(round(255 * x) for x in colour) for colour in (VIOLATING, TELEOPERATED, WHITE)]
    for i, colour in enumerate(marks):
        sample.paste(colour, (i * width // 3, len(some) * height, (i + 1) * width // 3, (len(some) + 1) * height))
    return sample


def encode(pictures: Iterator[np.ndarray], path: Path, *, rate: float) -> bytes:
    """Return a film as the bytes of a gif or an mp4, by the suffix of `path`.

    Args:
        pictures: u8[H, W, 3] each.
        path: where it will go.
        rate: pictures a second.
    """
    if path.suffix.lower() == ".gif":
        from PIL import Image

        # One palette for all pictures: else the colours flicker.
        first, *others = [Image.fromarray(picture) for picture in pictures]
        palette = _sample([first, *others]).quantize(128)
        frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in (first, *others)]
        data = io.BytesIO()
        frames[0].save(data, "gif", save_all=True, append_images=frames[1:], duration=max(20, round(1000 / rate)), loop=0)
        return data.getvalue()
    import imageio.v3  # pyright: ignore[reportMissingImports]  an extra

    options: dict[str, Any] = {"fps": rate, "codec": "libx264", "macro_block_size": 2}
    with warnings.catch_warnings():  # the forked child becomes ffmpeg at once and runs none of JAX's threads
        warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)
        return imageio.v3.imwrite("<bytes>", list(pictures), extension=".mp4", **options)
