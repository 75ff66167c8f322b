"""Rules for help beside the paper's: each against a transcription of its equations in NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from hypothesis import given
from hypothesis import strategies as st

import fleetjax
from fleetjax import HumanState, Signals, priority
from fleetjax.fleet import make_parts
from fleetjax.learning import buffer, help, networks, novelty
from fleetjax.learning.critic import Transition
from fleetjax.priority import coverage, quantiles, whittle

N, ACTIONS = 12, 3
CONFIG = fleetjax.make_config("navigation", num_robots=N, num_humans=4, initial_period=0)


def signals_at(t: int, seed: int = 0, **changes) -> Signals:
    """Return signals of 12 robots: some violated, some helped, some teleoperated by humans who differ from them."""
    rng = np.random.default_rng([seed, t])
    flags = [rng.random(N) < 0.2, rng.random(N) < 0.4]
    violation, helped = map(jnp.asarray, flags)
    unit = lambda *shape: jnp.asarray(rng.random(shape), jnp.float32)  # noqa: E731
    given = helped & ~violation & jnp.asarray(rng.random(N) < 0.8)
    correction = jnp.where(given & jnp.asarray(rng.random(N) < 0.8), unit(N), 0.0)  # some humans agree with their robots
    names = ("safety", "goal", "discrepancy", "mean_discrepancy", "novelty", "intervention", "divergence")
    signals = Signals(
        violation=violation,
        uncertainty=unit(N) * 0.2,
        risk=unit(N),
        goal=unit(N),
        timestep=jnp.int32(t),
        estimates={name: 2 * unit(N) if name == "novelty" else unit(N) for name in names},
        obs=unit(N, 5),
        robot_action=2 * unit(N, ACTIONS) - 1,
        helped=helped,
        help_time=helped.astype(jnp.int32),
        given=given,
        correction=correction,
        human_action=2 * unit(N, ACTIONS) - 1,
        link=jnp.ones(N, jnp.float32),
    )
    return signals._replace(**changes)


@functools.cache
def scorer(name: str):
    return compiled(
        lambda config, signals, aux, key: priority.get_algorithm(name).make_priority(config).score(signals, aux, key)
    )


def scores_of(name: str, steps: list[Signals], **parameters) -> list[np.ndarray]:
    """Return the scores of consecutive timesteps."""
    config = CONFIG.replace(algorithm=name, **parameters)
    aux, found = priority.get_algorithm(name).make_priority(config).init(), []
    for t, signals in enumerate(steps):
        score, aux = scorer(name)(config, signals, aux, jax.random.key(t))
        found.append(np.asarray(score))
    return found


def ranks(asking, violation) -> list[float]:
    """Return dense ranks of (asking, violation), 0 for (0, 0)."""
    rows = list(zip(np.asarray(asking, np.float32).tolist(), np.asarray(violation, float).tolist(), strict=True))
    places = {row: i for i, row in enumerate(sorted(set(rows) | {(0.0, 0.0)}))}
    return [float(places[row]) for row in rows]


def assert_more_asks_first(score, asking) -> None:
    """Check that of two robots that ask, the one that asks more has the higher score; violations come after them."""
    asks = score > np.min(score[score > 0], initial=np.inf)
    order = np.argsort(-score[asks])
    assert np.all(np.diff(np.asarray(asking)[asks][order]) <= 0)


def numpy_teleoperated(s: Signals) -> np.ndarray:
    return np.asarray(s.given & ~s.violation)


# Running quantiles


class Oracle:
    """The running quantile by definition: weighted values in order, in bins of 1 %."""

    def __init__(self, memory: float):
        self.values, self.weights, self.memory = np.zeros(0), np.zeros(0), memory

    def add(self, values, counted):
        values = np.clip(np.asarray(values, float)[np.asarray(counted)], quantiles.LOWEST, quantiles.HIGHEST)
        self.values = np.concatenate([self.values, values])
        self.weights = np.concatenate([self.weights * np.exp(-1 / self.memory), np.ones(len(values))])

    def bounds(self, level: float) -> tuple[float, float]:
        """Between which the quantile lies: values at levels a little below and above, a bin wider."""
        order = np.argsort(self.values)
        below = np.cumsum(self.weights[order]) / self.weights.sum()
        low = self.values[order][np.searchsorted(below, level - 1e-4).clip(max=len(order) - 1)]
        high = self.values[order][np.searchsorted(below, level + 1e-4).clip(max=len(order) - 1)]
        return low / 1.012, high * 1.012


@given(st.integers(0, 100), st.sampled_from([5.0, 1e6]), st.sampled_from([0.01, 0.5, 0.9, 0.999]))
def test_a_running_quantile_is_that_of_all_values_weighed_by_age(seed, memory, level):
    rng, oracle, histogram = np.random.default_rng(seed), Oracle(memory), quantiles.empty()
    for _ in range(4):
        values, counted = np.exp(rng.normal(0, 3, N)).astype(np.float32), rng.random(N) < 0.8
        oracle.add(values, counted)
        histogram = quick_add(histogram, values, counted, jnp.float32(memory))
    low, high = oracle.bounds(level)
    assert low <= float(quick_quantile(histogram, level)) <= high


quick_add, quick_quantile = compiled(quantiles.add), compiled(quantiles.quantile)


def test_the_quantile_of_nothing_is_0():
    assert float(quantiles.quantile(quantiles.empty(), 0.9)) == 0


@pytest.mark.parametrize("scale", [1e-4, 1.0])
def test_a_gate_at_a_rate_is_asked_at_that_rate_while_the_signal_falls(scale):
    """Uncertainty falls by a fifth over 600 timesteps; a tenth of the robots ask nevertheless."""
    rng = np.random.default_rng(0)
    none = jnp.zeros(N, bool)
    alone = {"violation": none, "helped": none, "given": none, "correction": jnp.zeros(N)}
    levels = scale * rng.random((600, N)) * np.exp(-np.arange(600) / 3000)[:, None]
    steps = [signals_at(t, uncertainty=jnp.asarray(level, jnp.float32), **alone) for t, level in enumerate(levels)]
    parameters = {"quantile_rate": 0.1, "quantile_memory": 50.0}
    asked = np.mean([np.mean(score > 0) for score in scores_of("quantile_ensemble", steps, **parameters)[100:]])
    assert 0.07 < asked < 0.12
    calibrated = scores_of("quantile_ensemble", steps, quantile_calibration=50.0, **parameters)
    assert np.mean([np.mean(score > 0) for score in calibrated[400:]]) < 0.01


# Gates


def test_quantile_ensemble():
    steps, memory = [signals_at(t) for t in range(30)], Oracle(1000.0)
    for s, score in zip(steps, scores_of("quantile_ensemble", steps, quantile_rate=0.3), strict=True):
        memory.add(s.uncertainty, ~(s.violation | s.helped))
        low, high = memory.bounds(0.7)
        u, violation = np.asarray(s.uncertainty), np.asarray(s.violation)
        assert np.all(score[(u > high) | violation] > 0)
        assert not np.any(score[(u < low) & ~violation])
        assert_more_asks_first(score, u)


@pytest.mark.parametrize("shown", [lambda r: {"risk": r}, lambda r: {"goal": 1 - r}])
@pytest.mark.parametrize("risk", [1e-3, 1e-2, 0.2, 1.0])
def test_thrifty_humans_hand_back_half_of_the_robots_they_agree_with_at_any_chance_of_success(risk, shown):
    """G may be near 1 for all, where 1 - R stands for it or the critic is sure: its quantiles still tell robots apart."""
    rng, none = np.random.default_rng(0), jnp.zeros(N, bool)
    taught = jnp.arange(N) < 6
    still = {"violation": none, "helped": taught, "given": taught, "correction": jnp.zeros(N), "uncertainty": jnp.ones(N)}
    steps = []
    for t in range(100):
        r = jnp.asarray(rng.uniform(0, risk, N), jnp.float32)
        s = signals_at(t, **still, **shown(r))
        steps.append(s if "goal" in shown(r) else s._replace(estimates={"mean_discrepancy": s.estimates["mean_discrepancy"]}))
    scores = np.stack(scores_of("thrifty_quantile", steps, thrifty_rate=0.05)[20:])
    assert np.mean(scores[:, :6] > 0) == pytest.approx(0.5, abs=0.15)
    assert np.mean(scores[:, 6:] > 0) == pytest.approx(0.05, abs=0.03)


def test_thrifty_robots_that_ask_are_ordered_by_the_stronger_of_two_reasons():
    none = jnp.zeros(N, bool)
    alone = {"violation": none, "helped": none, "given": none, "correction": jnp.zeros(N)}
    steps = [signals_at(t, uncertainty=jnp.full(N, 0.1), goal=jnp.full(N, 0.5), **alone) for t in range(40)]
    usual = steps[0]
    doubt, goal = usual.uncertainty.at[0].set(0.2).at[1].set(0.8), usual.goal.at[2].set(0.25).at[3].set(0.05)
    last = scores_of("thrifty_quantile", [*steps, signals_at(40, uncertainty=doubt, goal=goal, **alone)])[-1]
    assert np.argsort(-last)[:4].tolist() == [3, 1, *np.argsort(-last)[2:4]]  # 10 and 8 times as much as usual
    assert set(np.argsort(-last)[2:4]) == {0, 2}  # twice
    assert np.all(last[:4] > 0)


@pytest.mark.parametrize("has_goal", [True, False])
def test_thrifty_quantile(has_goal):
    steps = [signals_at(t) for t in range(30)]
    if not has_goal:
        steps = [s._replace(estimates={"mean_discrepancy": s.estimates["mean_discrepancy"]}) for s in steps]
    doubt, chance, kept, agreeing = Oracle(1000.0), Oracle(1000.0), 0, 0
    for s, score in zip(steps, scores_of("thrifty_quantile", steps, thrifty_rate=0.2), strict=True):
        u, g = np.asarray(s.uncertainty), np.asarray(s.goal if has_goal else 1 - s.risk)
        alone, taught = ~np.asarray(s.violation | s.helped), numpy_teleoperated(s)
        doubt.add(u, alone)
        chance.add(g, alone)
        (u_low, u_high), (g_low, g_high), (m_low, m_high) = doubt.bounds(0.8), chance.bounds(0.2), chance.bounds(0.5)
        agrees = np.asarray(s.correction) < np.asarray(s.estimates["mean_discrepancy"])
        sure = (u > u_high) | (g < g_low) | (taught & ~(agrees & (g > m_low)))
        sure_not = ~((u > u_low) | (g < g_high) | (taught & ~(agrees & (g > m_high)))) & ~np.asarray(s.violation)
        assert np.all(score[sure] > 0)
        assert not np.any(score[sure_not])
        unasked = taught & sure & ~((u > u_low) | (g < g_high))
        kept, agreeing = kept + np.sum(unasked), agreeing + np.sum(unasked & (np.asarray(s.correction) == 0))
    assert kept > 0
    assert agreeing > 0  # the human does what the robot would, but success is not likely


def test_safe_dagger():
    s = signals_at(0)
    p = np.asarray(s.estimates["discrepancy"])
    (score,) = scores_of("safe_dagger", [s], safe_threshold=0.6)
    assert score.tolist() == ranks(np.where(p >= np.float32(0.6), p, 0), s.violation)


def test_lazy_dagger_hands_back_at_a_quarter_of_its_bound():
    s = signals_at(3)
    p, correction = np.asarray(s.estimates["discrepancy"]), np.asarray(s.correction)
    keeps = numpy_teleoperated(s) & (correction >= np.float32(0.25))
    assert 0 < keeps.sum() < numpy_teleoperated(s).sum()
    (score,) = scores_of("lazy_dagger", [s], lazy_threshold=0.9, discrepancy_tau=1.0)
    asking = np.where(p >= np.float32(0.9), p, 0)
    assert score.tolist() == ranks(np.where(keeps, np.maximum(asking, 1e-6), asking), s.violation)


def test_lazy_dagger_has_the_bound_of_its_code():
    assert float(fleetjax.make_config("navigation", "lazy_dagger").parameters["discrepancy_tau"]) == pytest.approx(0.008 * 4)
    assert float(fleetjax.make_config("navigation", "safe_dagger").parameters["discrepancy_tau"]) == pytest.approx(0.0025)
    replaced = fleetjax.make_config("navigation").replace(algorithm="lazy_dagger")
    assert float(replaced.parameters["discrepancy_tau"]) == pytest.approx(0.032)


def test_dropout_dagger_asks_where_few_samples_are_near_the_human():
    s = signals_at(0, uncertainty=jnp.linspace(0.0, 0.3, N).at[2].set(0.005), violation=jnp.zeros(N, bool))
    offset = jnp.where(jnp.arange(N) % 2 == 0, 0.0, 0.5).at[2].set(0.15)[:, None]
    given = {"dropout_share": 0.5, "dropout_threshold": 0.05}
    (score,) = scores_of("dropout_dagger", [s._replace(human_action=s.robot_action + offset)], **given)
    rng = np.random.default_rng(0)
    noise = np.sqrt(np.asarray(s.uncertainty))[:, None] * rng.normal(size=(20_000, N, ACTIONS))
    squares = (noise - np.asarray(offset)) ** 2
    share = np.mean(np.mean(squares, axis=-1) <= 0.05, axis=0)
    clear = np.abs(share - 0.5) > 0.35  # four deviations of 32 samples
    assert clear.sum() >= 6
    assert np.any(clear & (share > 0.5) & (np.mean(np.sum(squares, axis=-1) <= 0.05, axis=0) < 0.3))  # the mean is, the sum not
    np.testing.assert_array_equal((score > 0)[clear], (share < 0.5)[clear])


def test_oracle_discrepancy():
    s = signals_at(0)
    d = np.mean((np.asarray(s.robot_action) - np.asarray(s.human_action)) ** 2, axis=-1, dtype=np.float32)
    (score,) = scores_of("oracle_discrepancy", [s], oracle_threshold=0.4)
    asks = d >= 0.4
    assert 0 < asks.sum() < N
    assert np.all(score[asks] > score[~asks].max())
    assert np.argmax(score) == np.argmax(d)


def test_crsail():
    s = signals_at(0)
    d = np.asarray(s.estimates["novelty"])
    (score,) = scores_of("crsail", [s])
    assert score.tolist() == ranks(np.where(d >= 1, d, 0), s.violation)


def test_the_distance_to_the_kth_neighbour():
    rng = np.random.default_rng(0)
    obs, states = rng.normal(size=(7, 4)).astype(np.float32), rng.normal(size=(30, 4)).astype(np.float32)
    apart = np.sqrt(np.mean((obs[:, None] - states) ** 2, axis=-1))
    for known in (np.ones(30, bool), np.arange(30) < 20):
        expected = np.sort(apart[:, known], axis=1)[:, 4]
        np.testing.assert_allclose(novelty.distance_to(obs, states, known, 5), expected, rtol=1e-3)
    assert np.all(np.isinf(novelty.distance_to(obs, states, np.arange(30) < 4, 5)))


def test_conformal_widens_where_labels_fall_outside_and_only_when_labelled():
    steps = [signals_at(t) for t in range(12)]
    quiet = {"helped": jnp.zeros(N, bool), "given": jnp.zeros(N, bool), "correction": jnp.zeros(N)}
    steps[5] = steps[5]._replace(**quiet)
    half, spread = 1.0, np.ones(N)
    for s, score in zip(steps, scores_of("conformal", steps, conformal_gain=0.5, conformal_threshold=0.7), strict=True):
        taught = numpy_teleoperated(s)
        if taught.any():
            outside = np.sqrt(np.asarray(s.correction)) > half * spread
            half *= np.exp(0.5 * (outside[taught].mean() - 0.1))
        spread = np.sqrt(np.asarray(s.uncertainty)) + 1e-3
        width = 2 * half * spread
        asks = width >= 0.7
        clear = (np.abs(width - 0.7) > 1e-3) & ~np.asarray(s.violation)
        np.testing.assert_array_equal((score > 0)[clear], asks[clear])


@pytest.mark.parametrize(("name", "estimate", "shift"), [("aim", "intervention", 1.0), ("iifl", "divergence", 0.0)])
def test_gates_by_quantiles_of_an_estimate(name, estimate, shift):
    steps, memory, asked = [signals_at(t) for t in range(30)], Oracle(1000.0), 0
    for s, score in zip(steps, scores_of(name, steps, **{f"{name}_rate": 0.2}), strict=True):
        value = np.asarray(s.estimates[estimate]) + shift
        memory.add(value, ~(s.violation | s.helped))
        low, high = memory.bounds(0.8)
        violation = np.asarray(s.violation)
        assert np.all(score[(value > high) | violation] > 0)
        assert not np.any(score[(value < low) & ~violation])
        assert_more_asks_first(score, value)
        asked += np.sum(score[~violation] > 0)
    assert asked > 0


# Queues, bandits, coverage


def test_round_robin_serves_all_in_turn():
    signals = signals_at(0, violation=jnp.zeros(N, bool), helped=jnp.zeros(N, bool))
    config = CONFIG.replace(algorithm="round_robin", round_robin_threshold=5.0)
    rule = priority.get_algorithm("round_robin").make_priority(config)
    memory, served = rule.init(), []
    for t in range(2 * N):
        score, memory = rule.score(signals._replace(timestep=jnp.int32(t)), memory, jax.random.key(0))
        robot = int(jnp.argmax(score))
        assert float(score[robot]) > 0
        served.append(robot)
        signals = signals._replace(helped=jnp.arange(N) == robot)
    assert served == [*range(N), *range(N)]
    everyone = signals._replace(helped=jnp.ones(N, bool))
    score, memory = rule.score(everyone, memory, jax.random.key(0))
    assert not np.any(score)
    for waited in range(1, 9):  # its threshold is 5
        score, memory = rule.score(signals._replace(helped=jnp.zeros(N, bool)), memory, jax.random.key(0))
        assert np.all((score > 0) == (waited > 5))


def test_longest_waiting_is_first_come_first_served():
    since = np.array([0, 3, 1, 9, 2, 9, 9, 9, 9, 9, 9, 9])  # timestep of each violation; 9 = none yet
    steps = [signals_at(t, violation=jnp.asarray(since <= t)) for t in range(5)]
    for t, score in enumerate(scores_of("longest_waiting", steps)):
        assert score.tolist() == np.maximum(t + 1 - since, 0).tolist()


@given(st.integers(0, 100), st.sampled_from([1.0, 9.0, 1e6]))
def test_teach_first_helps_moving_robots_until_its_time_is_spent(seed, teaching_time):
    steps = [signals_at(t, seed) for t in range(8)]
    taught = 0
    for t, (s, score) in enumerate(zip(steps, scores_of("teach_first", steps, teaching_time=teaching_time), strict=True)):
        taught += int(np.sum(s.given))
        chance = np.asarray(jax.random.uniform(jax.random.key(t), (N,)))
        for robot, violated in enumerate(np.asarray(s.violation)):
            below = np.sum(score < score[robot])
            if violated:  # last, or first
                assert score[robot] > 0
                assert below == (0 if 2 * taught < teaching_time else np.sum(~s.violation))
            elif taught >= teaching_time:
                assert score[robot] == 0
            else:
                behind = np.sum(~s.violation & (chance < chance[robot]))
                assert below == behind + (np.sum(s.violation) if 2 * taught < teaching_time else 0)


def numpy_index(chains: np.ndarray, discount: float, state: int) -> float:
    """Return the Whittle index by value iteration and bisection."""
    low, high = -1 / (1 - discount), 1 / (1 - discount)
    for _ in range(40):
        price = (low + high) / 2
        value = np.zeros(3)
        for _ in range(400):
            q = [np.array(whittle.WORTH) - price * a + discount * chains[a] @ value for a in (0, 1)]
            value = np.maximum(*q)
        low, high = (price, high) if q[1][state] > q[0][state] else (low, price)
    return (low + high) / 2


@pytest.mark.parametrize("seed", range(4))
def test_whittle_indices(seed):
    chains = np.random.default_rng(seed).dirichlet(np.ones(3), size=(2, 3))
    chains[0, 2] = 0, 0, 1
    expected = [numpy_index(chains, 0.9, state) for state in range(3)]
    found = whittle.indices(*jnp.asarray(chains, jnp.float32), jnp.float32(0.9))
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_whittle_counts_transitions_with_and_without_help():
    steps = [signals_at(t) for t in range(6)]
    config = CONFIG.replace(algorithm="whittle", uncertainty_threshold=0.1, risk_threshold=0.5, whittle_discount=0.9)
    config = config.replace(whittle_threshold=0.3)
    rule = priority.get_algorithm("whittle").make_priority(config)
    memory, counts, before, below, above = rule.init(), np.ones((2, 3, 3)), None, 0, 0
    counts[0, 2] = 0, 0, 1
    for s in steps:
        score, memory = rule.score(s, memory, jax.random.key(0))
        risky = (np.asarray(s.uncertainty) > 0.1) | (np.asarray(s.risk) > 0.5)
        state = np.where(s.violation, 2, np.where(risky, 1, 0))
        if before is not None:
            np.add.at(counts, (np.asarray(s.helped).astype(int), before, state), 1)
        np.testing.assert_array_equal(memory.transitions, counts)
        chains = counts / counts.sum(axis=2, keepdims=True)
        index = np.array([numpy_index(chains, 0.9, each) for each in range(3)])
        np.testing.assert_allclose(score, np.where(index > 0.3, index, 0)[state], atol=2e-3)
        below, above = below + np.sum(index[state] < 0.29), above + np.sum(index[state] > 0.31)
        before = state
    assert below > 0
    assert above > 0


def numpy_coverage(s, own, bound, number, threshold, link):
    """Return the robots that greedy facility location picks, in order, as the published text has it; `own` is M's diagonal.

    M = (similarity * informativeness)^T, and 10,000 C on its diagonal alone. In the initial period `own` is 0 for violations.
    """
    obs = np.asarray(s.obs, float)
    obs = (obs - obs.mean(0)) / obs.std(0)
    alike = 1 / (1 + 4.89 * np.sqrt(np.mean((obs[:, None] - obs) ** 2, axis=-1)))
    np.testing.assert_allclose(coverage.similarity(s.obs), alike, atol=1e-3)
    u, r = np.asarray(s.uncertainty, float), np.asarray(s.risk, float)
    matrix = (alike * (0.097 * np.where(u < 0.151, 0, u) + 0.903 * np.where(r < 0.198, 0, r))).T
    np.fill_diagonal(matrix, own)
    covered, picked = np.max(matrix * bound, axis=1), []
    for _ in range(number):
        gains = (np.maximum(matrix, covered[:, None]).sum(axis=0) - covered.sum()) * link
        gains[bound | (own <= 0) | np.isin(range(len(own)), picked)] = -np.inf
        if gains.max() < threshold:
            break
        picked.append(int(gains.argmax()))
        covered = np.maximum(covered, matrix[:, picked[-1]])
    return picked


def numpy_own(s, early: bool) -> np.ndarray:
    """Return what each robot covers of itself: 0.097 U + 0.903 R, and 10,000 C, but 0 for violations at first."""
    u, r, c = (np.asarray(x, float) for x in (s.uncertainty, s.risk, s.violation))
    own = 0.097 * u * (u >= 0.151) + 0.903 * r * (r >= 0.198) + 1e4 * c
    return np.where(c * early > 0, 0, own)


@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("threshold", [0.0, 0.9])
@pytest.mark.parametrize("seed", range(3))
def test_asa_covers_greedily(seed, threshold, early):
    rng = np.random.default_rng(seed)
    link, violation = rng.uniform(0.2, 1.0, N).astype(np.float32), np.isin(range(N), [1, 5])
    s = signals_at(0, seed, link=jnp.asarray(link), violation=jnp.asarray(violation))
    config = CONFIG.replace(algorithm="asa", asa_threshold=threshold, initial_period=5 * early)
    algorithm, own = priority.get_algorithm("asa"), numpy_own(s, early)
    score, _ = algorithm.make_priority(config).score(s, (), jax.random.key(0))
    np.testing.assert_allclose(score, own, rtol=1e-6)
    humans = HumanState(jnp.array([3, -1, -1, -1], jnp.int32), jnp.array([1, 0, 0, 0], jnp.int32))
    found = algorithm.make_allocate(config)(score, humans, jnp.full(N, 5), jax.random.key(0), None, s)
    picked = numpy_coverage(s, own, np.arange(N) == 3, 3, threshold, link)
    assert np.asarray(found.robot).tolist() == [3, *picked, *[-1] * (3 - len(picked))]
    assert early != bool({1, 5} & set(picked))


def asa_on(violation, risk, obs, **humans):
    """Return whom two humans help of robots that see `obs` f32[K, O], 40 timesteps after the start."""
    number = len(risk)
    config = CONFIG.replace(algorithm="asa", num_robots=number, num_humans=2)
    values = {name: jnp.zeros(number) for name in ("uncertainty", "goal")}
    s = Signals(
        violation=jnp.array(violation),
        risk=jnp.array(risk),
        timestep=jnp.int32(40),
        obs=jnp.asarray(obs, jnp.float32),
        link=humans.get("link"),
        **values,
    )
    algorithm = priority.get_algorithm("asa")
    score, _ = algorithm.make_priority(config).score(s, (), jax.random.key(0))
    crew = humans.get("crew", HumanState(jnp.full(2, -1, jnp.int32), jnp.zeros(2, jnp.int32)))
    allocate = algorithm.make_allocate(config)
    key = humans.get("key", jax.random.key(0))
    return allocate(score, crew, jnp.full(number, 5), key, humans.get("available"), s).robot.tolist()


def test_a_violation_is_covered_by_its_own_robot_alone():
    """A neighbour with a better link, at little risk, gains nothing from a violation beside it."""
    obs = [[0.0, 0.0], [0.01, 0.0], [5.0, 5.0], [5.2, 5.1]]
    link = jnp.array([0.2, 0.9, 0.9, 0.9])
    assert asa_on([True, False, False, False], [0.0, 0.4, 0.9, 0.5], obs, link=link) == [0, 2]
    assert asa_on([False] * 4, [0.9, 0.4, 0.9, 0.0], obs) == [0, 2]


def test_asa_breaks_ties_by_chance():
    """Three violations alike, far from each other, without uncertainty or risk."""
    obs, violation = [[0.0], [10.0], [20.0], [30.0]], [True, True, True, False]
    picked = {tuple(asa_on(violation, [0.0] * 4, obs, key=jax.random.key(i))) for i in range(40)}
    assert {robot for pair in picked for robot in pair} == {0, 1, 2}
    assert {pair[0] for pair in picked} == {0, 1, 2}


def test_defaults_of_the_rules_are_those_of_their_sources():
    expected = {
        "thrifty_quantile": {"thrifty_rate": 0.01},
        "aim": {"aim_rate": 0.05},
        "iifl": {"iifl_rate": 0.001},
        "asa": {"asa_threshold": 0.351, "asa_uncertainty": 0.151, "asa_risk": 0.198},
        "lazy_dagger": {"lazy_handback": 0.25},
    }
    for name, parameters in expected.items():
        known = fleetjax.make_config("navigation", name).parameters
        for parameter, value in parameters.items():
            assert float(known[parameter]) == pytest.approx(value), parameter
    assert novelty.NEIGHBOURS == 5


def test_a_robot_whose_human_has_left_competes_again():
    crew = HumanState(jnp.array([0, -1], jnp.int32), jnp.array([1, 0], jnp.int32))
    options = {"violation": [False] * 3, "risk": [0.9, 0.8, 0.7], "obs": [[0.0], [4.0], [9.0]], "crew": crew}
    assert asa_on(**options) == [0, 1]
    assert asa_on(**options, available=jnp.array([False, True])) == [-1, 0]


def test_asa_leaves_violations_in_the_initial_period():
    s = signals_at(10)
    before, after = (
        scorer("asa")(CONFIG.replace(algorithm="asa", initial_period=period), s, (), jax.random.key(0))[0]
        for period in (11, 10)
    )
    violation = np.asarray(s.violation)
    assert np.any(violation)
    assert not np.any(before[violation])
    assert np.all(after[violation] >= 1e4)
    np.testing.assert_array_equal(before[~violation], after[~violation])


# Estimators, in a fleet


@pytest.mark.parametrize(("estimate", "owner"), [("discrepancy", "safe_dagger"), ("novelty", "crsail")])
def test_a_rule_without_an_estimators_parameter_gets_its_default(estimate: str, owner: str):
    """The estimate on new states is that of the algorithm whose parameter it is."""
    name = f"own_{estimate}"
    fleetjax.register_priority(
        name, lambda config: priority.stateless(lambda signals, key: signals.estimates[estimate]), estimators=(estimate,)
    )
    (parts, state), (_, other) = taught_fleet(name), taught_fleet(owner)
    assert not parts.config.parameters
    obs = jax.random.normal(jax.random.key(1), (6, parts.env.spec.observation_size))
    own, usual = (parts.estimators[estimate].value(s.estimators[estimate], s.policy, obs, obs[:, :2]) for s in (state, other))
    assert np.ptp(np.asarray(own)) > 0
    np.testing.assert_array_equal(own, usual)


@functools.cache
def learnt(name: str):
    """Return estimates at the start and after 150 timesteps, and the fleet's states, of an algorithm on navigation."""
    config = fleetjax.make_config("navigation", name, num_robots=20, num_humans=5, num_steps=150)
    config = config.replace(critic_pretraining_steps=200)
    result = compiled(fleetjax.run)(config, jax.random.key(0))
    return config, result


