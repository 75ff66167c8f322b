"""Time a C.U.R. timestep of each robot at the paper's scale beside what it cannot do without, in one process.

    python benchmarks/fleet_step.py [ENVIRONMENT ...] [--steps 200] [--repeats 7] [-- PARAMETERS]

What follows `--` are parameters as `fleetjax run` takes them, in place of the paper's: `-- --num-robots 1000`.

The bound is raw `mujoco.rollout` for the robots that move, from the same states with the same substeps and threads, plus
the gradient steps' operations at the rate of a large matrix product. The environment's step, compiled by itself, tells
physics' share of the time. All are measured in turn, the medians count.
"""

import argparse
import statistics
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    REGISTERED,
    RawRollout,
    add_names,
    body_of,
    gradient_step_operations,
    matrix_rate,
    parse,
    seconds,
    stretch,
    table,
)

import fleetjax


def measure(environment: str, parameters: dict[str, Any], *, num_steps: int, repeats: int) -> dict[str, str]:
    """Return a row of the table."""
    # No initial period: in it robots in violation lie still, and few would move.
    config = fleetjax.make_config(environment, "cur", **{"initial_period": 0} | parameters, backend="native")
    env = fleetjax.envs.make(environment, "native")
    key = jax.random.key(0)
    run = stretch(config, num_steps)
    state = run(key, jax.jit(fleetjax.prepare)(config, key)).state
    raw, rate = RawRollout(environment), matrix_rate()
    operations = gradient_step_operations(config, env.spec)
    keys = jax.random.split(key, config.num_robots)
    physics_step = jax.jit(lambda s: jax.vmap(env.step)(s, s.obs[:, -env.spec.action_size :], ~s.violation, keys))
    jax.block_until_ready(physics_step(state.env))

    steps, bounds, physics, rates, moving = [], [], [], [], []
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
        rates.append(rate())
    step, bound, own, speed = (statistics.median(x) for x in (steps, bounds, physics, rates))
    learning = operations / speed
    return {
        "environment": environment,
        "moving": f"{100 * statistics.median(moving) / config.num_robots:.0f} %",
        "timestep ms": f"{1e3 * step:.1f}",
        "physics ms": f"{1e3 * own:.1f}",
        "physics share": f"{100 * own / step:.0f} %",
        "raw rollout ms": f"{1e3 * bound:.1f}",
        "gradient bound ms": f"{1e3 * learning:.1f}",
        "GFLOP/s": f"{speed / 1e9:.0f}",
        "ratio to bounds": f"{step / (bound + learning):.2f}",
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_names(parser, "environments", REGISTERED)
    parser.add_argument("--steps", type=int, default=200, help="timesteps in a timed stretch")
    parser.add_argument("--repeats", type=int, default=7, help="timed stretches")
    args, parameters = parse(parser)
    print(table([measure(name, parameters, num_steps=args.steps, repeats=args.repeats) for name in args.environments]))


if __name__ == "__main__":
    main()
