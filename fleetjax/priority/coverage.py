"""Help for robots that stand for many others: submodular allocation by facility location."""

import jax
import jax.numpy as jnp

from fleetjax.allocation import Allocator, allocate, is_bound
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.gates import known
from fleetjax.priority.ranks import above
from fleetjax.types import HumanState, Signals

UNCERTAINTY, RISK = 0.097, 0.903  # weights of the two
VIOLATION = 1e4
NEARNESS = 4.89  # how fast similarity falls with distance


def asa(config) -> Priority:
    """Weights of robots for the allocator `by_coverage`: 0.097 U + 0.903 R, and 10,000 C after the initial period.

    U and R count as 0 below their thresholds. The published code has 0.151 and 0.198 for its own ensemble and critic; here
    they are those of the environment, as for C.U.R.

    Reference: Adaptive submodular allocation (ASA), published code of Fleet-Supervisor-Allocation.
    """

    def score(signals, key):
        del key
        doubt = above(known(signals.uncertainty), config.uncertainty_threshold)
        risk = above(known(signals.risk), config.risk_threshold)
        late = signals.timestep >= config.initial_period
        return UNCERTAINTY * doubt + RISK * risk + VIOLATION * (signals.violation & late).astype(jnp.float32)

    return stateless(score)


def similarity(obs: jax.Array) -> jax.Array:
    """Return f32[N, N], 1 / (1 + 4.89 d) for the root mean squared distance d of observations f32[N, O].

    Observations are scaled by the fleet's own mean and deviation at this timestep.
    """
    deviation = jnp.std(obs, axis=0)
    scaled = known((obs - jnp.mean(obs, axis=0)) / jnp.where(deviation > 1e-6, deviation, 1.0))
    squares = jnp.sum(scaled**2, axis=1)
    apart = squares[:, None] + squares[None] - 2.0 * scaled @ scaled.T
    apart = jnp.where(jnp.eye(obs.shape[0], dtype=bool), 0.0, apart)  # rounded differently otherwise
    return 1.0 / (1.0 + NEARNESS * jnp.sqrt(jnp.maximum(apart, 0.0) / obs.shape[1]))


def by_coverage(config) -> Allocator:
    """Return the allocator that picks robots one by one, each time the one that covers most of what is not covered yet.

    Robot j covers i by M_ij = similarity_ij weight_i. A set covers sum_i max_j M_ij; those who are bound to a human are in
    it already. A pick's gain counts times the quality of the link to it, and picking stops when it is below `asa_threshold`.
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
        weight = jnp.where(score > 0, score, 0.0)  # a NaN is not > 0
        covers = similarity(signals.obs.astype(jnp.float32)) * weight[:, None]
        bound = jnp.zeros(n, bool).at[jnp.where(is_bound(humans, min_time), humans.robot, n)].set(True, mode="drop")
        covered = jnp.max(jnp.where(bound[None], covers, 0.0), axis=1)
        link = jnp.ones(n, jnp.float32) if signals.link is None else signals.link

        def pick(carry: tuple[jax.Array, jax.Array, jax.Array], turn: jax.Array):
            covered, order, left = carry
            gain = jnp.sum(jnp.maximum(covers - covered[:, None], 0.0), axis=0) * link
            gain = jnp.where(left, gain, -1.0)
            best = jnp.argmax(gain)
            good = gain[best] >= config.parameters["asa_threshold"]
            order = order.at[jnp.where(good, best, n)].set(turn, mode="drop")
            covered = jnp.where(good, jnp.maximum(covered, covers[:, best]), covered)
            return (covered, order, left.at[best].set(False)), None

        number = min(humans.robot.shape[0], n)
        turns = jnp.arange(number, 0, -1).astype(jnp.float32)
        start = (covered, jnp.zeros(n, jnp.float32), (weight > 0) & ~bound)
        order = jax.lax.scan(pick, start, turns)[0][1]
        return allocate(order, humans, min_time, key, available)

    return cover


COVERAGE: dict[str, Algorithm] = {
    "asa": Algorithm(asa, estimators=("safety",), make_allocate=by_coverage, parameters=PARAMETERS["asa"]),
}
