"""Help for robots that stand for many others: submodular allocation by facility location."""

import jax
import jax.numpy as jnp

from fleetjax import sharding
from fleetjax.allocation import Allocator, allocate, is_bound, tie_order
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.gates import known
from fleetjax.priority.ranks import above
from fleetjax.types import HumanState, Signals

UNCERTAINTY, RISK = 0.097, 0.903  # weights of the two
VIOLATION = 1e4
NEARNESS = 4.89  # how fast similarity falls with distance


def asa(config) -> Priority:
    """Score what each robot gains from being helped itself, for the allocator `by_coverage`: 0.097 U + 0.903 R + 10,000 C.

    U and R count as 0 below `asa_uncertainty` and `asa_risk`. Their defaults and the other numbers are those of the published
    code's settings file, tuned to its own ensemble and critic; its scripts have others for each robot. In the initial period
    (`initial_period`; 2,000 timesteps in the original) robots in violation score 0, and nobody helps them. The original only
    subtracts 10,000, so it may still pick such a robot to cover its neighbours.

    Reference: Akcin et al., Fleet supervisor allocation: a submodular maximization approach (ASA), 2024, and its published
    code.
    """

    def score(signals, key):
        del key
        early = signals.timestep < config.initial_period
        own = informativeness(config, signals) + VIOLATION * signals.violation.astype(jnp.float32)
        return jnp.where(signals.violation & early, 0.0, own)

    return stateless(score)


def informativeness(config, signals: Signals) -> jax.Array:
    """Return f32[N], 0.097 U + 0.903 R, each 0 below its threshold: what help for a similar robot is worth."""
    doubt = above(known(signals.uncertainty), config.parameters["asa_uncertainty"])
    risk = above(known(signals.risk), config.parameters["asa_risk"])
    return UNCERTAINTY * doubt + RISK * risk


def similarity(obs: jax.Array) -> jax.Array:
    """Return f32[N, N], 1 / (1 + 4.89 d) for the root mean squared distance d of observations f32[N, O].

    Observations are scaled by the fleet's own mean and deviation at this timestep, so that no unit counts more than another.
    The published code mixes similarities of states and of actions, and its settings give nearly all weight to actions.
    """
    deviation = jnp.std(obs, axis=0)
    scaled = known((obs - jnp.mean(obs, axis=0)) / jnp.where(deviation > 1e-6, deviation, 1.0))
    squares = jnp.sum(scaled**2, axis=1)
    apart = squares[:, None] + squares[None] - 2.0 * scaled @ scaled.T
    apart = jnp.where(jnp.eye(obs.shape[0], dtype=bool), 0.0, apart)  # rounded differently otherwise
    return 1.0 / (1.0 + NEARNESS * jnp.sqrt(jnp.maximum(apart, 0.0) / obs.shape[1]))


def by_coverage(config) -> Allocator:
    """Return the allocator that picks robots one by one, each time the one that adds most to what the picked robots cover.

    Robot j covers i by M_ij = similarity_ij informativeness_i, and itself by M_jj, its score: help ends the violation of that
    robot, not those of its neighbours. A set covers sum_i max_j M_ij. Robots that must keep their human count as picked. A
    pick's gain counts times the quality of the link to it, and picking stops when it is below `asa_threshold`. The original
    learns whether the link to one pick works before it makes the next; here links are drawn afterwards, and a pick counts as
    covered.
    """

    def cover(
        score: jax.Array,
        humans: HumanState,
        min_time: jax.Array,
        key: jax.Array,
        available: jax.Array | None = None,
        signals: Signals | None = None,
    ) -> HumanState:
        assert signals is not None
        n = score.shape[0]
        own = jnp.where(score > 0, score, 0.0)  # a NaN is not > 0
        shared = similarity(signals.obs.astype(jnp.float32)) * informativeness(config, signals)[:, None]
        covers = jnp.where(jnp.eye(n, dtype=bool), own, shared)
        stays = is_bound(humans, min_time) if available is None else available & is_bound(humans, min_time)
        bound = sharding.put(jnp.zeros(n, bool), jnp.where(stays, humans.robot, n), True)
        covered = jnp.max(jnp.where(bound[None], covers, 0.0), axis=1)
        link = jnp.ones(n, jnp.float32) if signals.link is None else signals.link
        places = tie_order(key, n)  # ties are broken by chance

        number, least = min(humans.robot.shape[0], n), config.parameters["asa_threshold"]
        order = pick(covers, covered, (own > 0) & ~bound, places, number, link=link, least=least)
        return allocate(order, humans, min_time, key, available)

    return cover


def pick(
    covers: jax.Array,
    covered: jax.Array,
    left: jax.Array,
    places: jax.Array,
    number: int,
    *,
    link: jax.Array | float = 1.0,
    least: jax.Array | float = 0.0,
) -> jax.Array:
    """Pick robots one by one, each time the one whose gain is largest, by greedy facility location.

    Args:
        covers: f32[N, N], entry (i, j): how much of robot i is covered if j is picked.
        covered: f32[N], what is covered already.
        left: bool[N], robots that may be picked.
        places: i32[N], the robots in the order in which ties are broken.
        number: of picks, at most N.
        link: f32[N], a factor of each robot's gain.
        least: gain below which nobody is picked.

    Returns:
        f32[N]: `number` for the first pick, `number` - 1 for the second, and so on; 0 for the others.
    """
    n = covered.shape[0]

    def turn_of(carry: tuple[jax.Array, jax.Array, jax.Array], turn: jax.Array):
        covered, order, left = carry
        gain = jnp.sum(jnp.maximum(covers - covered[:, None], 0.0), axis=0) * link
        gain = jnp.where(left, gain, -1.0)
        best = places[jnp.argmax(gain[places])]
        good = gain[best] >= least
        order = order.at[jnp.where(good, best, n)].set(turn, mode="drop")
        covered = jnp.where(good, jnp.maximum(covered, covers[:, best]), covered)
        return (covered, order, left.at[best].set(False)), None

    turns = jnp.arange(number, 0, -1).astype(jnp.float32)
    return jax.lax.scan(turn_of, (covered, jnp.zeros(n, jnp.float32), left), turns)[0][1]


COVERAGE: dict[str, Algorithm] = {
    "asa": Algorithm(asa, estimators=("safety",), make_allocate=by_coverage, parameters=PARAMETERS["asa"]),
}