def estimator_of(name: str, estimate: str):
    config, result = learnt(name)
    parts = make_parts(config, fleetjax.envs.make("navigation"))
    return parts, result.state, parts.estimators[estimate]


@pytest.mark.slow
def test_the_discrepancy_classifier_tells_where_the_policy_is_wrong():
    parts, state, estimator = estimator_of("lazy_dagger", "discrepancy")
    pairs = jax.tree.map(lambda x: x[: int(state.human_data.pairs.size)], state.human_data.pairs.rows)
    action, _ = parts.learner.predict(state.policy, pairs.obs)
    wrong = np.mean((np.asarray(action) - np.asarray(pairs.action)) ** 2, axis=-1) > 0.032
    chance = np.asarray(estimator.value(state.estimators["discrepancy"], state.policy, pairs.obs, action))
    assert 20 < wrong.sum() < wrong.size - 20
    assert np.mean(chance[wrong]) > np.mean(chance[~wrong]) + 0.1


@pytest.mark.slow
def test_the_proxy_value_is_low_for_what_humans_do():
    parts, state, estimator = estimator_of("aim", "intervention")
    pairs = jax.tree.map(lambda x: x[: int(state.human_data.pairs.size)], state.human_data.pairs.rows)
    action, _ = parts.learner.predict(state.policy, pairs.obs)
    apart = np.mean((np.asarray(action) - np.asarray(pairs.action)) ** 2, axis=-1)
    theirs, own = (
        estimator.value(state.estimators["intervention"], state.policy, pairs.obs, a) for a in (pairs.action, action)
    )
    worst = apart > np.quantile(apart, 0.9)
    assert np.mean(np.asarray(own - theirs)[worst]) > 0.2


