"""Which part of C.U.R. matters, and by how much: derivatives with respect to the weights of its parts, and runs without a part.

    python experiments/which_part.py [ENV ...] [--seeds 3] [--removals 10] [--num-samples 32] [-- PARAMETERS]

The parts are violations, uncertainty and risk. The rule is not C.U.R. itself, which is an order, but
`weighted`, with all weights 1 and without an initial period.

For each of --seeds there is the smoothed derivative of the return on human effort with respect to the logarithm of each weight
(`fleetjax.sensitivity`). For each of --removals there is a whole run, and one without each part, trained anew. An episode
on Humanoid takes 999 timesteps, so a run of 1,000 has almost no successes: there rewards stand for them, in units of the return
that a success needs. PARAMETERS are those of `fleetjax run`.

Rows go to `experiments/notebooks/which_part.csv` (--rows) as they come. Repeat the command to resume. Use another
file for other PARAMETERS or --num-samples.
"""

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pandas as pd

import fleetjax
from fleetjax import statistics
from fleetjax.config import Config, get_value
from fleetjax.gradients import final_return
from fleetjax.io import files, scripts, text

PARTS = {"violation_weight": "violation", "uncertainty_weight": "uncertainty", "risk_weight": "risk"}
STEPS = {"navigation": 500, "humanoid": 1000}
WIDTH = 0.5  # of the noise, in units of a weight: a tenth would hardly change who is helped
DERIVATIVE, WHOLE, REMOVED = "derivative", "whole", "removed"  # kinds of rows


class Row(NamedTuple):
    """A row of the file: what a run or a derivative came to, and the standard error of a derivative."""

    environment: str
    timesteps: int
    kind: str
    part: str
    seed: int
    value: float
    error: float


def worth(metrics: fleetjax.Metrics, config: Config) -> jax.Array:
    """Return f32[], the return on human effort at the end of a run; see above for Humanoid."""
    if config.environment == "humanoid":
        metrics = metrics._replace(successes=metrics.reward / config.success_return)
    return final_return(metrics, config)


@partial(jax.jit, static_argnames="num_samples")
def derivatives(config: Config, key: jax.Array, num_samples: int) -> dict[str, tuple[jax.Array, jax.Array]]:
    """Return for each part f32[] the derivative of the return with respect to the log of its weight, and f32[] its error."""
    weights = {name: get_value(config, name) for name in PARTS}
    width = {name: WIDTH * weight for name, weight in weights.items()}
    found = fleetjax.sensitivity(config, key, list(PARTS), objective=worth, num_samples=num_samples, width=width)
    return {
        part: (found.gradient[name] * weights[name], found.standard_error[name] * weights[name]) for name, part in PARTS.items()
    }


@jax.jit
def returned(config: Config, key: jax.Array) -> jax.Array:
    """Return f32[], what a run is worth."""
    return worth(fleetjax.run(config, key).metrics, config)


def missing_rows(config: Config, stored: pd.DataFrame, args: argparse.Namespace) -> Iterator[list[Row]]:
    """Yield the rows that are not stored yet, of one seed and kind after the other."""

    def is_stored(kind: str, seed: int) -> bool:
        place = (stored["environment"] == config.environment) & (stored["timesteps"] == config.num_steps)
        return bool(np.any(place & (stored["kind"] == kind) & (stored["seed"] == seed)))

    def row(kind: str, part: str, seed: int, value: float, error: float = float("nan")) -> Row:
        return Row(config.environment, config.num_steps, kind, part, seed, value, error)

    for seed in range(args.removals):
        if not is_stored(REMOVED, seed):
            key = jax.random.key(seed)
            removed = {part: config.replace(**{name: 0.0}) for name, part in PARTS.items()}
            whole = row(WHOLE, "", seed, float(returned(config, key)))
            yield [whole, *(row(REMOVED, part, seed, float(returned(other, key))) for part, other in removed.items())]
    for seed in range(args.seeds):
        if not is_stored(DERIVATIVE, seed):
            found = derivatives(config, jax.random.key(seed), args.num_samples)
            yield [row(DERIVATIVE, part, seed, float(slope), float(error)) for part, (slope, error) in found.items()]


def show(rows: pd.DataFrame) -> str:
    """Return a table of derivatives, and of what removal changes, with 95 % intervals over seeds or ranges of few."""

    def interval(values: np.ndarray) -> str:
        low, high = statistics.mean_bounds(values)
        return f"{values.mean():.3f} ({low:.3f} to {high:.3f})"

    table: list[tuple[str, ...]] = [
        ("environment", "part", "derivative, log weight", "change without the part", "return with all parts")
    ]
    for place, found in rows.groupby("environment", sort=False):
        kind, own = found["kind"].to_numpy(), found["part"].to_numpy()
        values = found["value"].to_numpy(dtype=float)
        whole = values[kind == WHOLE]
        for part in PARTS.values():
            slopes, without = (values[(kind == which) & (own == part)] for which in (DERIVATIVE, REMOVED))
            shown = [interval(values) if len(values) else "-" for values in (slopes, without - whole, whole)]
            table.append((str(place), part, *shown))
    return text.markdown_table(table)


def main() -> None:
    """Compute the rows that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", STEPS)
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds for derivatives")
    parser.add_argument("--removals", type=int, default=10, help="number of seeds for runs with and without each part")
    parser.add_argument("--num-samples", type=int, default=32, help="shifted runs for each derivative")
    parser.add_argument("--rows", type=Path, default=Path(__file__).parent / "notebooks" / "which_part.csv", metavar="FILE.csv")
    args, given = scripts.parse(parser)
    stored = pd.read_csv(args.rows) if args.rows.exists() else pd.DataFrame(columns=Row._fields)
    for name in args.environments:
        wanted = {"num_steps": STEPS[name], "initial_period": 0, **dict.fromkeys(PARTS, 1.0)}
        config = fleetjax.make_config(name, "weighted", **wanted | given)
        for rows in missing_rows(config, stored, args):
            found = pd.DataFrame(rows)
            stored = pd.concat([stored, found], ignore_index=True) if len(stored) else found
            files.write(args.rows, stored.to_csv(index=False, float_format="%.6g").encode())
            print(f"{name}: {rows[-1].kind}, seed {rows[-1].seed}", flush=True)
    if len(stored):
        print(show(stored))


if __name__ == "__main__":
    main()
