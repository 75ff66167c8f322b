"""People who are not perfect supervisors: they take time, make mistakes, answer late, tire, and are away at times."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from fleetjax.allocation import helper_of, tie_order
from fleetjax.envs import EnvSpec
from fleetjax.priority import PerRobot
from fleetjax.registry import Registry
from fleetjax.types import Plan

LONGEST_DELAY = 10  # timesteps of `action_delay` at most: so many actions are remembered for each robot
LONGEST_WAIT = 1e6  # timesteps, in which whole numbers are exact
TIRING = 1000.0  # timesteps within which fatigue follows how busy a human is


class HumanModel(NamedTuple):
    """What stands between the simulated supervisor and the robots.

    Attributes:
        init: `(config, key) -> aux`, at t = 0.
        available: `(aux, key) -> bool[M]`, the humans who are there.
        act: `(aux, Plan, action f32[N, A], key) -> (aux, action f32[N, A], given bool[N])`: turns the supervisor's actions into
            what humans really do, and says on which robots they act. On the others their own policy acts, and nothing is
            recorded. Its key differs from that of `available`.
        unready: `aux -> i32[M]`, timesteps of the current intervention that each human spent taking over; they do not count
            towards t_T, the shortest teleoperation. None = 0.
    """

    init: Callable[[Any, jax.Array], Any]
    available: Callable[[Any, jax.Array], jax.Array]
    act: Callable[[Any, Plan, jax.Array, jax.Array], tuple[Any, jax.Array, jax.Array]]
    unready: Callable[[Any], jax.Array] | None = None


class People(NamedTuple):
    """What the imperfect humans carry from one timestep to the next.

    Attributes:
        robot: i32[M] whom they helped at the last timestep, -1 = nobody.
        wait: i32[M] timesteps until they act on it, counting the last timestep.
        unready: i32[M] timesteps of the current intervention that they spent waiting.
        busy: f32[M] share of the last timesteps in which they were busy, in [0, 1].
        away: bool[M].
        past: f32[N, LONGEST_DELAY, A] what the supervisor would have done on each robot, the latest first.
    """

    robot: jax.Array
    wait: jax.Array
    unready: jax.Array
    busy: jax.Array
    away: jax.Array
    past: PerRobot


def per_human(value: Any, num_humans: int) -> jax.Array:
    """Return f32[M], the value of a parameter for each human: one for all, or a tuple of M."""
    if isinstance(value, tuple):
        return jnp.stack([jnp.asarray(x, jnp.float32) for x in value])
    return jnp.full(num_humans, value, jnp.float32)


def takeover_times(mean: jax.Array, spread: jax.Array, key: jax.Array) -> jax.Array:
    """Return f32[M] draws from lognormal distributions with means f32[M] and standard deviations `spread` times these.

    Reference: Zhang et al., Determinants of take-over time, 2019, a meta-analysis of 129 studies: the standard deviation is in
    proportion to the mean, which is about 2.7 s.
    """
    variance = jnp.log1p(spread**2)
    return mean * jnp.exp(jnp.sqrt(variance) * jax.random.normal(key, mean.shape) - variance / 2)


def make_imperfect(config: Any, spec: EnvSpec) -> HumanModel:
    """Build the model whose parameters are `action_noise` to `absence_time` of `Config`.

    - Takeover: a human acts on a new robot only after a takeover time, and `switching_lag` more after another robot. The sum is
      rounded up or down by chance, so that its mean is kept. Meanwhile the robot's policy acts, and the human's time counts.
      The shortest teleoperation t_T starts after the takeover. Hard resets take t_R, as ever.
    - Delay: the human reacts to the robot's state of `action_delay` timesteps ago (rounded), or to its first after a reset.
    - Skill: normal noise on continuous actions, and a random action in its place with `mistake_rate`.
    - Fatigue: takeover time and noise are multiplied by 1 + `fatigue` b, for the share b of recent time in which the human was
      busy.
    - Absence: each human comes and goes as a two-state chain, away for a share `absence` of the time.

    With all of them 0, humans do what perfect ones do.
    """
    n, m = config.num_robots, config.num_humans
    fields = ("action_noise", "mistake_rate", "takeover_time", "takeover_spread", "action_delay", "switching_lag", "fatigue")
    noise, mistakes, takeover, spread, delay, lag, fatigue, absence, absence_time = (
        per_human(getattr(config, name), m) for name in (*fields, "absence", "absence_time")
    )

    def init(config: Any, key: jax.Array) -> People:
        del config
        away = jax.random.uniform(key, (m,)) < absence
        nobody, none = jnp.full(m, -1, jnp.int32), jnp.zeros(m, jnp.int32)
        past = PerRobot(jnp.zeros((n, LONGEST_DELAY, spec.action_size)))
        return People(nobody, none, none, jnp.zeros(m, jnp.float32), away, past)

    def available(people: People, key: jax.Array) -> jax.Array:
        del key
        return ~people.away

    def act(people: People, plan: Plan, action: jax.Array, key: jax.Array) -> tuple[People, jax.Array, jax.Array]:
        key_time, key_round, key_noise, key_whether, key_what, key_away = jax.random.split(key, 6)
        robot, tired = plan.humans.robot, 1.0 + fatigue * people.busy
        comes = (robot >= 0) & (robot != people.robot)
        pause = takeover_times(takeover * tired, spread, key_time) + jnp.where(people.robot >= 0, lag, 0.0)
        whole = jnp.floor(jnp.minimum(pause, LONGEST_WAIT) + jax.random.uniform(key_round, (m,))).astype(jnp.int32)
        wait = jnp.where(comes, whole, jnp.maximum(people.wait - 1, 0))
        waits = (robot >= 0) & (wait > 0)
        unready = jnp.where(plan.humans.duration > 0, people.unready, 0) + waits.astype(jnp.int32)
        helper = helper_of(plan.humans, n)
        given = plan.teleoperated & (wait == 0)[helper]
        steps = jnp.minimum(jnp.round(delay).astype(jnp.int32)[helper], plan.signals.episode_step)
        seen = jnp.concatenate([action[:, None], people.past.values], axis=1)
        done = jnp.take_along_axis(seen, steps[:, None, None], axis=1)[:, 0]
        deviation = (noise * tired)[helper][:, None]
        if not spec.discrete:
            noisy = jnp.clip(done + deviation * jax.random.normal(key_noise, done.shape), -1.0, 1.0)
            done = jnp.where(deviation > 0, noisy, done)
        wrong = jax.random.uniform(key_whether, (n,)) < mistakes[helper]
        done = jnp.where(wrong[:, None], _any_action(spec, n, key_what), done)
        leaves = absence / ((1.0 - absence) * absence_time)
        chance = jax.random.uniform(key_away, (m,))
        away = jnp.where(people.away, chance >= 1.0 / absence_time, chance < leaves)
        busy = people.busy + ((robot >= 0).astype(jnp.float32) - people.busy) / TIRING
        past = PerRobot(seen[:, :LONGEST_DELAY])
        return People(robot, wait, unready, busy, away, past), jnp.where(given[:, None], done, action), given

    return HumanModel(init, available, act, lambda people: people.unready)


def _any_action(spec: EnvSpec, number: int, key: jax.Array) -> jax.Array:
    if spec.discrete:
        return jax.nn.one_hot(jax.random.randint(key, (number,), 0, spec.action_size), spec.action_size)
    return jax.random.uniform(key, (number, spec.action_size), minval=-1.0)


class Lines(NamedTuple):
    """The robots' connections to the humans.

    Attributes:
        works: bool[N] whether each worked at the last timestep.
        poor: bool[N] which are poor, in models with poor and good ones.
        run_length: f32[N] timesteps of the whole run, of which a program may compute a part.
    """

    works: jax.Array
    poor: jax.Array
    run_length: jax.Array


class Links(NamedTuple):
    """How connections work and fail.

    Attributes:
        init: `key -> Lines`, at t = 0.
        quality: `(Lines, timestep i32[]) -> f32[N]`, the chance that each works at this timestep: `Signals.link`.
    """

    init: Callable[[jax.Array], Lines]
    quality: Callable[[Lines, jax.Array], jax.Array]


def _lines(config: Any, works: jax.Array, poor: jax.Array) -> Lines:
    return Lines(works, poor, jnp.full(config.num_robots, config.num_steps, jnp.float32))


def draw(quality: jax.Array, key: jax.Array) -> jax.Array:
    """Return bool[N], which links work at a timestep; over one that does not, no action of a human arrives."""
    return jax.random.uniform(key, quality.shape) < quality


def make_gilbert_elliott(config: Any) -> Links:
    """Links that fail with `link_failure_rate` b and are repaired with `link_repair_rate` a, at each timestep.

    In the long run a share b / (a + b) of them does not work.

    Reference: Gilbert, Capacity of a burst-noise channel, 1960; Elliott, 1963.
    """
    failure, repair = config.link_failure_rate, config.link_repair_rate

    def init(key: jax.Array) -> Lines:
        works = jax.random.uniform(key, (config.num_robots,)) >= failure / jnp.maximum(failure + repair, 1e-9)
        return _lines(config, works, jnp.zeros(config.num_robots, bool))

    return Links(init, lambda lines, timestep: jnp.where(lines.works, 1.0 - failure, repair))


POOR, GOOD, POOR_TENTHS = 0.2, 0.9, 7  # chances that links work, and how many of ten robots have poor ones
SWAP_BEGINS, SWAP_ENDS = 0.2, 0.8  # shares of the run


def make_unequal(config: Any) -> Links:
    """Links of which a random 70 % work with chance 0.2, the others with 0.9, at each timestep.

    Reference: the static scenario of ASA's published code (Fleet-Supervisor-Allocation). There links are drawn once, when a
    human is assigned, and hard resets need them too. A human whose link fails does not come at all, and can help nobody for
    as long as a hard reset takes.
    """

    def init(key: jax.Array) -> Lines:
        n = config.num_robots
        poor = jnp.zeros(n, bool).at[tie_order(key, n)[: n * POOR_TENTHS // 10]].set(True)
        return _lines(config, jnp.ones(n, bool), poor)

    def quality(lines: Lines, timestep: jax.Array) -> jax.Array:
        del timestep
        return jnp.where(lines.poor, POOR, GOOD).astype(jnp.float32)

    return Links(init, quality)


def make_swapping(config: Any) -> Links:
    """Links as `make_unequal` has them, whose chances change over to each other's between 20 % and 80 % of the run, linearly.

    Reference: the changing scenario of ASA's published code (Fleet-Supervisor-Allocation), with the differences that
    `make_unequal` names.
    """
    init, before = make_unequal(config)

    def quality(lines: Lines, timestep: jax.Array) -> jax.Array:
        done = timestep.astype(jnp.float32) / lines.run_length
        share = jnp.clip((done - SWAP_BEGINS) / (SWAP_ENDS - SWAP_BEGINS), 0.0, 1.0)
        chance = before(lines, timestep)
        return chance + share * (POOR + GOOD - 2.0 * chance)

    return Links(init, quality)


# Each is `(config, EnvSpec) -> HumanModel`; None = a perfect human, who needs no model.
HUMAN_MODELS: Registry[Callable[[Any, EnvSpec], HumanModel] | None] = Registry("human_model")
for _name, _make in {"perfect": None, "imperfect": make_imperfect}.items():
    HUMAN_MODELS.register(_name, _make)

# Each is `config -> Links`; None = links that always work.
LINK_MODELS: Registry[Callable[[Any], Links] | None] = Registry("link_model")
_LINKS = {"perfect": None, "gilbert_elliott": make_gilbert_elliott, "unequal": make_unequal, "swapping": make_swapping}
for _name, _make_links in _LINKS.items():
    LINK_MODELS.register(_name, _make_links)


def register_human_model(name: str, make: Callable[[Any, EnvSpec], HumanModel]) -> None:
    """Make a human model available as `human_model = name`.

    Args:
        name: what `make_config` calls it.
        make: `(config, EnvSpec) -> HumanModel`.

    Raises:
        ValueError: if the name is taken.
    """
    HUMAN_MODELS.register(name, make)