@pytest.mark.slow
def test_energies_and_neighbours_tell_states_apart_that_no_human_saw():
    for name, estimate in (("iifl", "divergence"), ("crsail", "novelty")):
        parts, state, estimator = estimator_of(name, estimate)
        obs = state.human_data.pairs.rows.obs[:200]
        far = obs + 3.0 * jnp.std(obs, axis=0)
        known, new = (
            np.asarray(estimator.value(state.estimators[estimate], state.policy, x, parts.learner.predict(state.policy, x)[0]))
            for x in (obs, far)
        )
        assert np.median(new) > 1.5 * np.median(known), name


def test_references_are_different_demonstrations_and_the_radius_is_their_quantile():
    config = fleetjax.make_config("navigation", "crsail", num_robots=8, num_humans=2, num_steps=5, pretraining_steps=0)
    state = compiled(fleetjax.prepare)(config, jax.random.key(0))
    parts, seen = make_parts(config, fleetjax.envs.make("navigation")), state.estimators["novelty"]
    index, number = np.asarray(seen.source), int(state.human_data.pairs.size)
    assert number == 500 < novelty.REFERENCES
    assert sorted(index[index >= 0]) == list(range(number))
    known = np.asarray(state.policy.normalizer(state.human_data.pairs.rows.obs[:number]), np.float64)
    apart = np.sqrt(np.mean((known[:, None] - known) ** 2, axis=-1))
    expected = np.quantile(np.sort(apart, axis=1)[:, novelty.NEIGHBOURS], 0.95)
    assert float(seen.radius) == pytest.approx(expected, rel=0.02)
    value = parts.estimators["novelty"].value(seen, state.policy, seen.states[index >= 0], jnp.zeros((number, 2)))
    assert np.mean(np.asarray(value) >= 1) < 0.05
    # New pairs fill what is free, and then take the place of others; none is there twice.
    more = fleetjax.extend(state, 2000).human_data
    rows = more.pairs.rows._replace(obs=more.pairs.rows.obs.at[number:].set(7.0))
    data = more._replace(pairs=more.pairs._replace(rows=rows, added=jnp.int32(number + 1000)))
    update = parts.estimators["novelty"].update
    renewed = jax.lax.fori_loop(0, 400, lambda i, seen: update(seen, state.policy, data, jax.random.key(i)), seen)
    index = np.asarray(renewed.source)
    assert np.all(index >= 0)
    assert len(np.unique(index)) == novelty.REFERENCES
    np.testing.assert_array_equal(renewed.states, rows.obs[index])
    assert 0.4 < np.mean(index < number) < 0.6  # 524 at first; a third in the end


