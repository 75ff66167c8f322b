"""Check the gradients of `fleetjax.sensitivity` against each other, and against what the docs claim.

    python experiments/gradient_check.py [CHECK ...] [--seeds 10] [--num-samples 128] [--output FIGURE.png] [-- PARAMETERS]

The checks, each a table:

- `differences`: the relaxed gradient against finite differences of the same objective, one field and seed at a time, where
  no hard event (a violation, a reset, a change of who helps whom) lies between the two runs, and where one does. A
  difference is settled if half its width changes it by less than 1 %: only then can it tell what the derivative is.
- `temperature`: relaxed gradients, as the temperature falls, against the smoothed gradient of the hard objective.
- `steps`: how much a step along each gradient raises the return of the hard fleet on fresh seeds.
- `length`: how large the relaxed gradient grows with the length of the run.

Gradients are with respect to the logarithm of each field, so that fields of different size compare. PARAMETERS are those
of `fleetjax run`.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import fleetjax
from fleetjax import statistics
from fleetjax.config import Config, all_fields, get_value
from fleetjax.gradients import final_return, within_range
from fleetjax.io import figure, files, scripts, text

FIELDS = ("uncertainty_threshold", "risk_threshold", "violation_weight", "uncertainty_weight", "risk_weight")
FLEET = {"num_robots": 20, "num_humans": 5, "num_steps": 300, "initial_period": 0, "critic_capacity": 10_000}
START = {"uncertainty_threshold": 0.15}  # above the best: with it humans are sometimes free, and the return depends on it
TEMPERATURES = (1.0, 0.3, 0.1, 0.03, 0.01)
LENGTHS = (30, 100, 300, 1000)
STEPPED = (1.0, 0.1)  # temperatures of the relaxed gradients along which `steps` goes
SHORT = (3, 10, 30, 100)  # of finite differences
WIDTH = 0.5  # of the noise in smoothed gradients, in units of each field; less leaves more noise than slope
STEP = 0.3  # by which a step changes the logarithms of all fields, as a vector
DIFFERENCE = 2e-3  # half the relative distance of the two runs of a finite difference
SETTLED = 0.01  # by which a finite difference of half the width may differ
EVENTS = ("violations", "hard_resets", "idle", "switches", "choices")  # counts that differ if a hard event does
CHECKS = ("differences", "temperature", "steps", "length")

Table = list[tuple[str, ...]]


def relative(config: Config, found: fleetjax.Sensitivity) -> np.ndarray:
    """Return f64[F], the derivatives with respect to the logarithms of the fields."""
    return np.array([float(found.gradient[name] * get_value(config, name)) for name in FIELDS])


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Return the cosine of the angle between two vectors; NaN if one is 0."""
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b))) if np.any(a) and np.any(b) else float("nan")


def scaled(config: Config, factors: Mapping[str, float]) -> Config:
    """Return the configuration with some fields multiplied, each kept within its range."""
    known = all_fields(config.algorithm)
    return config.replace(**{name: within_range(known[name], get_value(config, name) * x) for name, x in factors.items()})


@jax.jit
def relaxed(config: Config, keys: jax.Array) -> fleetjax.Sensitivity:
    """Return the relaxed sensitivity."""
    return fleetjax.sensitivity(config, keys, FIELDS, method="relaxed")


def relaxed_at(config: Config, keys: jax.Array, temperature: float) -> np.ndarray:
    """Return f64[S, F], the relaxed gradient of each seed."""
    config = config.replace(temperature=temperature)
    return np.array([relative(config, relaxed(config, key[None])) for key in keys])


@jax.jit
def final_returns(config: Config, keys: jax.Array) -> jax.Array:
    """Return f32[S], the return on human effort of hard runs."""
    return jax.lax.map(lambda key: final_return(fleetjax.run(config, key).metrics, config), keys)


