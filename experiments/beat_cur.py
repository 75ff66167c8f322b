"""Try rules that help early: makes the rows of the last table in docs/beat_cur.md.

    python experiments/beat_cur.py [humanoid anymal allegro_hand] [--variants random-last,risk-last] [--seed 100] [--until T]

A variant helps moving robots up to timestep T, chosen in some way. It resets robots before it helps others (`first`), after
that (`last`), or not at all up to T / 2 and then first (`half`). Parameters of `fleetjax run` may follow after `--`. Prints a
row for each run.
"""

import argparse
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import fleetjax
from fleetjax.field import Field
from fleetjax.io import scripts, text
from fleetjax.io.lists import listed
from fleetjax.priority import Priority, lexicographic, stateless

HOLD = 50  # timesteps that a human stays with a robot in `held`


class Variant(NamedTuple):
    """A rule that was tried.

    Attributes:
        choice: how moving robots are chosen: `random`, `uncertain`, `uncertain-random`, `risk`, `held`.
        resets: when robots in violation are helped: `first`, `last`, `half`.
        late: after T, robots at least this uncertain are helped; infinity = nobody is.
    """

    choice: str
    resets: str
    late: float = float("inf")


VARIANTS = {
    "random-first": Variant("random", "first"),
    "uncertain-first": Variant("uncertain", "first"),
    "random-last": Variant("random", "last"),
    "random-half": Variant("random", "half"),
    "uncertain-random-last": Variant("uncertain-random", "last"),
    "risk-last": Variant("risk", "last"),
    "held-last": Variant("held", "last"),
    "random-last-then-uncertain": Variant("random", "last", 0.05),
}
UNTIL = {"humanoid": 900.0, "anymal": 850.0, "allegro_hand": 900.0}  # timesteps


def make(variant: Variant, config: Any) -> Priority:
    """Return the rule."""

    def score(signals, key):
        chance = jax.random.uniform(key, signals.violation.shape)
        until, t = config.parameters["help_until"], signals.timestep
        values = {
            "random": chance,
            "uncertain": signals.uncertainty,
            "uncertain-random": signals.uncertainty * chance,
            "risk": signals.risk * chance,
            "held": chance + (signals.helped & (signals.help_time < HOLD)),
        }
        chosen = jnp.where(signals.violation | (t >= until), 0.0, values[variant.choice] + 1e-6)
        late = jnp.where((t >= until) & (signals.uncertainty >= variant.late), signals.uncertainty, 0.0)
        begins = {"first": 0.0, "last": jnp.inf, "half": until / 2}[variant.resets]
        first, last = signals.violation & (t >= begins), signals.violation & (variant.resets == "last")
        return lexicographic(first, chosen + late, last)

    return stateless(score)


def main() -> None:
    """Run the variants that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", tuple(UNTIL))
    parser.add_argument("--variants", type=listed(str), default=[*VARIANTS], help="names [default: all]")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--until", type=float, help="T [default: one for each environment]")
    args, given = scripts.parse(parser)
    if unknown := [name for name in args.variants if name not in VARIANTS]:
        parser.error(f"unknown variants: {', '.join(unknown)}; choose from {', '.join(VARIANTS)}")
    for name in args.variants:
        variant = VARIANTS[name]
        own = {"help_until": Field("timestep at which the teaching ends", default=0.0)}
        estimators = ("safety",) if variant.choice == "risk" else ()
        fleetjax.register_priority(
            name, lambda config, variant=variant: make(variant, config), estimators=estimators, parameters=own
        )
    print("| environment | variant | successes | violations | human time | idle time |\n|---|---|---:|---:|---:|---:|")
    for environment in args.environments:
        for name in args.variants:
            settings = {"initial_period": 0, "help_until": UNTIL[environment] if args.until is None else args.until} | given
            config = fleetjax.make_config(environment, name, **settings)
            totals = jax.tree.map(lambda x: int(x.sum()), fleetjax.run(config, jax.random.key(args.seed)).metrics)
            counts = (totals.successes, totals.violations, totals.human_steps, totals.idle)
            print(f"| {environment} | {name} | {' | '.join(map(text.count, counts))} |", flush=True)


if __name__ == "__main__":
    main()
