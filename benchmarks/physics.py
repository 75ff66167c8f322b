"""Count physics steps a second of each robot and backend, beside raw MuJoCo of the same states in one process.

    python benchmarks/physics.py [ENVIRONMENT ...] [--num-robots 100 1000] [--backends native mjx warp] [--repeats 5]

On a CPU, "raw" is `mujoco.rollout`; on a GPU it is `mjx.step`, and `mjx.step` of MuJoCo Warp where that is installed. Without
`--num-robots`, a CPU steps 100 and 1,000 robots (`mjx` only 100), a GPU 100 to 65,536. The robots act on noise for a second
before; then all take the same step again and again. A physics step is a substep.
"""

import argparse
import importlib.util
import statistics
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from common import REGISTERED, RawRollout, body_of, same_again, seconds, table

import fleetjax
from fleetjax.io import scripts
from fleetjax.physics import warp
from fleetjax.physics.base import BACKENDS, PhysicsState, make_physics

LARGEST_MJX = 100  # robots that MJX steps on a CPU in a bearable time


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


def raw_mjx(model: mujoco.MjModel, substeps: int, num_robots: int, impl: str) -> Any:
    """Return `(PhysicsState[N], controls) -> qpos`: MJX alone, with whole `mjx.Data` and nothing checked."""
    from mujoco import mjx

    room = {"naconmax": warp.CONTACTS * num_robots, "njmax": warp.CONSTRAINTS} if impl == "warp" else {}
    device_model, template = mjx.put_model(model, impl=impl), mjx.make_data(model, impl=impl, **room)

    def step(body: PhysicsState, control: jax.Array, active: jax.Array) -> jax.Array:
        del active
        data = template.replace(qpos=body.qpos, qvel=body.qvel, qacc_warmstart=body.warmstart, time=body.time, ctrl=control)
        return jax.lax.fori_loop(0, substeps, lambda _, d: mjx.step(device_model, d), data).qpos

    return jax.jit(jax.vmap(step))


def measure(environment: str, num_robots: int, *, backends: list[str], repeats: int) -> list[dict[str, str]]:
    """Return a row of the table for each raw engine and each backend."""
    body, action = warm_up(environment, num_robots)
    raw = RawRollout(environment)
    control = raw.control(action, raw.model)
    active = jnp.ones(num_robots, bool)
    steps = {b: jax.jit(jax.vmap(make_physics(f"{environment}.xml", substeps=raw.substeps, backend=b).step)) for b in backends}
    if on_gpu():
        impls = {"raw mjx": "jax"} | ({"raw warp": "warp"} if "warp" in backends else {})
        steps = {name: raw_mjx(raw.model, raw.substeps, num_robots, impl) for name, impl in impls.items()} | steps
    times: dict[str, list[float]] = {name: [] for name in ([] if on_gpu() else ["raw rollout"]) + list(steps)}
    for step in steps.values():
        jax.block_until_ready(step(body, control, active))
    for _ in range(repeats):
        for name in times:
            if name == "raw rollout":
                times[name].append(raw.seconds(body, action, calls=10))
                continue
            calls = 1 if name == "mjx" and not on_gpu() else 10
            times[name].append(sum(seconds(steps[name], body, control, active)[0] for _ in range(calls)) / calls)
    median = {name: statistics.median(found) for name, found in times.items()}
    first = next(iter(median))
    return [
        {
            "environment": environment,
            "N": str(num_robots),
            "by": name,
            "physics steps/s": f"{num_robots * raw.substeps / time:,.0f}",
            f"ratio to {first}": f"{median[first] / time:.2f}",
        }
        for name, time in median.items()
    ]


def on_gpu() -> bool:
    """Return whether JAX computes on a GPU."""
    return jax.default_backend() == "gpu"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", REGISTERED)
    parser.add_argument("--num-robots", type=int, nargs="+", help="sizes of the fleet")
    parser.add_argument("--backends", nargs="+", choices=BACKENDS[1:], help="[default: native and mjx; on a GPU mjx and warp]")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    installed = ["warp"] if importlib.util.find_spec("warp") else []
    usual = ["mjx", *installed] if on_gpu() else ["native", "mjx"]
    sizes = args.num_robots or ([100, 1000, 4096, 16_384, 65_536] if on_gpu() else [100, 1000])
    rows = []
    for environment in args.environments:
        for n in sizes:
            backends = args.backends or [b for b in usual if on_gpu() or b == "native" or n <= LARGEST_MJX]
            rows += measure(environment, n, backends=backends, repeats=args.repeats)
    print(table(rows))


if __name__ == "__main__":
    main()