def check_differences(config: Config, keys: jax.Array, lengths: Sequence[int]) -> Table:
    """Compare relaxed gradients with finite differences, by the length of the run."""
    soft = config.replace(allocation="soft", temperature=TEMPERATURES[1])
    prepare = jax.jit(fleetjax.prepare)

    @jax.jit
    def run(config: Config, key: jax.Array, state: fleetjax.FleetState) -> tuple[jax.Array, list[jax.Array]]:
        metrics, last = fleetjax.run(config, key, state)
        counts = [getattr(metrics, name) for name in EVENTS]
        return final_return(metrics, config), [*counts, last.env.episode_step, last.humans.robot]

    def differ(config: Config, name: str, width: float, key: jax.Array, state: fleetjax.FleetState) -> tuple[bool, float]:
        """Return whether a hard event lies between the two runs of a difference, and the difference by the field."""
        value = get_value(config, name)
        ends = [run(config.replace(**{name: value * (1 + sign * width)}), key, state) for sign in (1, -1)]
        (high, above), (low, below) = ends
        switched = any(np.any(x != y) for x, y in zip(above, below, strict=True))
        return switched, float((high - low) / (2 * width * value))

    def compare(config: Config, name: str, slope: float, key: jax.Array, state: fleetjax.FleetState) -> tuple[str, float]:
        """Return what kind of difference there is for a field, and how far the slope is from it."""
        switched, wide = differ(config, name, DIFFERENCE, key, state)
        _, narrow = differ(config, name, DIFFERENCE / 2, key, state)
        kind = "some" if switched else "none" if apart(wide, narrow) < SETTLED else "none, not settled"
        return kind, apart(slope, wide)

    rows: Table = [("timesteps", "hard events between the runs", "pairs", "median error", "90th percentile")]
    for length in lengths:
        shorter = soft.replace(num_steps=length)
        errors: dict[str, list[float]] = {"none": [], "none, not settled": [], "some": []}
        for key in keys:
            state, slopes = prepare(shorter, key), relaxed(shorter, key[None]).gradient
            for name in FIELDS:
                kind, error = compare(shorter, name, float(slopes[name]), key, state)
                errors[kind].append(error)
        for kind, found in errors.items():
            shown = [f"{100 * np.quantile(found, q):.2g} %" for q in (0.5, 0.9)] if found else ["-", "-"]
            rows.append((str(length), kind, str(len(found)), *shown))
    return rows


def apart(a: float, b: float) -> float:
    """Return how far two numbers are from each other, relative to the larger."""
    return abs(a - b) / max(abs(a), abs(b), 1e-12)


def by_temperature(slopes: dict[float, np.ndarray], reference: np.ndarray) -> tuple[Table, list[tuple[float, float]]]:
    """Compare relaxed gradients f64[S, F] with the smoothed one, by temperature; return also the cosine of each temperature."""
    rows: Table = [("temperature", "cosine", "equal signs", "cosine of one seed, median", "norm")]
    curve = []
    for temperature, each in slopes.items():
        mean = each.mean(axis=0)
        alone = [angle for one in each if not np.isnan(angle := cosine(one, reference))]
        curve.append((temperature, cosine(mean, reference)))
        signs = f"{np.sum(np.sign(mean) == np.sign(reference))} of {len(FIELDS)}"
        rows.append(
            (
                f"{temperature:g}",
                f"{curve[-1][1]:.2f}",
                signs,
                f"{np.median(alone):.2f}" if alone else "-",
                f"{np.linalg.norm(mean):.2g}",
            )
        )
    return rows, curve


def check_steps(config: Config, directions: dict[str, np.ndarray], seeds: Sequence[int]) -> Table:
    """Take a step along each gradient, and compare the returns of fresh seeds with those before it."""
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    before = np.asarray(final_returns(config, keys), float)
    rows: Table = [("step along", "return before", "after", "difference", "95 % interval")]
    for name, direction in directions.items():
        step = np.exp(STEP * direction / max(np.linalg.norm(direction), 1e-12))
        after = np.asarray(final_returns(scaled(config, dict(zip(FIELDS, step, strict=True))), keys), float)
        low, high = statistics.mean_bounds(after - before)
        shown = (f"{x:.3f}" for x in (before.mean(), after.mean(), (after - before).mean()))
        rows.append((name, *shown, f"{low:.3f} to {high:.3f}"))
    return rows