# Estimators, against their equations


@functools.cache
def taught_fleet(name: str, environment: str = "navigation"):
    """Return the parts of a small fleet that has seen demonstrations, and its state."""
    config = fleetjax.make_config(environment, name, num_robots=6, num_humans=2, num_steps=4, batch_size=16)
    short = {"pretraining_steps": 3, "critic_pretraining_steps": 2, "num_critic_transitions": 30}
    config = config.replace(num_demonstrations=40, goal_discount=0.9, **short)
    state = compiled(fleetjax.prepare)(config, jax.random.key(0))
    return make_parts(config, fleetjax.envs.make(environment)), state


def loss_of_update(monkeypatch, parts, state, name: str, key) -> float:
    """Return the loss that an estimator's gradient step descends, at its parameters before."""
    losses = []

    def spy(trained, loss, learning_rate):
        losses.append(float(loss(trained.params)))
        return trained

    monkeypatch.setattr(help, "_descend", spy)
    parts.estimators[name].update(state.estimators[name], state.policy, state.human_data, key)
    return losses[0]


def drawn(data, key, number: int):
    """Return the pairs that a batch draws, in NumPy."""
    index = np.asarray(buffer.draw_index(key, (number,), data.pairs.size))
    return tuple(np.asarray(column, np.float64)[index] for column in data.pairs.rows)


