"""Priority functions: from signals of the robots to who should get help first (paper, Section 4.2).

A priority is two pure functions. A new one is about ten lines:

    def make_least_certain(config):
        def score(signals, aux, key):
            return jnp.where(signals.violation, 1.0, signals.uncertainty), aux

        return Priority(init=lambda: (), score=score)

    fleetjax.register_priority("least_certain", make_least_certain)
"""

import difflib
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from fleetjax.types import Signals


class Priority(NamedTuple):
    """A rule for who gets help.

    Attributes:
        init: `() -> aux`, what the rule carries from one timestep to the next.
        score: `(Signals[N], aux, key) -> (f32[N], aux)`, scores >= 0; 0 = no help even if a human is free.
    """

    init: Callable[[], Any]
    score: Callable[[Signals, Any, jax.Array], tuple[jax.Array, Any]]


class Algorithm(NamedTuple):
    """A priority and what the fleet must learn for it.

    Attributes:
        make_priority: `config -> Priority`.
        critics: critics to train, out of `"safety"` (gives the risk) and `"goal"`.
        pretrains: whether demonstrations are collected and the policy is cloned before the fleet starts.
        updates: whether human data are recorded and learnt from while the fleet runs.
    """

    make_priority: Callable[[Any], Priority]
    critics: tuple[str, ...] = ()
    pretrains: bool = True
    updates: bool = True


def lexicographic(*columns: jax.Array) -> jax.Array:
    """Return scores f32[N] that order robots by the first column, then the second, and so on.

    Scores are dense ranks: equal rows are equal, and a row of zeros scores 0.

    Args:
        columns: f32[N] each, >= 0, most important first.

    >>> lexicographic(jnp.array([0.0, 1.0, 1.0, 0.0]), jnp.array([0.3, 0.0, 0.2, 0.0])).tolist()
    [1.0, 2.0, 3.0, 0.0]
    """
    table = jnp.stack([jnp.nan_to_num(column.astype(jnp.float32)) for column in columns])
    order = jnp.lexsort(table[::-1])
    ranked = table[:, order]
    first = jnp.any(ranked[:, :1] > 0, axis=0)
    rises = jnp.any(ranked[:, 1:] != ranked[:, :-1], axis=0)
    ranks = jnp.cumsum(jnp.concatenate([first, rises]))
    return jnp.zeros(order.shape, jnp.float32).at[order].set(ranks.astype(jnp.float32))


def above(values: jax.Array, threshold: jax.Array) -> jax.Array:
    """Return `values`, with those below `threshold` set to 0."""
    return jnp.where(values >= threshold, values, 0.0)


def _stateless(score: Callable[[Signals, jax.Array], jax.Array]) -> Priority:
    return Priority(init=lambda: (), score=lambda signals, aux, key: (score(signals, key), aux))


def constraint(config) -> Priority:
    """C: robots in violation, all alike (paper, Section 4.2, Constraint)."""
    del config
    return _stateless(lambda signals, key: signals.violation.astype(jnp.float32))


def everyone(config) -> Priority:
    """All robots alike; with as many humans as robots this is full teleoperation (paper, Appendix, Expert)."""
    del config
    return _stateless(lambda signals, key: jnp.ones_like(signals.uncertainty))


def uniform(config) -> Priority:
    """Random: U(0, 1) for each robot and timestep, 0 below `random_threshold` (paper, Section 4.2, Random)."""

    def score(signals, key):
        return above(jax.random.uniform(key, signals.uncertainty.shape), config.random_threshold)

    return _stateless(score)


def ensemble_dagger(config) -> Priority:
    """U.C.: uncertainty above its threshold, then violations (paper, Section 4.2, Fleet-EnsembleDAgger)."""

    def score(signals, key):
        del key
        return lexicographic(above(signals.uncertainty, config.uncertainty_threshold), signals.violation)

    return _stateless(score)


class Moments(NamedTuple):
    """Running moments of two quantities: number f32[], mean f32[2], sum of squared deviations f32[2]."""

    number: jax.Array
    mean: jax.Array
    squares: jax.Array


def update_moments(moments: Moments, values: jax.Array) -> Moments:
    """Return the moments with `values` f32[N, 2] added (Chan's parallel formula)."""
    added = jnp.float32(values.shape[0])
    number = moments.number + added
    mean = jnp.mean(values, axis=0)
    shift = mean - moments.mean
    squares = moments.squares + jnp.sum((values - mean) ** 2, axis=0) + shift**2 * moments.number * added / number
    return Moments(number, moments.mean + shift * added / number, squares)


