"""What the benchmarks share: a fleet that can be timed in stretches, and the machine's rate for a large matrix product."""

import itertools
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

import fleetjax
from fleetjax.envs import allegro_hand, anymal, humanoid
from fleetjax.physics.base import MODELS, PhysicsState
from fleetjax.physics.native import num_threads

# Substeps of a control step, and `(end of the observation, model) -> controls`: what the servos or motors were last told.
ROBOTS: dict[str, tuple[int, Callable[[jax.Array, mujoco.MjModel], jax.Array]]] = {
    "humanoid": (humanoid.SUBSTEPS, lambda action, model: action),
    "anymal": (anymal.SUBSTEPS, lambda action, model: anymal.targets(action)),
    "allegro_hand": (
        allegro_hand.SUBSTEPS,
        lambda target, model: allegro_hand.angles(target, *jnp.float32(model.jnt_range[:16].T)),
    ),
}


REGISTERED = [name for name in ROBOTS if name in fleetjax.list_envs()]


def seconds(function: Callable[..., Any], *args: Any) -> tuple[float, Any]:
    """Run once; return the wall-clock seconds until the result is there, and the result."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*args))
    return time.perf_counter() - start, result


def median_seconds(function: Callable[..., Any], *args: Any, repeats: int = 5) -> float:
    """Return the median seconds of `repeats` runs, after one that compiles."""
    jax.block_until_ready(function(*args))
    return statistics.median(seconds(function, *args)[0] for _ in range(repeats))


def same_again(env: fleetjax.Env, obs: jax.Array) -> jax.Array:
    """Return actions f32[N, A] that repeat the last controls, given observations f32[N, O], which end with them."""
    last = obs[:, -env.spec.action_size :]
    return jnp.zeros_like(last) if env.spec.name == "allegro_hand" else last  # the hand's actions change its targets


def body_of(physics: Any) -> PhysicsState:
    """Return what the physics backends step, out of an environment's own state."""
    return physics if isinstance(physics, PhysicsState) else physics.body


class RawRollout:
    """One control step of many robots by MuJoCo alone, with the library's threads and substeps."""

    def __init__(self, environment: str):
        self.substeps, self.control = ROBOTS[environment]
        self.model = mujoco.MjModel.from_xml_path(str(MODELS / f"{environment}.xml"))
        self.model.vis.global_.bvactive = 0
        self.data = [mujoco.MjData(self.model) for _ in range(num_threads())]
        self.pool = rollout.Rollout(nthread=num_threads())

    def seconds(self, body: PhysicsState, action: jax.Array, *, calls: int = 50) -> float:
        """Return seconds for the control step of these robots, the mean of several calls.

        Args:
            body: states of the robots, PhysicsState[N].
            action: f32[N, A].
            calls: how often the same step is taken.
        """
        control = np.asarray(self.control(action, self.model), np.float64)[:, None].repeat(self.substeps, axis=1)
        state = jax.tree.map(lambda x: np.asarray(x, np.float64), body)
        start = np.concatenate([state.time[:, None], state.qpos, state.qvel], axis=1)
        begin = time.perf_counter()
        for _ in range(calls):
            self.pool.rollout(self.model, self.data, start, control, initial_warmstart=state.warmstart)
        return (time.perf_counter() - begin) / calls


def quick_config(environment: str, algorithm: str = "cur", **overrides: Any) -> fleetjax.Config:
    """Return a configuration whose fleet starts almost untrained: a timestep costs the same, the start is short."""
    short = {
        "num_demonstrations": 256,
        "pretraining_steps": 1,
        "critic_pretraining_steps": 1,
        "num_critic_transitions": 200,
        "initial_period": 0,
    }
    return fleetjax.make_config(environment, algorithm, **short | overrides)


def stretch(config: fleetjax.Config, num_steps: int) -> Callable[..., Any]:
    """Return a compiled `(key, state) -> Result` of `num_steps` timesteps that gives the state's memory away."""
    part = config.replace(num_steps=num_steps)
    return jax.jit(lambda key, state: fleetjax.run(part, key, state), donate_argnums=1)


