"""Priority functions: exact orders, thresholds, running moments, and the registry."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from hypothesis import given
from hypothesis import strategies as st
from reference import oracle

import fleetjax
from fleetjax import priority
from fleetjax.config import Config
from fleetjax.priority import dagger
from fleetjax.types import Signals

NUM_ROBOTS = 6
ORDERS = [name for name in fleetjax.list_algorithms() if set(name) <= set("cur")]
CONFIG = Config().replace(uncertainty_threshold=0.3, risk_threshold=0.5, initial_period=10)
# Few values, so that ties are frequent; thresholds among them.
levels = st.sampled_from([0.0, 0.1, np.float32(0.3), 0.5, 0.7, 1.0, float("nan")])
columns = st.lists(levels, min_size=NUM_ROBOTS, max_size=NUM_ROBOTS).map(lambda values: np.array(values, np.float32))
flags = st.lists(st.booleans(), min_size=NUM_ROBOTS, max_size=NUM_ROBOTS).map(np.array)
timesteps = st.sampled_from([9, 10])  # the initial period's last, and the next
all_signals = st.tuples(flags, columns, columns, columns, timesteps).map(lambda values: Signals(*values))


@functools.cache
def scorer(name: str):
    """Return a compiled `(Config, Signals) -> score` of a first timestep."""

    def first(config, signals):
        rule = priority.get_algorithm(name).make_priority(config)
        return rule.score(signals, rule.init(), jax.random.key(0))[0]

    return compiled(first)


def score(name: str, signals: Signals, **parameters) -> np.ndarray:
    """Return scores[N] of a first timestep."""
    return np.asarray(scorer(name)(CONFIG.replace(algorithm=name, **parameters), signals))


def thresholded(values: np.ndarray, threshold: float) -> list[float]:
    return [float(value) if value >= np.float32(threshold) else 0.0 for value in values]


def test_all_orders_of_distinct_letters_are_algorithms():
    assert set(ORDERS) == {"c", "u", "r", "cu", "cr", "uc", "ur", "rc", "ru", "cur", "cru", "ucr", "urc", "rcu", "ruc"}
    assert len(ORDERS) == 15


@pytest.mark.parametrize("name", [*ORDERS, "ensemble_dagger"])
@given(signals=all_signals)
def test_an_order_is_that_of_python_tuples(name, signals):
    letters = "uc" if name == "ensemble_dagger" else name
    values = {
        "c": signals.violation.astype(float).tolist(),
        "u": thresholded(signals.uncertainty, 0.3),
        "r": thresholded(signals.risk, 0.5),
    }
    postponed = signals.violation & (signals.timestep < 10) & ("c" in name)
    rows = zip(*(np.where(postponed, 0.0, values[letter]).tolist() for letter in letters), strict=True)
    assert score(name, signals).tolist() == oracle.rank(list(rows))


@pytest.mark.parametrize("name", [name for name in ORDERS if "c" in name])
@given(signals=all_signals)
def test_idle_humans_teleoperate_at_random_behind_all_who_are_needed(name, signals):
    scores, usual = score(name, signals, idle_humans_teleoperate=True), score(name, signals)
    free = (usual == 0) & ~signals.violation & (signals.timestep < 10)
    np.testing.assert_array_equal(scores[~free], usual[~free])
    assert np.all((scores[free] > 0) & (scores[free] < 1))  # ranks begin at 1
    assert len(np.unique(scores[free])) == free.sum()


@given(st.lists(columns, min_size=3, max_size=3))
def test_lexicographic_scores_are_dense_ranks_of_the_tuples(table):
    rows = [tuple(float(x) for x in np.nan_to_num(row)) for row in np.stack(table, axis=1)]
    ranks = np.asarray(quick_lexicographic(*table))
    for a, first in enumerate(rows):
        for b, second in enumerate(rows):
            assert (first > second) == (ranks[a] > ranks[b])
        assert (ranks[a] == 0) == (not any(first))
    assert set(ranks) | {0.0} == set(range(int(ranks.max()) + 1))


quick_lexicographic = compiled(priority.lexicographic)


@pytest.mark.parametrize("name", ["cur", "ur", "ensemble_dagger", "constraint"])
@given(signals=all_signals, data=st.data())
def test_permuting_robots_permutes_scores(name, signals, data):
    order = np.array(data.draw(st.permutations(range(NUM_ROBOTS))))
    permuted = jax.tree.map(lambda x: x[order], signals._replace(timestep=None))._replace(timestep=signals.timestep)
    np.testing.assert_array_equal(score(name, permuted), score(name, signals)[order])


@given(st.lists(columns, min_size=1, max_size=4), columns)
def test_running_moments_are_those_of_all_values_so_far(batches, other):
    batches = [np.stack([np.nan_to_num(batch), np.nan_to_num(other)], axis=1) for batch in batches]
    moments = dagger.Moments(jnp.zeros(()), jnp.zeros(2), jnp.zeros(2))
    for batch in batches:
        moments = dagger.update_moments(moments, jnp.array(batch))
    together = np.concatenate(batches)
    assert int(moments.number) == len(together)
    np.testing.assert_allclose(moments.mean, together.mean(axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(moments.squares, together.var(axis=0) * len(together), rtol=1e-4, atol=1e-5)


def test_random_scores_are_uniform_and_zero_below_the_threshold():
    rule = priority.get_algorithm("random").make_priority(CONFIG.replace(algorithm="random", random_threshold=0.6))
    none = jnp.zeros(1000)
    signals = Signals(none.astype(bool), none, none, none, jnp.int32(0))
    scores = np.asarray(rule.score(signals, (), jax.random.key(3))[0])
    asked = scores[scores > 0]
    assert asked.min() >= 0.6
    assert asked.max() < 1.0
    assert 340 <= asked.size <= 460  # four deviations around 400
    assert abs(asked.mean() - 0.8) < 0.03


def test_an_unknown_algorithm_is_refused_with_the_closest_names():
    with pytest.raises(ValueError, match="algorithm = 'thrifty' is unknown; the closest are thrifty_dagger"):
        priority.get_algorithm("thrifty")


def test_a_registered_priority_is_an_algorithm():
    def make_least_certain(config):
        def score(signals, aux, key):
            return jnp.where(signals.violation, 1.0, signals.uncertainty), aux

        return fleetjax.Priority(init=lambda: (), score=score)

    fleetjax.register_priority("least_certain", make_least_certain, estimators=("goal",))
    assert "least_certain" in fleetjax.list_algorithms()
    assert priority.get_algorithm("least_certain").estimators == ("goal",)
    with pytest.raises(ValueError, match="'least_certain' is already registered"):
        fleetjax.register_priority("least_certain", make_least_certain)
    fleetjax.register_priority("other", make_least_certain, estimators=("risk",))
    with pytest.raises(ValueError, match="estimator = 'risk' is unknown; the closest are"):
        jax.eval_shape(fleetjax.run, fleetjax.make_config("navigation", "other"), jax.random.key(0))
