"""Navigation: a point robot drives through three rooms to a goal; walls are violations. Pure JAX.

The workspace is the square [-1, 1]^2 (m). Two walls with a doorway each, one high and one low, cut it into three rooms.
The robot sets its acceleration, keeps some of its speed, and is pushed about by noise. A goal that is
reached ends the episode.
"""

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax.envs import base, raster
from fleetjax.types import EnvState

HORIZON = 250
CONTROL_STEP = 0.1  # s
TOP_SPEED = 0.5  # m/s, reached when the full action is held
INERTIA = 0.95  # share of the velocity that one control step keeps
TEACHER_GAIN = 1.5  # 1/s, wanted speed for each metre to go
NOISE = 0.01  # m/s, deviation of the push in one control step
GOAL_RADIUS = 0.08  # m
WALLS_X = np.array([-1 / 3, 1 / 3], np.float32)  # m, where the walls stand
DOORS_Y = np.array([0.5, -0.5], np.float32)  # m, centres of their doorways
DOOR_WIDTH = 0.36  # m
WALL_THICKNESS = 0.06  # m
MARGIN = 0.12  # m, between a start or a goal and the nearest wall
ROBOT_RADIUS, PICTURE_SIZE = 0.05, 192  # m and pixels, in pictures only: the robot is a point
# Their colours: red, green, blue.
FLOOR, WALL, GOAL, ROBOT, STUCK = (238, 236, 230), (70, 74, 84), (96, 180, 110), (40, 90, 200), (210, 50, 40)


def make_env() -> base.Env:
    """Build the navigation environment: 8 observations (position, velocity, goal, way to the goal), 2 actions."""
    spec = base.EnvSpec("navigation", 8, 2, HORIZON, CONTROL_STEP, has_goal=True, supervisor="navigation")
    return base.Env(_reset, _step, spec, picture=draw, success_margin=_success_margin)


def _reset(key: jax.Array, robot: jax.Array) -> EnvState:
    del robot  # every robot starts from the same distribution
    draw = jax.random.uniform(key, (6,))
    start_room = jnp.floor(3 * draw[0])
    goal_room = (start_room + 1 + jnp.floor(2 * draw[1])) % 3  # another one
    position, goal = _place(draw[2:4], start_room), _place(draw[4:6], goal_room)
    physics = jnp.concatenate([position, jnp.zeros(2), goal])
    return base.begin(physics, _observe(physics))


def _place(draw: jax.Array, room: jax.Array) -> jax.Array:
    """Return the point f32[2] of room 0, 1 or 2, away from its walls, that `draw` f32[2] in [0, 1) stands for."""
    half = jnp.array([1 / 3 - MARGIN, 1 - MARGIN])
    centre = jnp.stack([(room - 1) * 2 / 3, jnp.zeros(())])
    return centre + (2 * draw - 1) * half


def _observe(physics: jax.Array) -> jax.Array:
    position, velocity, goal = physics[:2], physics[2:4], physics[4:]
    return jnp.concatenate([position, velocity / TOP_SPEED, goal, goal - position])


def _step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
    del active
    position, velocity, goal = state.physics[:2], state.physics[2:4], state.physics[4:]
    action = jnp.clip(action, -1.0, 1.0)
    velocity = INERTIA * velocity + (1 - INERTIA) * TOP_SPEED * action + NOISE * jax.random.normal(key, (2,))
    moved = position + CONTROL_STEP * velocity
    distance = jnp.linalg.norm(goal - moved)
    physics = jnp.concatenate([moved, velocity, goal])
    return base.proceed(
        state,
        physics=physics,
        obs=_observe(physics),
        reward=jnp.linalg.norm(goal - position) - distance,
        violation=hits_wall(moved),
        success=distance < GOAL_RADIUS,
        horizon=HORIZON,
    )


