"""A fleet that takes one timestep at a time, in two halves: `plan`, then people act, then `advance`.

The logic is `fleetjax.fleet`'s. What people gave comes in as plain arrays, so that a record of it repeats the same run.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax.config import Config
from fleetjax.console.controls import check_people
from fleetjax.envs import Env
from fleetjax.experiment import prepare
from fleetjax.fleet import FleetState, make_fleet, make_parts, supervise
from fleetjax.keys import key_at, split_keys
from fleetjax.metrics import Metrics
from fleetjax.types import EnvState, Plan, Signals

EMPTY, PERSON, SIMULATED = 0, 1, 2  # who sits in a seat


class Inputs(NamedTuple):
    """What the supervisors did at a timestep.

    Attributes:
        seat: u8[M] who sat there: `EMPTY`, `PERSON` or `SIMULATED`.
        given: bool[M] whether a person gave an action.
        action: f32[M, A] that action; 0 where there is none.
        confirmed: bool[M] whether a person confirmed the hard reset of the robot.
    """

    seat: np.ndarray
    given: np.ndarray
    action: np.ndarray
    confirmed: np.ndarray


class View(NamedTuple):
    """What is to be seen between the two halves of a timestep, in numpy arrays.

    Attributes:
        timestep: the timestep.
        robot: i32[M] whom each seat helps, -1 = nobody.
        duration: i32[M] timesteps of that help so far.
        resetting: bool[N] robots in violation that have a helper.
        violation: bool[N].
        uncertainty: f32[N].
        risk: f32[N].
        goal: f32[N].
        score: f32[N] priorities.
    """

    timestep: int
    robot: np.ndarray
    duration: np.ndarray
    resetting: np.ndarray
    violation: np.ndarray
    uncertainty: np.ndarray
    risk: np.ndarray
    goal: np.ndarray
    score: np.ndarray


def no_inputs(config: Config, action_size: int) -> Inputs:
    """Return the inputs of a timestep at which nobody is there."""
    nobody = np.zeros(config.num_humans, bool)
    return Inputs(nobody.astype(np.uint8), nobody, np.zeros((config.num_humans, action_size), np.float32), nobody)


class Programs(NamedTuple):
    """The compiled parts of a console.

    Attributes:
        prepare: `(Config, key) -> FleetState`.
        plan: `(Config, key of the run, FleetState, seat u8[M]) -> (priority's memory, Plan)`.
        advance: `(Config, key of the run, store, rest, Plan, Inputs) -> (FleetState, Metrics)`; see `_split`.
        draw: `(EnvState[N], robots i32[K]) -> u8[K, H, W, 3]`, by K.
    """

    prepare: Any
    plan: Any
    advance: Any
    draw: Mapping[int, Any]


def compile_programs(config: Config, env: Env, num_pictures: Sequence[int]) -> Programs:
    """Compile what a console needs; nothing is compiled later.

    Args:
        config: configuration; its traced fields are arguments of the programs.
        env: the environment.
        num_pictures: numbers of robots that are drawn at once.
    """
    key = jax.random.key(0)
    start, nothing = jax.eval_shape(prepare, config, key), no_inputs(config, env.spec.action_size)
    store, rest = _split(start)
    plan, advance = _halves(config, env)
    _, planned = jax.eval_shape(plan, config, key, start, nothing.seat)
    with ThreadPoolExecutor(2) as pool:
        preparing = pool.submit(lambda: jax.jit(prepare).lower(config, key).compile())
        planning = pool.submit(lambda: jax.jit(plan).lower(config, key, start, nothing.seat).compile())
        advancing = pool.submit(
            lambda: jax.jit(advance, donate_argnums=2).lower(config, key, store, rest, planned, nothing).compile()
        )
        drawing = pool.submit(lambda: {number: _compile_pictures(env, start, number) for number in num_pictures})
        return Programs(preparing.result(), planning.result(), advancing.result(), drawing.result())


def _compile_pictures(env: Env, start: FleetState, number: int) -> Any:
    draw = env.picture
    assert draw is not None
    program = jax.jit(lambda env, robots: jax.vmap(draw)(jax.tree.map(lambda x: x[robots], env)))
    return program.lower(start.env, np.zeros(number, np.int32)).compile()


class Engine:
    """A fleet of one run, compiled once, before its first timestep.

    Args:
        config: configuration, validated; without models of people and links.
        key: random key of the run.
        env: the environment.
        num_pictures: numbers of robots that `pictures` may be asked for.

    Attributes:
        state: FleetState at the start of the timestep.

    Raises:
        ValueError: if the configuration has such a model.
    """

    def __init__(self, config: Config, key: jax.Array, env: Env, *, num_pictures: Sequence[int] = ()):
        check_people(config)
        self.config = config
        pool = ThreadPoolExecutor(1)  # this thread only waits: an interrupt within JAX's own code could get lost
        try:
            self._programs = pool.submit(compile_programs, config, env, num_pictures).result()
            prepared = pool.submit(lambda: jax.block_until_ready(self._programs.prepare(config, key)))
            self.state: FleetState = prepared.result()
        finally:
            pool.shutdown(wait=False)
        self._key = key
        self._planned: Plan | None = None

    @property
    def timestep(self) -> int:
        """Timesteps completed."""
        return int(self.state.timestep)

    def plan(self, seat: np.ndarray) -> View:
        """Begin a timestep: say which human helps which robot.

        Args:
            seat: u8[M] who sits in each seat.
        """
        memory, planned = self._programs.plan(self.config, self._key, self.state, seat)
        self.state, self._planned = self.state._replace(priority=memory), planned
        plan = jax.device_get(planned._replace(robot_action=None, signals=Signals(*planned.signals[:5])))
        signals = plan.signals
        seen = (signals.violation, signals.uncertainty, signals.risk, signals.goal, plan.score)
        return View(self.timestep, plan.humans.robot, plan.humans.duration, plan.resetting, *seen)

    def advance(self, inputs: Inputs) -> Metrics:
        """Complete the timestep, with what the supervisors did; return its metrics in numpy arrays.

        Args:
            inputs: what they did, in the seats that the timestep began with.
        """
        store, rest = _split(self.state)
        self.state, metrics = self._programs.advance(self.config, self._key, store, rest, self._planned, inputs)
        self._planned = None
        return jax.device_get(metrics)

    def pictures(self, env: EnvState, robots: np.ndarray) -> np.ndarray:
        """Return u8[K, H, W, 3], what robots i32[K] look like in EnvState[N]; K is one of `num_pictures`."""
        return np.asarray(self._programs.draw[len(robots)](env, robots))


def _split(state: FleetState) -> tuple[Any, FleetState]:
    """Return what is large, whose memory a step takes over, and the rest."""
    return (state.human_data, state.estimators), state._replace(human_data=None, estimators=None)


def _halves(config: Config, env: Env) -> tuple[Any, Any]:
    """Return the two halves of a timestep as pure functions."""
    num_robots = config.num_robots

    def plan(config: Config, key: jax.Array, state: FleetState, seat: jax.Array) -> tuple[Any, Plan]:
        after, planned = make_fleet(config, env).plan(state, key_at(key, state.timestep), jnp.asarray(seat) != EMPTY)
        return after.priority, planned

    def advance(
        config: Config, key: jax.Array, store: Any, rest: FleetState, plan: Plan, inputs: Inputs
    ) -> tuple[FleetState, Metrics]:
        state = rest._replace(human_data=store[0], estimators=store[1])
        key_step = key_at(key, state.timestep)
        action = supervise(make_parts(config, env), state.env, split_keys(key_step, num_robots))
        simulated = jnp.asarray(inputs.seat) == SIMULATED
        place = jnp.where(plan.humans.robot >= 0, plan.humans.robot, num_robots)

        def by_robot(mask: jax.Array) -> jax.Array:
            return jnp.zeros(num_robots, bool).at[place].set(mask, mode="drop")

        theirs = jnp.where(inputs.given & ~simulated, place, num_robots)
        action = action.at[theirs].set(inputs.action, mode="drop")
        plan = plan._replace(resetting=plan.resetting & by_robot(simulated | inputs.confirmed))
        return make_fleet(config, env).advance(state, plan, action, by_robot(simulated | inputs.given), key_step)

    return plan, advance