def step_milliseconds(config: fleetjax.Config, *, num_steps: int = 50, repeats: int = 3) -> float:
    """Return the median milliseconds of a timestep of a fresh fleet."""
    key = jax.random.key(0)
    run = stretch(config, num_steps)
    state = run(key, jax.jit(fleetjax.prepare)(config, key)).state
    times = []
    for _ in range(repeats):
        elapsed, result = seconds(run, key, state)
        state = result.state
        times.append(elapsed / num_steps * 1e3)
    return statistics.median(times)


def matrix_rate(size: int = 1024, products: int = 10) -> Callable[[], float]:
    """Return a function that measures f32 operations a second in a large matrix product."""
    a = jax.random.normal(jax.random.key(0), (size, size)) / size**0.5
    multiply = jax.jit(lambda x: jax.lax.scan(lambda y, _: (y @ a, None), x, length=products)[0])
    jax.block_until_ready(multiply(a))
    return lambda: 2 * size**3 * products / seconds(multiply, a)[0]


class Product(NamedTuple):
    """A matrix product f32[rows, inner] @ f32[inner, columns], `batch` times."""

    batch: int
    rows: int
    inner: int
    columns: int

    @property
    def operations(self) -> int:
        """Multiplications and additions."""
        return 2 * self.batch * self.rows * self.inner * self.columns


def gradient_step_products(config: fleetjax.Config, spec: fleetjax.EnvSpec) -> list[Product]:
    """Return the matrix products that a C.U.R. gradient step cannot do without.

    A dense layer costs one product forwards, one for the gradient of its weights, and one for that of its inputs, which the
    first layer does not need.
    """
    policy = list(itertools.pairwise([spec.observation_size, *config.hidden_sizes, spec.action_size]))
    critic = list(itertools.pairwise([spec.observation_size + spec.action_size, *config.hidden_sizes, 1]))
    members, twins, samples = config.ensemble_size, 2, config.batch_size

    def forward(batch: int, layers: list[tuple[int, int]]) -> list[Product]:
        return [Product(batch, samples, i, o) for i, o in layers]

    def gradient(batch: int, layers: list[tuple[int, int]]) -> list[Product]:
        weights = [Product(batch, i, samples, o) for i, o in layers]
        return forward(batch, layers) + weights + [Product(batch, samples, o, i) for i, o in layers[1:]]

    imitation = gradient(members, policy)
    safety = forward(members, policy) + forward(twins, critic) + gradient(twins, critic)
    return (imitation + safety) * config.gradient_steps


def product_timer(product: Product, repeats: int = 20) -> Callable[[], float]:
    """Return a function that measures the seconds of a product, in a batch or one by one, whichever is faster."""
    key_left, key_right = jax.random.split(jax.random.key(0))
    left = jax.random.normal(key_left, (product.batch, product.rows, product.inner))
    right = jax.random.normal(key_right, (product.batch, product.inner, product.columns))

    def again(multiply: Callable[[jax.Array, jax.Array], jax.Array]) -> Callable[[], float]:
        def body(total: jax.Array, _: None) -> tuple[jax.Array, None]:
            operands, total = jax.lax.optimization_barrier(((left, right), total))  # else XLA would multiply only once
            return total + jax.lax.optimization_barrier(multiply(*operands))[0, 0, 0], None

        program = jax.jit(lambda: jax.lax.scan(body, jnp.float32(0), length=repeats)[0])
        jax.block_until_ready(program())
        return lambda: seconds(program)[0] / repeats

    timers = again(jnp.matmul), again(lambda a, b: jax.lax.map(lambda pair: pair[0] @ pair[1], (a, b)))
    return lambda: min(timer() for timer in timers)


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows of equal keys as an aligned Markdown table."""
    names = list(rows[0])
    cells = [names, *[[str(row[name]) for name in names] for row in rows]]
    widths = [max(len(line[i]) for line in cells) for i in range(len(names))]
    lines = ["| " + " | ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in cells]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 1) + ":" for width in widths) + "|", *lines[1:]])


def print_last(rows: list[dict[str, Any]]) -> None:
    """Print the last row of a table that grows, and before the first its header."""
    print(table(rows) if len(rows) == 1 else table(rows).splitlines()[-1], flush=True)
