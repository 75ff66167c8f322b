"""Time a C.U.R. timestep of each robot at the paper's scale beside what it cannot do without, in one process.

    python benchmarks/fleet_step.py [ENVIRONMENT ...] [--steps 200] [--repeats 7] [-- PARAMETERS]

What follows `--` are parameters as `fleetjax run` takes them, in place of the paper's: `-- --num-robots 1000`.

The bound is raw `mujoco.rollout` for the robots that move, from the same states with the same substeps and threads, plus
the gradient steps' matrix products, each timed by itself at its own size. The lower bound takes the same products at the
rate of one of 1024^3, which none of them reaches. The environment's step, compiled by itself, tells physics' share of the
time. All are measured in turn, the medians count.
"""

import argparse
import statistics
from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    REGISTERED,
    RawRollout,
    body_of,
    gradient_step_products,
    matrix_rate,
    product_timer,
    same_again,
    seconds,
    stretch,
    table,
)

import fleetjax
from fleetjax.io import scripts


def measure(environment: str, parameters: dict[str, Any], *, num_steps: int, repeats: int) -> dict[str, str]:
    """Return a row of the table."""
    # No initial period: in it robots in violation lie still, and few would move.
    config = fleetjax.make_config(environment, "cur", **{"initial_period": 0} | parameters, backend="native")
    env = fleetjax.envs.make(environment, "native")
    key = jax.random.key(0)
    run = stretch(config, num_steps)
    state = run(key, jax.jit(fleetjax.prepare)(config, key)).state
    raw, rate = RawRollout(environment), matrix_rate()
    products = Counter(gradient_step_products(config, env.spec))
    operations = sum(number * product.operations for product, number in products.items())
    timers = {product: product_timer(product) for product in products}
    keys = jax.random.split(key, config.num_robots)
    physics_step = jax.jit(lambda s: jax.vmap(env.step)(s, same_again(env, s.obs), ~s.violation, keys))
    jax.block_until_ready(physics_step(state.env))

    steps, bounds, physics, learning, large, moving = [], [], [], [], [], []
    for _ in range(repeats):
        rows = np.flatnonzero(~np.asarray(state.env.violation))
        standing = jax.tree.map(lambda x, rows=rows: x[rows], state.env)
        bound = raw.seconds(body_of(standing.physics), standing.obs[:, -env.spec.action_size :]) / rows.size
        alone = statistics.median(seconds(physics_step, state.env)[0] for _ in range(20)) / rows.size
        elapsed, result = seconds(run, key, state)
        state = result.state
        moving.append(float(jnp.mean(result.metrics.moving)))
        steps.append(elapsed / num_steps)
        bounds.append(bound * moving[-1])
        physics.append(alone * moving[-1])
        learning.append(sum(number * timers[product]() for product, number in products.items()))
        large.append(operations / rate())
    step, bound, own, learnt, least = (statistics.median(x) for x in (steps, bounds, physics, learning, large))
    return {
        "environment": environment,
        "moving": f"{100 * statistics.median(moving) / config.num_robots:.0f} %",
        "timestep ms": f"{1e3 * step:.1f}",
        "physics ms": f"{1e3 * own:.1f}",
        "physics share": f"{100 * own / step:.0f} %",
        "raw rollout ms": f"{1e3 * bound:.1f}",
        "products ms": f"{1e3 * learnt:.1f}",
        "at 1024^3 ms": f"{1e3 * least:.1f}",
        "ratio to bound": f"{step / (bound + learnt):.2f}",
        "to the lower bound": f"{step / (bound + least):.2f}",
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", REGISTERED)
    parser.add_argument("--steps", type=int, default=200, help="timesteps in a timed stretch")
    parser.add_argument("--repeats", type=int, default=7, help="timed stretches")
    args, parameters = scripts.parse(parser)
    print(table([measure(name, parameters, num_steps=args.steps, repeats=args.repeats) for name in args.environments]))


if __name__ == "__main__":
    main()
