"""Time a C.U.R. timestep on Humanoid at the paper's scale beside what it cannot do without, in one process.

    python benchmarks/fleet_step.py [--steps 200] [--repeats 7]

The bound is raw `mujoco.rollout` for the robots that move, from the same states with the same substeps and threads, plus
the gradient steps' operations at the rate of a large matrix product. All three are measured in turn, the medians count.
"""

import argparse
import statistics
import time

import jax
import mujoco
import numpy as np
from common import gradient_step_operations, matrix_rate, seconds, stretch
from mujoco import rollout

import fleetjax
from fleetjax.envs import humanoid
from fleetjax.physics.base import MODELS
from fleetjax.physics.native import num_threads


def raw_rollout(state: fleetjax.FleetState, *, calls: int = 50):
    """Return seconds of one control step of the moving robots by MuJoCo alone, and their number."""
    model = mujoco.MjModel.from_xml_path(str(MODELS / "humanoid.xml"))
    model.vis.global_.bvactive = 0
    rows = np.flatnonzero(~np.asarray(state.env.violation))
    body = jax.tree.map(lambda x: np.asarray(x, np.float64)[rows], state.env.physics)
    start = np.concatenate([body.time[:, None], body.qpos, body.qvel], axis=1)
    action = np.asarray(state.env.obs, np.float64)[rows, -model.nu :]
    control = np.repeat(action[:, None], humanoid.SUBSTEPS, axis=1)
    data = [mujoco.MjData(model) for _ in range(num_threads())]
    with rollout.Rollout(nthread=num_threads()) as pool:
        begin = time.perf_counter()
        for _ in range(calls):
            pool.rollout(model, data, start, control, initial_warmstart=body.warmstart)
        return (time.perf_counter() - begin) / calls, rows.size


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200, help="timesteps in a timed stretch")
    parser.add_argument("--repeats", type=int, default=7, help="timed stretches")
    args = parser.parse_args()

    # No initial period: in it robots in violation lie still, and few would move.
    config = fleetjax.make_config("humanoid", "cur", initial_period=0, backend="native")
    key = jax.random.key(0)
    run = stretch(config, args.steps)
    state = jax.jit(fleetjax.prepare)(config, key)
    state = run(key, state).state
    rate = matrix_rate()
    operations = gradient_step_operations(config, fleetjax.envs.make("humanoid", "native").spec)

    steps, physics, rates, moving = [], [], [], []
    for _ in range(args.repeats):
        before, robots_before = raw_rollout(state)
        elapsed, result = seconds(run, key, state)
        state = result.state
        after, robots_after = raw_rollout(state)
        share = float(result.metrics.moving.mean())
        steps.append(elapsed / args.steps)
        physics.append((before / robots_before + after / robots_after) / 2 * share)
        rates.append(rate())
        moving.append(share / config.num_robots)
    step, raw, speed = (statistics.median(x) for x in (steps, physics, rates))
    learning = operations / speed
    print(f"moving robots            {100 * statistics.median(moving):8.1f} %")
    print(f"whole timestep           {step * 1e3:8.2f} ms   (paper scale, T = 10 000: {step * 1e4:.0f} s)")
    print(f"bound: raw rollout       {raw * 1e3:8.2f} ms   ({3 * 100 * statistics.median(moving) / raw:,.0f} physics steps/s)")
    print(f"bound: gradient steps    {learning * 1e3:8.2f} ms   ({operations / 1e9:.2f} GFLOP at {speed / 1e9:.0f} GFLOP/s)")
    print(f"ratio to the bound       {step / (raw + learning):8.2f}")


if __name__ == "__main__":
    main()
