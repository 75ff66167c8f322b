"""Block pushing: a cube on a square workspace is pushed to one goal after the other (paper, Section 5.3). Pure JAX.

The workspace is the square [-1, 1]^2, seen from above; a unit is its half side. The robot pushes one of the cube's four faces,
over a fixed distance. Pushes slip: the cube goes less far, a little sideways, and turns. What the robot sees is an
image. The cube must not touch the border, nor enter the two corners that the robot cannot reach.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax.envs import base, raster
from fleetjax.types import EnvState

HORIZON = 250  # pushes
CONTROL_STEP = 1.0  # s, for a push
IMAGE_SHAPE = (64, 64, 3)
PICTURE_SIZE = 256  # pixels, of what people see
BORDER = 0.1  # strip along the boundary that the cube must not touch
HALF_SIDE = 0.1  # of the cube
PUSH = 0.15  # way of a push that does not slip
SLIP = 0.3  # largest share of the way that is lost
DRIFT, TURN = 0.015, 0.06  # deviations, sideways and of the angle (rad), of a push
GOAL_RADIUS = 0.1  # within which the cube's centre has reached the goal
CORNER = 1.4  # x + y beyond which a corner is out of reach; the opposite one below -CORNER
START, ALLOWED, ALLOWED_CORNER = 0.3, 0.6, 1.1  # |x| and |y| of starts; |x|, |y| and |x + y| of goals
NEAREST_GOAL = 0.3  # from the cube
DIRECTIONS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], np.float32)  # of the cube's frame: right, up, left, down
MARGIN = 0.04  # that the teacher keeps from a violation
WORTHWHILE = 0.5  # of the best progress; pushes that give as much are as good for the teacher
WOOD, LOST, BLOCK, FACE, TARGET = (222, 196, 156), (205, 92, 80), (45, 90, 200), (90, 135, 230), (40, 150, 70)


class Table(NamedTuple):
    """What lies on the workspace.

    Attributes:
        position: f32[2] of the cube's centre.
        angle: f32[] of the cube (rad), in [-pi/4, pi/4): its faces look alike.
        goal: f32[2].
    """

    position: jax.Array
    angle: jax.Array
    goal: jax.Array


def make_env() -> base.Env:
    """Build the environment: 64 x 64 x 3 pixel values (0 to 255, row by row), four choices: push right, up, left, down."""
    size = int(np.prod(IMAGE_SHAPE))
    spec = base.EnvSpec(
        "block_push",
        size,
        len(DIRECTIONS),
        HORIZON,
        CONTROL_STEP,
        discrete=True,
        has_goal=True,
        supervisor="block_push",
        image_shape=IMAGE_SHAPE,
    )
    return base.Env(_reset, _step, spec, next_goal=_next_goal, picture=lambda state: draw(state.physics, PICTURE_SIZE))


def _reset(key: jax.Array, robot: jax.Array) -> EnvState:
    del robot  # every robot starts from the same distribution
    key_start, key_goal = jax.random.split(key)
    start = jax.random.uniform(key_start, (3,), minval=-1.0, maxval=1.0)
    position = START * start[:2]
    table = Table(position, jnp.pi / 4 * start[2], _draw_goal(key_goal, position))
    return base.begin(table, observe(table))


def _draw_goal(key: jax.Array, position: jax.Array) -> jax.Array:
    """Return a goal f32[2], uniform over what is reachable and not too near."""
    candidates = jax.random.uniform(key, (32, 2), minval=-ALLOWED, maxval=ALLOWED)
    reachable = jnp.abs(jnp.sum(candidates, axis=1)) < ALLOWED_CORNER
    fits = reachable & (jnp.linalg.norm(candidates - position, axis=1) >= NEAREST_GOAL)
    opposite = -0.5 * ALLOWED * jnp.sign(position)  # if none fits, which no run will see
    return jnp.where(jnp.any(fits), candidates[jnp.argmax(fits)], opposite)


def _next_goal(state: EnvState, key: jax.Array) -> EnvState:
    table = state.physics._replace(goal=_draw_goal(key, state.physics.position))
    return state._replace(physics=table, obs=observe(table))


def _step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
    del active
    key_slip, key_drift, key_turn = jax.random.split(key, 3)
    slip = jax.random.uniform(key_slip, maxval=SLIP)
    drift, turn = DRIFT * jax.random.normal(key_drift), TURN * jax.random.normal(key_turn)
    before = state.physics
    face = jnp.argmax(action)
    position = before.position + push_way(before.angle, face, (1 - slip) * PUSH, drift)
    angle = (before.angle + turn + jnp.pi / 4) % (jnp.pi / 2) - jnp.pi / 4
    table = Table(position, angle, before.goal)
    distance = jnp.linalg.norm(before.goal - position)
    return base.proceed(
        state,
        physics=table,
        obs=observe(table),
        reward=jnp.linalg.norm(before.goal - before.position) - distance,
        violation=is_lost(position, angle),
        success=distance < GOAL_RADIUS,
        horizon=HORIZON,
    )


def push_way(angle: jax.Array, face: jax.Array, along: jax.Array | float, sideways: jax.Array | float = 0.0) -> jax.Array:
    """Return by how much f32[2] a push of face i32[] moves a cube that is turned by `angle`."""
    x, y = jnp.asarray(DIRECTIONS)[face]
    local = jnp.stack([along * x - sideways * y, along * y + sideways * x])
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * local[0] - s * local[1], s * local[0] + c * local[1]])


def is_lost(position: jax.Array, angle: jax.Array | float, margin: float = 0.0) -> jax.Array:
    """Return bool[], whether a cube comes within `margin` of the boundary, or of the two corners out of reach."""
    reach = HALF_SIDE * (jnp.abs(jnp.cos(angle)) + jnp.abs(jnp.sin(angle)))
    at_boundary = jnp.max(jnp.abs(position)) + reach > 1.0 - BORDER - margin
    return at_boundary | (jnp.abs(position[0] + position[1]) > CORNER - margin)


def draw(table: Table, size: int) -> jax.Array:
    """Return the workspace from above u8[size, size, 3]: out of bounds (red), the cube (blue), the goal (green ring)."""
    points = raster.grid(size)
    border = -raster.box(points, jnp.zeros(2), jnp.full(2, 1.0 - BORDER))
    beyond = CORNER / np.sqrt(2) - jnp.abs(points[..., 0] + points[..., 1]) / np.sqrt(2)
    picture = raster.paint(raster.plain(size, WOOD), jnp.minimum(border, beyond), LOST)
    picture = raster.paint(picture, raster.box(points, table.position, jnp.full(2, HALF_SIDE), table.angle), BLOCK)
    picture = raster.paint(picture, raster.box(points, table.position, jnp.full(2, 0.6 * HALF_SIDE), table.angle), FACE)
    ring = jnp.abs(raster.disc(points, table.goal, 0.9 * GOAL_RADIUS)) - 0.25 * GOAL_RADIUS
    return raster.as_pixels(raster.paint(picture, ring, TARGET))


def observe(table: Table) -> jax.Array:
    """Return the observation f32[12288]: the image's pixel values, whole numbers from 0 to 255, row by row."""
    return draw(table, IMAGE_SHAPE[0]).astype(jnp.float32).ravel()


def good_pushes(table: Table) -> jax.Array:
    """Return bool[4], which pushes a teacher may choose: safe ones that bring the cube about as near as the best."""
    faces = jnp.arange(len(DIRECTIONS))

    def result(face: jax.Array) -> tuple[jax.Array, jax.Array]:
        landing = table.position + push_way(table.angle, face, (1 - SLIP / 2) * PUSH)
        farthest = table.position + push_way(table.angle, face, PUSH)
        progress = jnp.linalg.norm(table.goal - table.position) - jnp.linalg.norm(table.goal - landing)
        return progress, ~is_lost(farthest, jnp.pi / 4, MARGIN)

    progress, safe = jax.vmap(result)(faces)
    safe |= ~jnp.any(safe)
    best = jnp.max(jnp.where(safe, progress, -jnp.inf))
    return safe & (progress >= jnp.where(best > 0, WORTHWHILE * best, best))


def teach(state: EnvState, key: jax.Array) -> jax.Array:
    """Return one of the good pushes, one-hot f32[4], all equally likely."""
    logits = jnp.where(good_pushes(state.physics), 0.0, -jnp.inf)
    return jax.nn.one_hot(jax.random.categorical(key, logits), len(DIRECTIONS))
