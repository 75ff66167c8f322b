"""Time the gradients of `fleetjax.sensitivity` on navigation, and measure the memory that reverse mode needs.

    python benchmarks/gradients.py [relaxed|smoothed ...] [--lengths 100 300 1000] [--num-samples 16] [-- PARAMETERS]

- `relaxed`: the objective of a soft fleet alone, and with its gradient for two fields, by the length of the run; the memory of
  the compiled gradient, and the estimate by which `sensitivity` refuses runs that are too long.
- `smoothed`: shifted runs a second, beside as many plain runs in a `lax.map`.

Runs begin from a fleet that is almost untrained, whose preparation is not timed. PARAMETERS are those of `fleetjax run`.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
from common import median_seconds, print_last, quick_config, table

import fleetjax
from fleetjax import envs
from fleetjax.config import get_value
from fleetjax.gradients import final_return, make_gradient, reverse_bytes
from fleetjax.io import scripts

FIELDS = ("uncertainty_threshold", "risk_weight")


def relaxed(config: fleetjax.Config, args: argparse.Namespace) -> None:
    """Time a soft fleet's objective alone, and with its gradient."""
    rows = []
    for length in args.lengths:
        soft = config.replace(allocation="soft", num_steps=length)
        env, key = envs.make(soft.environment), jax.random.key(0)
        derive = make_gradient(soft, env, final_return, FIELDS, "relaxed", {}, 2)
        values = {name: get_value(soft, name) for name in FIELDS}
        state = jax.jit(fleetjax.prepare)(soft, key)
        alone = jax.jit(lambda values, key, state, soft=soft: final_return(fleetjax.run(soft, key, state).metrics, soft))
        backward = jax.jit(derive).lower(values, key, state).compile()
        times = [median_seconds(f, values, key, state, repeats=args.repeats) for f in (alone, backward)]
        analysis, estimate = backward.memory_analysis(), reverse_bytes(soft, env)
        memory = "-" if analysis is None else f"{analysis.temp_size_in_bytes / 2**20:,.0f}"  # some platforms do not tell
        rows.append(
            {
                "timesteps": str(length),
                "run, s": f"{times[0]:.2f}",
                "with gradient, s": f"{times[1]:.2f}",
                "ratio": f"{times[1] / times[0]:.2f}",
                "memory, MiB": memory,
                "estimate, MiB": f"{estimate / 2**20:,.0f}",
            }
        )
        print_last(rows)
    print()


def smoothed(config: fleetjax.Config, args: argparse.Namespace) -> None:
    """Count shifted runs a second, and plain ones."""
    short, number = config.replace(num_steps=args.lengths[0]), args.num_samples
    env, key = envs.make(short.environment), jax.random.key(0)
    values = {name: get_value(short, name) for name in FIELDS}
    widths = {name: 0.1 * value for name, value in values.items()}
    derive = jax.jit(make_gradient(short, env, final_return, FIELDS, "smoothed", widths, number))

    @jax.jit
    def plain(risk: jax.Array, key: jax.Array, state: fleetjax.FleetState) -> jax.Array:
        def one(risk: jax.Array) -> jax.Array:
            return final_return(fleetjax.run(short.replace(risk_threshold=risk), key, state).metrics, short)

        return jax.lax.map(one, risk)

    state = jax.jit(fleetjax.prepare)(short, key)
    shifted = median_seconds(derive, values, key, state, repeats=args.repeats) / (number + 1)  # and one that is not shifted
    alone = median_seconds(plain, jnp.linspace(0.4, 0.6, number), key, state, repeats=args.repeats) / number
    row = {"timesteps": str(args.lengths[0]), "plain runs a second": f"{1 / alone:.2f}", "smoothed": f"{1 / shifted:.2f}"}
    print(table([row | {"ratio": f"{alone / shifted:.2f}"}]))


PARTS = {"relaxed": relaxed, "smoothed": smoothed}


def main() -> None:
    """Print a table for each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "parts", PARTS)
    parser.add_argument("--lengths", type=int, nargs="+", default=[100, 300, 1000], help="timesteps")
    parser.add_argument("--num-samples", type=int, default=16, help="shifted runs")
    parser.add_argument("--repeats", type=int, default=3)
    args, given = scripts.parse(parser)
    settings: dict[str, Any] = {"algorithm": "weighted", **given}
    config = quick_config("navigation", **settings)
    for part in args.parts:
        PARTS[part](config, args)


if __name__ == "__main__":
    main()