def _success_margin(state: EnvState) -> jax.Array:
    """Return how far the robot is within the goal's radius, in radii."""
    return 1.0 - jnp.linalg.norm(state.physics[4:] - state.physics[:2]) / GOAL_RADIUS


def hits_wall(position: jax.Array) -> jax.Array:
    """Return bool[], whether a position f32[2] lies in a wall or outside the square."""
    x, y = position
    in_wall = jnp.abs(x - WALLS_X) < WALL_THICKNESS / 2
    in_door = jnp.abs(y - DOORS_Y) < DOOR_WIDTH / 2
    return jnp.any(in_wall & ~in_door) | jnp.any(jnp.abs(position) > 1.0)


def draw(state: EnvState) -> jax.Array:
    """Return the rooms from above u8[192, 192, 3]: walls, the goal (green), the robot (blue, red in violation)."""
    position, velocity, goal = state.physics[:2], state.physics[2:4], state.physics[4:]
    points = raster.grid(PICTURE_SIZE)
    picture = raster.plain(PICTURE_SIZE, FLOOR)
    for wall, door in zip(WALLS_X, DOORS_Y, strict=True):
        for low, high in ((-1.0, door - DOOR_WIDTH / 2), (door + DOOR_WIDTH / 2, 1.0)):
            half = jnp.array([WALL_THICKNESS, high - low]) / 2
            picture = raster.paint(picture, raster.box(points, jnp.array([wall, (low + high) / 2]), half), WALL)
    picture = raster.paint(picture, raster.disc(points, goal, GOAL_RADIUS), GOAL)
    robot, ahead = raster.disc(points, position, ROBOT_RADIUS), position + 0.15 * velocity / TOP_SPEED
    picture = raster.paint(picture, raster.disc(points, ahead, 0.4 * ROBOT_RADIUS), ROBOT, opacity=0.6)
    colour = jnp.where(state.violation, jnp.array(STUCK), jnp.array(ROBOT))
    return raster.as_pixels(raster.paint(picture, robot, colour))


def teach(state: EnvState) -> jax.Array:
    """Return the teacher's action f32[2]: straight to the goal in its room, else in front of the next door, then through it."""
    position, velocity, goal = state.physics[:2], state.physics[2:4], state.physics[4:]
    room, goal_room = jnp.sum(position[0] > WALLS_X), jnp.sum(goal[0] > WALLS_X)
    side = jnp.sign(goal_room - room).astype(jnp.float32)  # -1 left, 0 here, 1 right
    door = jnp.clip(jnp.where(side > 0, room, room - 1), 0, 1)
    threshold = jnp.stack([jnp.asarray(WALLS_X)[door], jnp.asarray(DOORS_Y)[door]])
    before = threshold - jnp.array([0.12, 0.0]) * side
    beyond = threshold + jnp.array([0.12, 0.0]) * side
    aligned = jnp.abs(position[1] - threshold[1]) < 0.25 * DOOR_WIDTH
    target = jnp.where(side == 0, goal, jnp.where(aligned, beyond, before))
    in_doorway = jnp.abs(position[0] - jnp.asarray(WALLS_X)) < 0.1
    target = jnp.where((side == 0) & jnp.any(in_doorway), _clear_of_doorway(position, target, in_doorway), target)
    wanted = TEACHER_GAIN * (target - position)
    wanted /= jnp.maximum(jnp.linalg.norm(wanted) / (0.8 * TOP_SPEED), 1.0)
    return jnp.clip((2 * wanted - velocity) / TOP_SPEED, -1.0, 1.0)


def _clear_of_doorway(position: jax.Array, target: jax.Array, in_doorway: jax.Array) -> jax.Array:
    """Return where to go from a doorway: straight out of it, on the side of `target`."""
    door = jnp.argmax(in_doorway)
    wall, height = jnp.asarray(WALLS_X)[door], jnp.asarray(DOORS_Y)[door]
    return jnp.stack([wall + 0.2 * jnp.sign(target[0] - wall), height])