def by_length(config: Config, keys: jax.Array, lengths: Sequence[int]) -> tuple[Table, list[tuple[int, float]]]:
    """Return how the norms of relaxed gradients grow with the length of the run."""
    rows: Table = [("timesteps", "median norm", "largest norm")]
    curve = []
    for length in lengths:
        longer = config.replace(num_steps=length)
        norms = np.linalg.norm(relaxed_at(longer, keys, TEMPERATURES[1]), axis=1)
        curve.append((length, float(np.median(norms))))
        rows.append((str(length), f"{np.median(norms):.2g}", f"{max(norms):.2g}"))
    return rows, curve


def draw(curves: dict[tuple[str, str], Iterable[tuple[float, float]]]) -> Figure:
    """Return a figure with a panel for each curve, whose key is its title and the name of its x axis."""
    with figure.style():
        shown = Figure(figsize=(8, 3), layout="constrained")
        for axes, ((title, by), curve) in zip(shown.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
            x, y = zip(*curve, strict=True)
            axes.plot(x, y, marker="o", color="#0072B2")
            axes.set(title=title, xlabel=by, xscale="log")
            if "norm" in title:
                axes.set_yscale("log")
            else:
                axes.set_ylim(-1.05, 1.05)
        return shown


def main() -> None:
    """Run the checks, print their tables, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "checks", CHECKS)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--num-samples", type=int, default=128, help="runs of each seed for the smoothed gradient")
    parser.add_argument("--fresh", type=int, default=20, help="fresh seeds on which steps are judged")
    parser.add_argument("--lengths", type=int, nargs="+", default=LENGTHS, help="timesteps for `length`")
    parser.add_argument("--differences", type=int, nargs="+", default=SHORT, help="timesteps for `differences`")
    parser.add_argument("--output", type=Path, help="figure")
    args, given = scripts.parse(parser)
    config = fleetjax.make_config("navigation", "weighted", **FLEET | START | given)
    keys, wanted, curves = jax.random.split(jax.random.key(0), args.seeds), args.checks, {}
    reference = np.zeros(len(FIELDS))

    def show(title: str, table: Table) -> None:
        print(f"{title}\n\n{text.markdown_table(table)}\n", flush=True)

    if "differences" in wanted:
        show("Relaxed gradients and finite differences", check_differences(config, keys, args.differences))
    if {"temperature", "steps"} & set(wanted):
        smoothed = jax.jit(lambda keys: fleetjax.sensitivity(config, keys, FIELDS, num_samples=args.num_samples, width=WIDTH))
        found = smoothed(keys)
        reference = relative(config, found)
        errors = [float(found.standard_error[name] * get_value(config, name)) for name in FIELDS]
        table = [(f, f"{x:.3f}", f"{e:.3f}") for f, x, e in zip(FIELDS, reference, errors, strict=True)]
        show("Smoothed gradient", [("field", "gradient", "standard error"), *table])
    wanted_at = TEMPERATURES if "temperature" in wanted else STEPPED if "steps" in wanted else ()
    slopes = {t: relaxed_at(config, keys, t) for t in wanted_at}
    if "temperature" in wanted:
        table, curves["cosine with the smoothed gradient", "temperature"] = by_temperature(slopes, reference)
        show("Relaxed and smoothed gradients", table)
    if "steps" in wanted:
        directions = {"the smoothed gradient": reference, "the opposite direction": -reference}
        directions |= {f"the relaxed one, temperature {t:g}": slopes[t].mean(axis=0) for t in STEPPED}
        show("Steps", check_steps(config, directions, range(1000, 1000 + args.fresh)))
    if "length" in wanted:
        table, curves["norm of the relaxed gradient", "timesteps"] = by_length(config, keys, args.lengths)
        show("Length", table)
    if args.output and curves:
        files.write(args.output, figure.render(draw(curves)))
        print(args.output)


if __name__ == "__main__":
    main()
