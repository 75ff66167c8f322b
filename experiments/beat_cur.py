"""Try rules that may beat C.U.R.: makes the rows of the tables of variants in docs/beat_cur.md.

    python experiments/beat_cur.py [humanoid anymal allegro_hand] [--variants random-last,risk-last] [--seed 100] [--until T]
    python experiments/beat_cur.py humanoid --variants teach-oldest -- --num-steps 3000 --batch-size 512 --gradient-steps 2
    python experiments/beat_cur.py allegro_hand --variants cur-dense,teach-dense -- --uncertainty-threshold 0.2

A variant helps moving robots up to timestep T, chosen in some way. It resets robots before it helps others (`first`), after
that (`last`), or not at all up to T / 2 and then first (`half`). Variants whose name begins with `cur` or `teach` are C.U.R. or
Teach First with one thing changed; T does not apply to them. The latter have `--teaching-time` (5,500 by default), given after
`--`. Other parameters of `fleetjax run` may follow there, too. Prints a row for each run.
"""

import argparse
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

import fleetjax
from fleetjax.config import all_fields
from fleetjax.field import PARAMETERS, Field
from fleetjax.io import scripts, text
from fleetjax.io.lists import listed
from fleetjax.learning import buffer
from fleetjax.learning.estimator import Estimator
from fleetjax.learning.imitation import stored_obs
from fleetjax.learning.networks import ADAM, descend, make_network
from fleetjax.priority import Priority, get_algorithm, lexicographic, stateless
from fleetjax.priority.coverage import pick, similarity
from fleetjax.priority.ranks import above

