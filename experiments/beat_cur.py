"""Try rules that help early: makes the rows of the tables of variants in docs/beat_cur.md.

    python experiments/beat_cur.py [humanoid anymal allegro_hand] [--variants random-last,risk-last] [--seed 100] [--until T]
    python experiments/beat_cur.py humanoid --variants teach-oldest -- --num-steps 3000 --batch-size 512 --gradient-steps 2

A variant helps moving robots up to timestep T, chosen in some way. It resets robots before it helps others (`first`), after
that (`last`), or not at all up to T / 2 and then first (`half`). Variants whose name begins with `teach` are Teach First with
one thing changed; T does not apply to them, but `--teaching-time` (5,500 by default), after `--`. Other parameters of
`fleetjax run` may follow there, too. Prints a row for each run.
"""

import argparse
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import fleetjax
from fleetjax.config import all_fields
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


class Lesson(NamedTuple):
    """How a variant teaches; by default as Teach First does.

    Attributes:
        at_once: share of `teaching_time` that is taught as fast as humans can.
        spread: timesteps from which and up to which the rest is taught, at a constant rate.
        oldest: whether robots are chosen by their time since the last reset, cubed, times a random number; else at random.
        held: timesteps that a human stays with a robot in the first half of the teaching, if more than `min_teleop_time`.
    """

    at_once: float = 1.0
    spread: tuple[float, float] = (0.0, 1.0)
    oldest: bool = False
    held: int = 0


LESSONS = {
    "teach-evenly": Lesson(at_once=0.0, spread=(0.0, 900.0)),
    "teach-some-later": Lesson(at_once=0.7, spread=(500.0, 1300.0)),
    "teach-oldest": Lesson(oldest=True),
    "teach-held": Lesson(held=150),
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
        asks = (t >= until) & (signals.uncertainty >= variant.late) & ~signals.violation
        late = jnp.where(asks, signals.uncertainty, 0.0)
        begins = {"first": 0.0, "last": jnp.inf, "half": until / 2}[variant.resets]
        first, last = signals.violation & (t >= begins), signals.violation & (variant.resets == "last")
        return lexicographic(first, chosen + late, last)

    return stateless(score)


def make_lesson(lesson: Lesson, config: Any) -> Priority:
    """Return the variant of Teach First."""
    begins, ends = lesson.spread

    def score(signals, taught, key):
        taught += jnp.sum(signals.given.astype(jnp.float32))
        share = taught / config.parameters["teaching_time"]
        allowed = lesson.at_once + (1 - lesson.at_once) * jnp.clip((signals.timestep - begins) / (ends - begins), 0, 1)
        age = signals.episode_step / 1000.0 + 1e-3
        value = jax.random.uniform(key, signals.violation.shape) * (age**3 if lesson.oldest else 1.0) + 1e-6
        early = share < 0.5
        waits, held = signals.violation & early, signals.helped & (signals.help_time < lesson.held) & early
        chosen = jnp.where(signals.violation | (share >= allowed), 0.0, value + held)
        return lexicographic(signals.violation & ~waits, chosen, waits), taught

    return Priority(init=lambda: jnp.zeros(()), score=score)


def register() -> None:
    """Register the variants."""
    for name, variant in VARIANTS.items():
        own = {"help_until": Field("timestep at which the teaching ends", default=0.0)}
        estimators = ("safety",) if variant.choice == "risk" else ()
        fleetjax.register_priority(
            name, lambda config, variant=variant: make(variant, config), estimators=estimators, parameters=own
        )
    for name, lesson in LESSONS.items():
        own = {"teaching_time": Field("human timesteps of teaching", default=5500.0)}
        fleetjax.register_priority(
            name, lambda config, lesson=lesson: make_lesson(lesson, config), estimators=(), parameters=own
        )


def main() -> None:
    """Run the variants that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", tuple(UNTIL))
    parser.add_argument("--variants", type=listed(str), default=[*VARIANTS], help="names [default: all with T]")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--until", type=float, help="T [default: one for each environment]")
    args, given = scripts.parse(parser)
    names = (*VARIANTS, *LESSONS)
    if unknown := [name for name in args.variants if name not in names]:
        parser.error(f"unknown variants: {', '.join(unknown)}; choose from {', '.join(names)}")
    register()
    print("| environment | variant | successes | violations | human time | idle time |\n|---|---|---:|---:|---:|---:|")
    for environment in args.environments:
        for name in args.variants:
            own = {"help_until": UNTIL[environment] if args.until is None else args.until} if name in VARIANTS else {}
            known = all_fields(name)
            settings = {"initial_period": 0} | own | {field: value for field, value in given.items() if field in known}
            config = fleetjax.make_config(environment, name, **settings)
            totals = jax.tree.map(lambda x: int(x.sum()), fleetjax.run(config, jax.random.key(args.seed)).metrics)
            counts = (totals.successes, totals.violations, totals.human_steps, totals.idle)
            print(f"| {environment} | {name} | {' | '.join(map(text.count, counts))} |", flush=True)


if __name__ == "__main__":
    main()