def numpy_net(parts, params, *inputs) -> np.ndarray:
    """Return f64[K], the output of a network of the fleet's kind."""
    layers = [params["params"][layer] for layer in sorted(params["params"])]
    x = np.concatenate(inputs, axis=-1)
    for i, layer in enumerate(layers):
        x = x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        x = np.maximum(x, 0) if i < len(layers) - 1 else x
    return x[..., 0]


def numpy_scaled(policy, obs) -> np.ndarray:
    return np.asarray(policy.normalizer(jnp.asarray(obs, jnp.float32)), np.float64)


def numpy_policy(parts, policy, obs) -> np.ndarray:
    return np.asarray(parts.learner.predict(policy, jnp.asarray(obs, jnp.float32))[0], np.float64)


def test_the_loss_of_the_discrepancy_classifier(monkeypatch):
    parts, state = taught_fleet("lazy_dagger")
    key = jax.random.key(3)
    obs, action = drawn(state.human_data, key, 16)
    apart = np.mean((numpy_policy(parts, state.policy, obs) - action) ** 2, axis=-1)
    values = np.unique(apart.astype(np.float32))
    tau = float(values[len(values) // 2 - 1 : len(values) // 2 + 1].mean())  # between two of them: rounding decides nothing
    wrong = apart > tau
    parts = make_parts(parts.config.replace(discrepancy_tau=tau), parts.env)
    p = 1 / (1 + np.exp(-numpy_net(parts, state.estimators["discrepancy"].params, numpy_scaled(state.policy, obs))))
    expected = -np.mean(np.where(wrong, np.log(p), np.log(1 - p)))
    assert loss_of_update(monkeypatch, parts, state, "discrepancy", key) == pytest.approx(expected, rel=1e-4)
    value = parts.estimators["discrepancy"].value(
        state.estimators["discrepancy"], state.policy, jnp.asarray(obs, jnp.float32), jnp.asarray(action, jnp.float32)
    )
    np.testing.assert_allclose(value, p, rtol=1e-4)


def test_the_mean_discrepancy_is_that_of_the_policy_on_human_data():
    parts, state = taught_fleet("thrifty_quantile")
    key, estimator = jax.random.key(3), parts.estimators["mean_discrepancy"]
    obs, action = drawn(state.human_data, key, 16)
    expected = np.mean((numpy_policy(parts, state.policy, obs) - action) ** 2)
    mean = estimator.update(jnp.float32(9.0), state.policy, state.human_data, key)
    assert float(mean) == pytest.approx(expected, rel=1e-4)
    value = estimator.value(mean, state.policy, jnp.zeros((6, 8)), jnp.zeros((6, 2)))
    np.testing.assert_allclose(value, [expected] * 6, rtol=1e-4)


def test_the_targets_and_the_loss_of_the_proxy_value(monkeypatch):
    parts, state = taught_fleet("aim")
    proxy, policy, key = state.estimators["intervention"], state.policy, jax.random.key(3)
    rng, size = np.random.default_rng(0), 30
    numbers = [jnp.asarray(rng.uniform(-1, 1, (size, width)), jnp.float32) for width in (8, 2, 8)]
    steps = Transition(*numbers, violation=jnp.arange(size) % 5 == 1, success=jnp.arange(size) % 5 == 2)
    transitions = buffer.append(proxy.transitions, steps, jnp.ones(size, bool), overwrite=True)
    rows = transitions.rows
    slow = jax.tree.map(lambda x: 0.5 * x, proxy.target)  # so that the two networks differ
    proxy = proxy._replace(transitions=transitions, target=slow)
    state = state._replace(estimators={"intervention": proxy})
    key_pairs, key_steps = jax.random.split(key)
    obs, action = drawn(state.human_data, key_pairs, 16)
    own = numpy_policy(parts, policy, obs)
    apart = np.mean((own - action) ** 2, axis=-1)
    index = np.asarray(buffer.draw_index(key_steps, (16,), jnp.int32(size)))
    now, done, then = (np.asarray(rows._asdict()[name], np.float64)[index] for name in ("obs", "action", "next_obs"))
    over = np.asarray(rows.violation | rows.success)[index]
    assert 0 < over.sum() < 16
    ahead = numpy_net(parts, slow, numpy_scaled(policy, then), numpy_policy(parts, policy, then))
    target = np.where(over, 0, 0.9 * ahead)
    value = lambda obs, action: numpy_net(parts, proxy.trained.params, numpy_scaled(policy, obs), action)  # noqa: E731
    expected = np.mean((value(obs, action) + 1) ** 2 + (apart > apart.mean()) * (value(obs, own) - 1) ** 2)
    expected += np.mean((value(now, done) - target) ** 2)
    assert loss_of_update(monkeypatch, parts, state, "intervention", key) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("environment", ["navigation", pytest.param("block_push", marks=pytest.mark.slow)])
def test_the_loss_of_the_energy_models(monkeypatch, environment):
    """Each learns by telling the human's action from proposals; where actions are discrete, these are all of them."""
    parts, state = taught_fleet("iifl", environment)
    discrete, data, key = parts.env.spec.discrete, state.human_data, jax.random.key(3)
    key_pairs, key_actions = jax.random.split(key)
    draw = np.asarray(buffer.draw_index(key_pairs, (2, 16 // help.FEWER), data.pairs.size))
    resample = np.asarray(data.resample)
    assert (resample.shape[1] == 1) == discrete
    row = np.stack([resample[draw[model], model % resample.shape[1]] for model in range(2)])
    obs, action = (np.asarray(column)[row] for column in data.pairs.rows)
    others = []
    half, actions = help.PROPOSALS // 2, parts.env.spec.action_size
    near, far = jax.random.split(key_actions)
    if discrete:
        others = np.broadcast_to(np.eye(actions), (*row.shape, actions, actions))
    else:
        own = np.asarray(parts.learner.predict(state.policy, jnp.asarray(obs))[0])[..., None, :]
        shape = (*row.shape, half, actions)
        about = np.clip(own + 0.2 * np.asarray(jax.random.normal(near, shape)), -1, 1)
        others = np.concatenate([about, jax.random.uniform(far, shape, minval=-1.0)], axis=-2)
    choices = others if discrete else np.concatenate([action[..., None, :], others], axis=-2)
    losses = []
    for model in range(2):
        params = jax.tree.map(lambda x, model=model: x[model], state.estimators["divergence"].params)
        scaled = state.policy.normalizer(jnp.asarray(obs[model]))
        inputs = np.broadcast_to(np.asarray(scaled)[:, None], (*choices[model].shape[:-1], scaled.shape[-1]))
        energy = energy_of(parts, params, inputs, choices[model])
        right = np.argmax(action[model], axis=-1) if discrete else np.zeros(len(energy), int)
        losses += [np.take_along_axis(energy, right[:, None], 1)[:, 0] + np.log(np.exp(-energy).sum(axis=-1))]
    assert loss_of_update(monkeypatch, parts, state, "divergence", key) == pytest.approx(np.mean(losses), rel=1e-3)


def energy_of(parts, params, obs, action) -> np.ndarray:
    """Return f64[B, P], energies by the network itself where observations are images, else in NumPy."""
    if not parts.env.spec.image_shape:
        return numpy_net(parts, params, np.asarray(obs, float), action)
    network = networks.make_network(parts.env.spec, parts.config.hidden_sizes, 1)
    both = np.concatenate([obs, action], axis=-1)
    return np.asarray(network.apply(params, jnp.asarray(both, jnp.float32))[..., 0], float)


def numpy_jeffreys(energies) -> np.ndarray:
    p, q = (np.exp(-e) / np.exp(-e).sum(axis=-1, keepdims=True) for e in np.asarray(energies, np.float64))
    return np.sum((p - q) * (np.log(p) - np.log(q)), axis=-1)


def test_the_jeffreys_divergence():
    energies = np.random.default_rng(0).normal(0, 2, (2, 7, 5))
    np.testing.assert_allclose(help.jeffreys(jnp.asarray(energies, jnp.float32)), numpy_jeffreys(energies), rtol=1e-4)
    assert numpy_jeffreys([[[0.0, np.log(3.0)]], [[np.log(3.0), 0.0]]])[0] == pytest.approx(np.log(3.0))
    parts, state = taught_fleet("iifl")
    models, policy, obs = state.estimators["divergence"], state.policy, np.asarray(state.env.obs, np.float64)
    own = numpy_policy(parts, policy, obs)
    key_near, key_far = jax.random.split(jax.random.key(0))
    near = own[:, None] + 0.2 * np.asarray(jax.random.normal(key_near, (6, 4, 2)), np.float64)
    far = np.asarray(jax.random.uniform(key_far, (6, 4, 2), minval=-1.0), np.float64)
    actions = np.concatenate([np.clip(near, -1, 1), far], axis=1)
    seen = np.broadcast_to(numpy_scaled(policy, obs)[:, None], (6, 8, 8))
    energies = [numpy_net(parts, jax.tree.map(lambda x, k=k: x[k], models.params), seen, actions) for k in range(2)]
    value = parts.estimators["divergence"].value(models, policy, state.env.obs, jnp.asarray(own, jnp.float32))
    np.testing.assert_allclose(value, numpy_jeffreys(energies), rtol=1e-3, atol=1e-6)


# Discrete actions


@pytest.mark.slow
@pytest.mark.parametrize("agree", [True, False])
def test_who_acts_is_known_though_human_and_robot_agree(agree):
    """With discrete actions a correction of 0 is common: the human is there, and did what the robot would."""
    config = fleetjax.make_config("block_push", "cur", num_robots=4, num_humans=2, num_steps=4, pretraining_steps=0)
    config = config.replace(num_demonstrations=70, critic_pretraining_steps=0, num_critic_transitions=50)
    fleet = fleetjax.make_fleet(config, fleetjax.envs.make("block_push"))
    state = compiled(fleetjax.prepare)(config, jax.random.key(0))
    state, plan = compiled(fleet.plan)(state, jax.random.key(1))
    plan = plan._replace(teleoperated=jnp.array([True, True, False, False]))
    action = plan.robot_action if agree else jnp.roll(plan.robot_action, 1, axis=1)
    after, _ = compiled(fleet.advance)(state, plan, action, jnp.array([True, False, True, False]), jax.random.key(1))
    assert after.given.tolist() == [True, False, False, False]
    assert (float(after.correction[0]) > 0) == (not agree)
    _, then = compiled(fleet.plan)(after, jax.random.key(2))
    assert then.signals.given.tolist() == after.given.tolist()


def test_agreement_narrows_the_conformal_interval():
    """Nine humans of ten agree with their robots exactly; their labels count, and q does not ratchet up."""
    given = jnp.arange(N) < 10
    correction = jnp.where(jnp.arange(N) == 0, 9.0, 0.0)
    same = {"helped": given, "given": given, "correction": correction, "violation": jnp.zeros(N, bool)}
    config = CONFIG.replace(algorithm="conformal", conformal_rate=0.2)
    rule = priority.get_algorithm("conformal").make_priority(config)
    memory = rule.init()
    for t in range(20):
        _, memory = rule.score(signals_at(t, **same), memory, jax.random.key(t))
    assert float(memory.half) == pytest.approx(np.exp(-20 * 0.05 * 0.1), rel=1e-4)
