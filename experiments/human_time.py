"""Print the human time that finished C.U.R. runs asked for: what the `constraint` and `random` baselines are calibrated by.

    for seed in 0 1 2; do fleetjax run humanoid --seed $seed --output runs/humanoid-cur-$seed; done
    python experiments/human_time.py runs/humanoid-cur-*

The mean goes to `CUR_HUMAN_TIME` in `fleetjax/environments.py`, the threshold to the defaults of the environment there.
"""

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from fleetjax import HumanState, allocate


def random_human_time(settings: dict[str, Any], threshold: jax.Array, key: jax.Array) -> jax.Array:
    """Return the human timesteps i32[] that `random` asks for: allocation alone, whatever the robots do."""
    num_robots, num_humans = settings["num_robots"], settings["num_humans"]

    def timestep(humans: HumanState, key: jax.Array):
        key_score, key_ties = jax.random.split(key)
        score = jax.random.uniform(key_score, (num_robots,))
        min_time = jnp.full(num_robots, settings["min_teleop_time"])
        humans = allocate(jnp.where(score < threshold, 0.0, score), humans, min_time, key_ties)
        busy = humans.robot >= 0
        return HumanState(humans.robot, jnp.where(busy, humans.duration + 1, 0)), jnp.sum(busy)

    free = HumanState(jnp.full(num_humans, -1), jnp.zeros(num_humans, jnp.int32))
    return jnp.sum(jax.lax.scan(timestep, free, jax.random.split(key, settings["num_steps"]))[1])


def matching_threshold(settings: dict[str, Any], human_time: float) -> float:
    """Return the `random_threshold` that asks for a given human time."""
    thresholds = 1 - jnp.geomspace(1e-4, 0.2, 64)
    times = jax.jit(jax.vmap(lambda x: random_human_time(settings, x, jax.random.key(0))))(thresholds)
    return 1 - float(np.exp(np.interp(human_time, times, np.log(1 - thresholds))))


def main() -> None:
    """Print human timesteps of each run, hard resets included, their mean, and the threshold that matches it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders of one environment, algorithm cur")
    times, settings = [], {}
    for folder in parser.parse_args().runs:
        settings = json.loads((folder / "config.json").read_text())["config"]
        metrics = pd.read_csv(folder / "metrics.csv")
        times.append(int(metrics["human_steps"].to_numpy().sum()))
        capacity = settings["num_humans"] * len(metrics)
        print(f"{folder}: {times[-1]} of {capacity} human timesteps, {100 * times[-1] / capacity:.1f} %")
    mean = statistics.mean(times)
    print(f"mean {mean:.0f}; random asks for as much with random_threshold {matching_threshold(settings, mean):.5f}")


if __name__ == "__main__":
    main()
