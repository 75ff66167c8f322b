"""Count physics steps a second of each robot and backend, beside raw `mujoco.rollout` of the same states in one process.

    python benchmarks/physics.py [ENVIRONMENT ...] [--num-robots 100 1000] [--largest-mjx 100] [--repeats 5]

The robots act on noise for a second before; then all take the same step again and again. A physics step is a substep.
"""

import argparse
import statistics
from typing import Any

import jax
import jax.numpy as jnp
from common import REGISTERED, RawRollout, body_of, same_again, seconds, table

import fleetjax
from fleetjax.io import scripts
from fleetjax.physics.base import make_physics


def warm_up(environment: str, num_robots: int) -> tuple[Any, jax.Array]:
    """Return states PhysicsState[N] and actions f32[N, A] of robots that have moved for a second."""
    env = fleetjax.envs.make(environment, "native")

    def step(state, key):
        key_noise, key_env = jax.random.split(key)
        noise = 0.1 * jax.random.normal(key_noise, (num_robots, env.spec.action_size))
        action = jnp.clip(same_again(env, state.obs) + noise, -1.0, 1.0)
        return jax.vmap(env.step)(state, action, jnp.ones(num_robots, bool), jax.random.split(key_env, num_robots)), None

    start = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), num_robots), jnp.arange(num_robots))
    keys = jax.random.split(jax.random.key(1), round(1 / env.spec.control_step))
    state, _ = jax.jit(lambda s: jax.lax.scan(step, s, keys))(start)
    return body_of(state.physics), state.obs[:, -env.spec.action_size :]


def measure(environment: str, num_robots: int, *, backends: list[str], repeats: int) -> list[dict[str, str]]:
    """Return a row of the table for raw rollout and each backend."""
    body, action = warm_up(environment, num_robots)
    raw = RawRollout(environment)
    control = raw.control(action, raw.model)
    active = jnp.ones(num_robots, bool)
    steps = {b: jax.jit(jax.vmap(make_physics(f"{environment}.xml", substeps=raw.substeps, backend=b).step)) for b in backends}
    times: dict[str, list[float]] = {name: [] for name in ("raw rollout", *backends)}
    for step in steps.values():
        jax.block_until_ready(step(body, control, active))
    for _ in range(repeats):
        times["raw rollout"].append(raw.seconds(body, action, calls=10))
        for name, step in steps.items():
            calls = 10 if name == "native" else 1
            times[name].append(sum(seconds(step, body, control, active)[0] for _ in range(calls)) / calls)
    median = {name: statistics.median(found) for name, found in times.items()}
    return [
        {
            "environment": environment,
            "N": str(num_robots),
            "by": name,
            "physics steps/s": f"{num_robots * raw.substeps / time:,.0f}",
            "ratio to raw": f"{median['raw rollout'] / time:.2f}",
        }
        for name, time in median.items()
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", REGISTERED)
    parser.add_argument("--num-robots", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--largest-mjx", type=int, default=100, help="largest batch on mjx (more wants a GPU)")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    rows = []
    for environment in args.environments:
        for n in args.num_robots:
            backends = ["native", "mjx"] if n <= args.largest_mjx else ["native"]
            rows += measure(environment, n, backends=backends, repeats=args.repeats)
    print(table(rows))


if __name__ == "__main__":
    main()
