"""Compare `fleetjax.tune` with the defaults and with a grid of as many runs, on fresh seeds of navigation.

    python experiments/tuning_check.py [--steps 8] [--seeds 3] [--num-samples 6] [--fresh 20] [-- PARAMETERS]

`tune` changes five parameters: the thresholds of uncertainty and risk, and the weights of violation, uncertainty and risk. The
grid varies both thresholds and the weight of risk. As many of its points as tuning takes runs for each seed are tried, the
nearest to the start first, and the best is picked on the seeds of tuning.
PARAMETERS are those of `fleetjax run`.
"""

import argparse
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from gradient_check import FIELDS, FLEET, final_returns, scaled

import fleetjax
from fleetjax import statistics
from fleetjax.config import Config, get_value
from fleetjax.io import scripts, text

GRID = {  # factors of the first values
    "uncertainty_threshold": (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0),
    "risk_threshold": (0.25, 0.5, 1.0, 2.0),
    "risk_weight": (0.1, 1.0, 10.0),
}


def grid(config: Config, number: int) -> list[Config]:
    """Return up to `number` configurations: the middle of the grid first."""
    points = sorted(itertools.product(*GRID.values()), key=lambda point: sum(abs(np.log(factor)) for factor in point))
    return [scaled(config, dict(zip(GRID, point, strict=True))) for point in points[:number]]


def compare(found: dict[str, Config], keys: jax.Array) -> str:
    """Return a table of returns on fresh seeds, and of how much higher those of tuning are, seed by seed."""
    returns = {name: np.asarray(final_returns(config, keys), float) for name, config in found.items()}
    tuned = returns["tune"]
    rows: list[tuple[str, ...]] = [("", *FIELDS, "ROHE", "tune - this", "95 % interval")]
    for name, config in found.items():
        low, high = statistics.mean_bounds(tuned - returns[name])
        values = [f"{float(get_value(config, field)):.3g}" for field in FIELDS]
        change = ("", "") if name == "tune" else (f"{(tuned - returns[name]).mean():.3f}", f"{low:.3f} to {high:.3f}")
        rows.append((name, *values, f"{returns[name].mean():.3f}", *change))
    return text.markdown_table(rows)


def main() -> None:
    """Tune, search the grid, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=8, help="gradient steps")
    parser.add_argument("--seeds", type=int, default=3, help="seeds to tune on")
    parser.add_argument("--num-samples", type=int, default=6, help="shifted runs of each seed and step")
    parser.add_argument("--learning-rate", type=float, default=0.2)
    parser.add_argument("--fresh", type=int, default=20, help="fresh seeds to compare on")
    args, given = scripts.parse(parser)
    config = fleetjax.make_config("navigation", "weighted", **FLEET | given)
    keys = jax.random.split(jax.random.key(0), args.seeds)
    options = {"steps": args.steps, "num_samples": args.num_samples, "learning_rate": args.learning_rate}
    tuned = jax.jit(lambda keys: fleetjax.tune(config, keys, FIELDS, **options))(keys)
    print("objective before each step:", " ".join(f"{x:.3f}" for x in np.asarray(tuned.objective)), flush=True)
    points = grid(config, args.steps * (args.num_samples + 1))
    returns = [float(jnp.mean(final_returns(point, keys))) for point in points]
    print(f"grid: {len(points)} points, the best with a mean of {max(returns):.3f}", flush=True)
    best = points[int(np.argmax(returns))]
    fresh = jax.vmap(jax.random.key)(jnp.arange(1000, 1000 + args.fresh))
    print(compare({"defaults": config, "best of the grid": best, "tune": tuned.config}, fresh))


if __name__ == "__main__":
    main()