def thrifty_dagger(config) -> Priority:
    """U.G.C.: normalised uncertainty and chance of failure above a threshold, then violations.

    The sum is (1 - w) z(U) + w z(1 - Q_G) with w = `thrifty_weight`; z by running moments over all robot-steps so far.

    Reference: paper, Section 4.2, Fleet-ThriftyDAgger.
    """

    def init():
        return Moments(jnp.zeros(()), jnp.zeros(2), jnp.zeros(2))

    def score(signals, moments, key):
        del key
        values = jnp.stack([signals.uncertainty, 1.0 - signals.goal], axis=1)
        moments = update_moments(moments, values)
        variance = jnp.maximum(moments.squares / moments.number, 1e-16)  # below the root: a root's slope at 0 is infinite
        z = (values - moments.mean) / jnp.sqrt(variance)
        combined = (1 - config.thrifty_weight) * z[:, 0] + config.thrifty_weight * z[:, 1]
        excess = jnp.maximum(combined - config.thrifty_threshold, 0.0)
        return lexicographic(excess, signals.violation), moments

    return Priority(init, score)


def in_order(letters: str) -> Callable[[Any], Priority]:
    """Return the maker of a priority by the letters C, U and R in any order, such as C.U.R.

    C is violation, U uncertainty above its threshold, R risk above its threshold. Orders that contain C give violating
    robots priority 0 in the initial period.

    Reference: paper, Section 4.2 (C.U.R.) and Appendix (ablations).
    """

    def make(config) -> Priority:
        def score(signals, key):
            del key
            columns = {
                "c": signals.violation,
                "u": above(signals.uncertainty, config.uncertainty_threshold),
                "r": above(signals.risk, config.risk_threshold),
            }
            ranks = lexicographic(*(columns[letter] for letter in letters))
            if "c" not in letters:
                return ranks
            postponed = signals.violation & (signals.timestep < config.initial_period)
            return jnp.where(postponed, 0.0, ranks)

        return _stateless(score)

    return make


_ALGORITHMS: dict[str, Algorithm] = {
    "constraint": Algorithm(constraint, updates=False),
    "random": Algorithm(uniform),
    "ensemble_dagger": Algorithm(ensemble_dagger),
    "thrifty_dagger": Algorithm(thrifty_dagger, critics=("goal",)),
    "expert": Algorithm(everyone, pretrains=False, updates=False),
}
for _size in (3, 2, 1):
    for _letters in map("".join, itertools.permutations("cur", _size)):
        _ALGORITHMS[_letters] = Algorithm(in_order(_letters), critics=("safety",) if "r" in _letters else ())


def register_algorithm(name: str, algorithm: Algorithm) -> None:
    """Make an algorithm available to `make_config` under `name`.

    Raises:
        ValueError: if the name is taken.
    """
    if name in _ALGORITHMS:
        raise ValueError(f"algorithm = {name!r} is registered already; choose another name")
    _ALGORITHMS[name] = algorithm


def register_priority(name: str, make_priority: Callable[[Any], Priority], *, critics: tuple[str, ...] = ("safety",)) -> None:
    """Make a priority available as an algorithm that clones demonstrations and learns from interventions.

    Args:
        name: what `make_config` calls it.
        make_priority: `config -> Priority`.
        critics: the critics whose signals it reads: `"safety"` for `risk`, `"goal"` for `goal`.

    Raises:
        ValueError: if the name is taken or a critic is unknown.
    """
    if not set(critics) <= {"safety", "goal"}:
        raise ValueError(f"critics = {critics!r}: choose out of 'safety' and 'goal'")
    register_algorithm(name, Algorithm(make_priority, critics=tuple(critics)))


def list_algorithms() -> tuple[str, ...]:
    """Return the registered names, orders of C, U and R included."""
    return tuple(_ALGORITHMS)


def get_algorithm(name: str) -> Algorithm:
    """Return a registered algorithm.

    Raises:
        ValueError: if there is none of that name; the message has the closest ones.
    """
    if not isinstance(name, str) or name not in _ALGORITHMS:
        raise ValueError(unknown("algorithm", name, _ALGORITHMS))
    return _ALGORITHMS[name]


def unknown(field: str, name: object, known) -> str:
    """Return the message for an unknown name, with the closest known ones."""
    close = difflib.get_close_matches(str(name), list(known), n=3, cutoff=0.3) or list(known)
    return f"{field} = {name!r} is unknown; the closest are {', '.join(close)}"