HOLD = 50  # timesteps that a human stays with a robot in `held`
DISCOUNT, RATE = 0.98, 0.005  # of the values of `make_gain`, and of their target networks
RECENT = 100  # human actions over which a price is compared


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
        choice: how moving robots are chosen, as in `WORTH`.
        held: timesteps that a human stays with a robot in the first half of the teaching, if more than `min_teleop_time`.
        priced: whether `price` decides how long humans teach, not `teaching_time`.
    """

    at_once: float = 1.0
    spread: tuple[float, float] = (0.0, 1.0)
    choice: str = "random"
    held: int = 0
    priced: bool = False


LESSONS = {
    "teach-evenly": Lesson(at_once=0.0, spread=(0.0, 900.0)),
    "teach-some-later": Lesson(at_once=0.7, spread=(500.0, 1300.0)),
    "teach-oldest": Lesson(choice="oldest"),
    "teach-held": Lesson(held=150),
    "teach-dense": Lesson(choice="dense"),
    "teach-apart": Lesson(choice="apart"),
    "teach-gain": Lesson(choice="gain"),
    "teach-until-certain": Lesson(choice="until-certain"),
    "teach-priced": Lesson(priced=True),
    "teach-dense-apart": Lesson(choice="dense-apart"),
    "teach-gain-apart": Lesson(choice="gain-apart"),
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


def density(signals: Any) -> jax.Array:
    """Return f32[N], the sum of the similarities of moving robots to each robot, its own included."""
    return similarity(signals.obs) @ (~signals.violation).astype(jnp.float32)


def apart(config: Any, signals: Any, worth: jax.Array, chance: jax.Array) -> jax.Array:
    """Return f32[N], M for the robot that covers most of the fleet's `worth` f32[N], M - 1 for the next one, and so on.

    Robot j covers i by worth_i times their similarity, as in facility location. Robots whose human must stay count as picked.
    Ties are frequent (of two robots that are nearest to each other), and broken by `chance` f32[N].
    """
    moving = ~signals.violation
    covers = similarity(signals.obs) * jnp.where(moving, worth, 0.0)[:, None]
    bound = moving & signals.helped & (signals.help_time < config.min_teleop_time)
    covered = jnp.max(jnp.where(bound, covers, 0.0), axis=1)
    return pick(covers, covered, moving & ~bound, jnp.argsort(chance), config.num_humans)


class Moved(NamedTuple):
    """A step of a robot: f32[O] before and after it, and what it led to."""

    obs: jax.Array
    next_obs: jax.Array
    violation: jax.Array
    success: jax.Array


class Values(NamedTuple):
    """Two value networks and what they learn from: the steps of humans and those of robots."""

    params: Any
    target: Any
    opt_state: Any
    rings: tuple[Any, Any]


def make_gain(config: Any, env: Any, learner: Any, supervisor: Any) -> Estimator:
    """V_human - V_robot: what a state is worth if a human acts, and if the policy does.

    A success in k steps is worth 0.98^k, a violation -0.98^k. Both values learn by temporal differences, one from steps that
    humans did, one from those of the policy. They begin alike.
    """
    del learner, supervisor
    network, size = make_network(env.spec, config.hidden_sizes, 1), env.spec.observation_size

    def init(key, data, policy):
        one = network.init(key, jnp.zeros(size))
        params = jax.tree.map(lambda x: jnp.stack([x, x]), one)
        flag, obs = jnp.zeros((), bool), stored_obs(env.spec)
        ring = buffer.create(Moved(obs, obs, flag, flag), config.critic_capacity)
        return Values(params, jax.tree.map(jnp.copy, params), ADAM.init(params), (ring, jax.tree.map(jnp.copy, ring)))

    def both(params, policy, obs):  # f32[2, B], for obs f32[2, B, O]
        return jax.vmap(network.apply)(params, policy.normalizer(obs))[..., 0]

    def value(state, policy, obs, robot_action):
        human, robot = both(state.params, policy, jnp.stack([obs, obs]))
        return jnp.maximum(human - robot, 0.0)

    def append(state, steps, moving):
        rows = Moved(steps.obs, steps.next_obs, steps.violation, steps.success)
        masks = (moving & steps.given, moving & ~steps.given)
        rings = [buffer.append(ring, rows, mask, overwrite=True) for ring, mask in zip(state.rings, masks, strict=True)]
        return state._replace(rings=tuple(rings))

    def update(state, policy, data, key):
        drawn = [
            buffer.read(ring, buffer.draw_index(k, (config.batch_size,), ring.size))
            for ring, k in zip(state.rings, jax.random.split(key), strict=True)
        ]
        rows = jax.tree.map(lambda *x: jnp.stack(x), *drawn)
        known = jnp.stack([ring.size > 0 for ring in state.rings])[:, None]
        ended = rows.success.astype(jnp.float32) - rows.violation
        ahead = DISCOUNT * both(state.target, policy, rows.next_obs)
        goal = jnp.where(rows.success | rows.violation, ended, ahead)

        def loss(params):
            return jnp.mean(jnp.where(known, (both(params, policy, rows.obs) - goal) ** 2, 0.0))

        params, opt_state = descend(state.params, jax.grad(loss)(state.params), state.opt_state, config.learning_rate)
        return state._replace(params=params, opt_state=opt_state, target=optax.incremental_update(params, state.target, RATE))

    return Estimator(init, value, append, update)


# How much each moving robot is to be chosen: `(config, Signals[N], random numbers f32[N]) -> f32[N]`.
WORTH = {
    "random": lambda config, signals, chance: chance,
    "oldest": lambda config, signals, chance: chance * (signals.episode_step / 1000.0 + 1e-3) ** 3,
    "dense": lambda config, signals, chance: signals.uncertainty * density(signals),
    "apart": lambda config, signals, chance: apart(config, signals, jnp.ones_like(chance), chance),
    "gain": lambda config, signals, chance: signals.estimates["gain"] * chance,
    "until-certain": lambda config, signals, chance: chance + stays_uncertain(signals),
    "dense-apart": lambda config, signals, chance: apart(config, signals, signals.uncertainty * density(signals), chance),
    "gain-apart": lambda config, signals, chance: apart(config, signals, signals.estimates["gain"], chance),
}


# What C.U.R. sees instead of the uncertainty: `(config, Signals[N], random numbers f32[N]) -> f32[N]`.
DOUBT = {
    "cur-dense": lambda config, signals, chance: uncertain(config, signals) * density(signals),  # at least the uncertainty
    "cur-apart": lambda config, signals, chance: jnp.where(
        uncertain(config, signals) > 0,
        config.uncertainty_threshold + apart(config, signals, uncertain(config, signals), chance),
        0.0,
    ),
    "cur-gain": lambda config, signals, chance: signals.estimates["gain"],
    "cur-until-certain": lambda config, signals, chance: (
        signals.uncertainty + jnp.where(stays_uncertain(signals), config.uncertainty_threshold, 0.0)
    ),
}
CHANGES = (*DOUBT, "cur-priced")


def uncertain(config: Any, signals: Any) -> jax.Array:
    """Return f32[N], the uncertainty of robots that ask by it; 0 for the others."""
    return above(signals.uncertainty, config.uncertainty_threshold)


def stays_uncertain(signals: Any) -> jax.Array:
    """Return bool[N], robots with a human who are still more uncertain than half of the fleet."""
    return signals.helped & (signals.uncertainty > jnp.median(signals.uncertainty))


def follow(recent: jax.Array, signals: Any, price: jax.Array) -> jax.Array:
    """Return f32[], the mean squared correction of about the last 100 human actions.

    Each timestep without any adds 1 % of `price`, so humans act again after at most 100 timesteps, to see whether it pays.
    """
    acted = jnp.sum(signals.given.astype(jnp.float32))
    latest = jnp.sum(signals.correction) / jnp.maximum(acted, 1.0)
    learnt = recent + jnp.clip(acted / RECENT, 0.0, 1.0) * (latest - recent)
    return jnp.where(acted > 0, learnt, recent + price / 100.0)


def make_lesson(lesson: Lesson, config: Any) -> Priority:
    """Return the variant of Teach First."""
    begins, ends = lesson.spread

    def score(signals, memory, key):
        taught, recent = memory
        taught += jnp.sum(signals.given.astype(jnp.float32))
        share = taught / config.parameters["teaching_time"]
        allowed = lesson.at_once + (1 - lesson.at_once) * jnp.clip((signals.timestep - begins) / (ends - begins), 0, 1)
        early, over = share < 0.5, share >= allowed
        if lesson.priced:
            price = config.parameters["price"]
            recent = follow(recent, signals, price)
            early, over = recent >= 2.0 * price, recent < price
        value = WORTH[lesson.choice](config, signals, jax.random.uniform(key, signals.violation.shape)) + 1e-6
        waits, held = signals.violation & early, signals.helped & (signals.help_time < lesson.held) & early
        chosen = jnp.where(signals.violation | over, 0.0, value + held)
        return lexicographic(signals.violation & ~waits, chosen, waits), (taught, recent)

    return Priority(init=lambda: (jnp.zeros(()), jnp.full((), 4.0)), score=score)


def make_change(name: str, config: Any) -> Priority:
    """Return the variant of C.U.R.: it asks as C.U.R. does, but sees another uncertainty, or none where help no longer pays."""
    cur = get_algorithm("cur").make_priority(config)

    def score(signals, memory, key):
        taught, recent = memory
        if name == "cur-priced":
            recent = follow(recent, signals, config.parameters["price"])
            pays = recent >= config.parameters["price"]
            seen = {"uncertainty": jnp.where(pays, signals.uncertainty, 0.0), "risk": jnp.where(pays, signals.risk, 0.0)}
        else:
            chance = jax.random.uniform(key, signals.violation.shape)
            seen = {"uncertainty": DOUBT[name](config, signals, chance)}
        scores, taught = cur.score(signals._replace(**seen), taught, key)
        return scores, (taught, recent)

    return Priority(init=lambda: (cur.init(), jnp.full((), 4.0)), score=score)


def register() -> None:
    """Register the variants."""
    fleetjax.register_estimator("gain", make_gain)
    price = Field("mean squared correction of about 100 human actions below which humans stop", default=0.02)
    for name, variant in VARIANTS.items():
        own = {"help_until": Field("timestep at which the teaching ends", default=0.0)}
        estimators = ("safety",) if variant.choice == "risk" else ()
        fleetjax.register_priority(
            name, lambda config, variant=variant: make(variant, config), estimators=estimators, parameters=own
        )
    for name, lesson in LESSONS.items():
        own = {"teaching_time": Field("human timesteps of teaching", default=5500.0), "price": price}
        estimators = ("gain",) if "gain" in lesson.choice else ()
        fleetjax.register_priority(
            name, lambda config, lesson=lesson: make_lesson(lesson, config), estimators=estimators, parameters=own
        )
    for name in CHANGES:
        own = {**PARAMETERS["cur"], "price": price}
        estimators = ("safety", "gain") if name == "cur-gain" else ("safety",)
        fleetjax.register_priority(
            name, lambda config, name=name: make_change(name, config), estimators=estimators, parameters=own
        )


def main() -> None:
    """Run the variants that are asked for."""
    register()  # their parameters may follow after `--`
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", tuple(UNTIL))
    parser.add_argument("--variants", type=listed(str), default=[*VARIANTS], help="names [default: all with T]")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--until", type=float, help="T [default: one for each environment]")
    args, given = scripts.parse(parser)
    names = (*VARIANTS, *LESSONS, *CHANGES)
    if unknown := [name for name in args.variants if name not in names]:
        parser.error(f"unknown variants: {', '.join(unknown)}; choose from {', '.join(names)}")
    print("| environment | variant | successes | violations | human time | idle time |\n|---|---|---:|---:|---:|---:|")
    for environment in args.environments:
        for name in args.variants:
            own = {"help_until": UNTIL[environment] if args.until is None else args.until} if name in VARIANTS else {}
            known = all_fields(name)
            start = {} if name in CHANGES else {"initial_period": 0}
            settings = start | own | {field: value for field, value in given.items() if field in known}
            config = fleetjax.make_config(environment, name, **settings)
            totals = jax.tree.map(lambda x: int(x.sum()), fleetjax.run(config, jax.random.key(args.seed)).metrics)
            counts = (totals.successes, totals.violations, totals.human_steps, totals.idle)
            print(f"| {environment} | {name} | {' | '.join(map(text.count, counts))} |", flush=True)


if __name__ == "__main__":
    main()
