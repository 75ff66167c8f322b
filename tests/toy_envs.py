"""Small environments for tests: `scripted`, in which everything is known beforehand, and `grid`, with discrete actions.

The fixture `toy_supervisors` registers their supervisors.
"""

import jax
import jax.numpy as jnp

from fleetjax import supervisors
from fleetjax.envs import Env, EnvSpec, begin, proceed
from fleetjax.types import EnvState

NEVER, ALWAYS = 0, -1
BOARD = 5  # cells a side of the grid
MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1))  # cells, one for each discrete action


def scripted(falls_at, succeeds_at, *, horizon: int = 1000, new_goals: bool = False) -> Env:
    """Build an environment without chance: robot i falls, and succeeds, at known steps of every episode.

    Observation f32[3]: the robot i, steps since the reset, goals reached. One action; it does nothing but give the reward.

    Args:
        falls_at: i32[N] the episode step that violates the constraint, `NEVER` = none, `ALWAYS` = the first state does.
        succeeds_at: i32[N] the episode step, and all its multiples, that succeed, `NEVER` = none.
        horizon: control steps in an episode.
        new_goals: whether a success brings a new goal and the episode goes on.
    """
    falls_at, succeeds_at = jnp.asarray(falls_at), jnp.asarray(succeeds_at)

    def observe(physics) -> jax.Array:
        return jnp.stack([physics["robot"], physics["clock"], physics["goal"]]).astype(jnp.float32)

    def reset(key: jax.Array, robot: jax.Array) -> EnvState:
        del key
        physics = {"robot": robot.astype(jnp.int32), "clock": jnp.int32(0), "goal": jnp.int32(0)}
        return begin(physics, observe(physics))._replace(violation=falls_at[robot] == ALWAYS)

    def step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
        del active, key
        robot, clock = state.physics["robot"], state.physics["clock"] + 1
        physics = state.physics | {"clock": clock}
        due = succeeds_at[robot]
        return proceed(
            state,
            physics=physics,
            obs=observe(physics),
            reward=action[0],
            violation=clock == falls_at[robot],
            success=(due != NEVER) & (clock % jnp.maximum(due, 1) == 0),
            horizon=horizon,
        )

    def next_goal(state: EnvState, key: jax.Array) -> EnvState:
        del key
        physics = state.physics | {"goal": state.physics["goal"] + 1}
        return state._replace(physics=physics, obs=observe(physics))

    spec = EnvSpec("scripted", 3, 1, horizon, 1.0, has_goal=True, supervisor="toy_scripted")
    return Env(reset, step, spec, next_goal if new_goals else None)


def grid(*, horizon: int = 20) -> Env:
    """Build a board with four pushes as discrete actions: reach the goal, stay on the board.

    Observation f32[4]: cell and goal, from -1 to 1. Actions are one-hot f32[4], see `MOVES`. Every robot starts
    in a random cell with another one as its goal; leaving the board is a violation.
    """

    def observe(physics: jax.Array) -> jax.Array:
        return physics.astype(jnp.float32) * (2 / (BOARD - 1)) - 1

    def reset(key: jax.Array, robot: jax.Array) -> EnvState:
        del robot
        cell, goal = jax.random.choice(key, BOARD**2, (2,), replace=False)
        physics = jnp.stack([cell // BOARD, cell % BOARD, goal // BOARD, goal % BOARD])
        return begin(physics, observe(physics))

    def step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
        del active, key
        cell, goal = state.physics[:2] + jnp.array(MOVES)[jnp.argmax(action)], state.physics[2:]
        physics = jnp.concatenate([cell, goal])
        success = jnp.all(cell == goal)
        return proceed(
            state,
            physics=physics,
            obs=observe(physics),
            reward=success.astype(jnp.float32),
            violation=jnp.any((cell < 0) | (cell >= BOARD)),
            success=success,
            horizon=horizon,
        )

    spec = EnvSpec("grid", 4, 4, horizon, 1.0, discrete=True, has_goal=True, supervisor="toy_grid")
    return Env(reset, step, spec)


def teach_scripted(state: EnvState) -> jax.Array:
    """Return the supervisor's action f32[1]: always 1."""
    del state
    return jnp.ones(1)


def teach_grid(state: EnvState) -> jax.Array:
    """Return the supervisor's push f32[4]: along the first axis until the goal's row is reached, then along the second."""
    way = state.physics[2:] - state.physics[:2]
    first, second = jnp.where(way[0] > 0, 0, 1), jnp.where(way[1] > 0, 2, 3)
    return jax.nn.one_hot(jnp.where(way[0] != 0, first, second), 4)


def register_supervisors() -> None:
    """Register the supervisors `toy_scripted` and `toy_grid`."""
    for name, teach in {"toy_scripted": teach_scripted, "toy_grid": teach_grid}.items():
        supervisors.register_supervisor(name, lambda env, teach=teach: supervisors.Supervisor(lambda state, key: teach(state)))
