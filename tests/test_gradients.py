"""Gradients of a fleet's worth: the soft allocation and its limit, three ways to a gradient, and tuning along it."""

import math
import warnings
from functools import partial
from typing import Any

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import refused as command_refused
from compiling import compiled
from hypothesis import given
from hypothesis import strategies as st

import fleetjax
from fleetjax import checks, gradients, soft
from fleetjax.config import _check_soft, get_value
from fleetjax.experiment import scan_in_blocks
from fleetjax.field import ORDERS
from fleetjax.priority import get_algorithm
from fleetjax.soft import soft_top_k

TINY = {
    "num_robots": 5,
    "num_humans": 2,
    "num_steps": 6,
    "ensemble_size": 2,
    "hidden_sizes": (6,),
    "batch_size": 8,
    "gradient_steps": 1,
    "critic_capacity": 200,
    "num_demonstrations": 60,
    "pretraining_steps": 20,
    "critic_pretraining_steps": 5,
    "num_critic_transitions": 60,
    "initial_period": 0,
}
KEYS = jax.random.split(jax.random.key(3), 2)
SCORES = hnp.arrays(np.float64, 8, elements=st.floats(0, 100), unique=True)


@pytest.fixture(autouse=True)
def quick_compilation():
    """Compile quickly among the slow tests, too: these programs run for a moment only."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="module")
def config():
    return fleetjax.make_config("navigation", "weighted", **TINY)


# --- the soft top k ---

share = jax.jit(soft_top_k)
assign = jax.jit(fleetjax.allocate)


@given(SCORES, st.integers(0, 8), st.floats(0.01, 10))
def test_shares_are_at_most_k_in_total_and_rise_with_the_score(score, k, temperature):
    shares = np.asarray(share(jnp.asarray(score, jnp.float32), jnp.int32(k), jnp.float32(temperature)))
    assert np.all((shares >= 0) & (shares <= 1))
    assert shares.sum() <= k + 1e-3
    assert np.all(shares[score == 0] == 0)
    assert np.all(np.diff(shares[np.argsort(score)]) >= -1e-6)
    if k < 8 and np.tanh(score / temperature).sum() > k:
        np.testing.assert_allclose(shares.sum(), k, atol=1e-3)


@given(SCORES, st.integers(1, 7))
def test_the_limit_of_temperature_0_is_the_hard_choice(score, k):
    score = np.round(score)
    score[:3] = [0, 150, 160]
    score += np.arange(8) / 8 * (score > 0)  # no ties
    free = fleetjax.HumanState(jnp.full(k, -1), jnp.zeros(k, jnp.int32))
    humans = assign(jnp.asarray(score, jnp.float32), free, jnp.ones(8, jnp.int32), jax.random.key(0))
    helped = np.isin(np.arange(8), humans.robot)
    shares = share(jnp.asarray(score, jnp.float32), jnp.int32(k), jnp.float32(1e-3))
    np.testing.assert_allclose(shares, helped, atol=1e-3)


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize(("k", "temperature"), [(10, 1.0), (10, 0.1), (40, 0.3), (90, 5.0)])
def test_derivatives_of_shares_are_those_of_differences(k, temperature, ties):
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        score = jnp.asarray(np.abs(rng.normal(size=100)) * (rng.random(100) < 0.8))
        if ties:
            score = jnp.round(score)
        weights, step = jnp.asarray(rng.normal(size=100)), jnp.asarray(rng.normal(size=100)) * (score > 0).astype(jnp.float64)

        def worth(score, temperature):
            return jnp.sum(weights * soft_top_k(score, jnp.int32(k), temperature))

        by_score, by_temperature = jax.grad(worth, (0, 1))(score, jnp.float64(temperature))
        h = 1e-6
        rise = worth(score + h * step, temperature) - worth(score - h * step, temperature)
        np.testing.assert_allclose(by_score @ step, rise / (2 * h), rtol=3e-4, atol=1e-8)
        rise = worth(score, temperature + h) - worth(score, temperature - h)
        np.testing.assert_allclose(by_temperature, rise / (2 * h), rtol=3e-4, atol=1e-8)
        forward = jax.jvp(lambda s: worth(s, temperature), (score,), (step,))[1]
        np.testing.assert_allclose(forward, by_score @ step, rtol=1e-9)


def test_a_scan_in_blocks_is_a_scan_with_the_same_derivative():
    def step(carry, _):
        carry = jnp.sin(carry) + 0.5 * carry
        return carry, carry

    def total(scan, length, x):
        last, every = scan(step, x, length=length)
        return last + jnp.sum(every**2), every

    for length in (1, 2, 3, 7, 16, 23):
        one, other = (partial(total, scan, length) for scan in (jax.lax.scan, scan_in_blocks))
        (value, every), slope = jax.value_and_grad(one, has_aux=True)(jnp.float32(0.3))
        (value_, every_), slope_ = jax.value_and_grad(other, has_aux=True)(jnp.float32(0.3))
        np.testing.assert_allclose([value, slope], [value_, slope_], rtol=1e-6)
        np.testing.assert_array_equal(every, every_)


# --- the weighted sum ---

FAR = 1e5
THRESHOLDS = {"uncertainty_threshold": 0.15, "risk_threshold": 0.3}
WEIGHTS = {"c": "violation_weight", "u": "uncertainty_weight", "r": "risk_weight"}


def in_64_bits(x):
    return x.astype(jnp.float64) if x.dtype == jnp.float32 else x


@pytest.fixture(scope="module")
def recorded():
    """Signals[T, N] of a fleet whose robots hit walls, and are uncertain and at risk at times."""
    sizes = {**TINY, "num_robots": 30, "num_humans": 6, "num_steps": 60, "critic_pretraining_steps": 100}
    config = fleetjax.make_config("navigation", "weighted", **sizes, **THRESHOLDS)
    fleet = fleetjax.make_fleet(config, fleetjax.envs.make("navigation"))

    def step(state, key):
        _, planned = fleet.plan(state, key)
        return fleet.step(state, key)[0], planned.signals

    def record(key):
        state = fleetjax.prepare(config, key)
        return jax.lax.scan(step, state, jax.random.split(key, config.num_steps))[1]

    signals = compiled(record)(KEYS[0])
    assert signals.violation.any()
    assert 0.05 < np.mean(signals.uncertainty > THRESHOLDS["uncertainty_threshold"]) < 0.95
    assert 0.05 < np.mean(signals.risk > THRESHOLDS["risk_threshold"]) < 0.95
    return signals


@pytest.mark.parametrize(
    "letters", [pytest.param(x, marks=[] if x in ("cur", "uc", "r") else [pytest.mark.slow]) for x in ORDERS]
)
def test_orders_are_limits_of_weights_far_apart(letters, recorded):
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        weights = dict.fromkeys(WEIGHTS.values(), 0.0) | {
            WEIGHTS[letter]: FAR ** (len(letters) - 1 - place) for place, letter in enumerate(letters)
        }
        period = 20 if "c" in letters else 0  # other orders have none
        weighted = fleetjax.make_config("navigation", "weighted", initial_period=period, **weights, **THRESHOLDS)
        order = fleetjax.make_config("navigation", letters, initial_period=20, **THRESHOLDS)
        weighted, order = (jax.tree.map(in_64_bits, c) for c in (weighted, order))
        signals = jax.tree.map(in_64_bits, recorded)
        number, n = signals.violation.shape

        def allocations(rule):
            def step(humans, entry):
                signals, key = entry
                score, _ = rule.score(signals, rule.init(), key)
                humans = fleetjax.allocate(score, humans, jnp.full(n, 3), key)
                return humans._replace(duration=humans.duration + 1), humans.robot

            humans = fleetjax.HumanState(jnp.full(6, -1), jnp.zeros(6, jnp.int64))
            return jax.lax.scan(step, humans, (signals, jax.random.split(jax.random.key(0), number)))[1]

        chosen, same = (allocations(get_algorithm(c.algorithm).make_priority(c)) for c in (weighted, order))
        np.testing.assert_array_equal(chosen, same)
        assert np.sum(chosen >= 0) > 20


def test_a_weighted_fleet_learns_the_goal_only_where_there_is_one(config):
    assert set(checks.state_shapes(config, fleetjax.envs.make("navigation")).estimators) == {"safety", "goal"}
    humanoid = fleetjax.make_config("humanoid", "weighted")
    assert set(checks.state_shapes(humanoid, fleetjax.envs.make("humanoid")).estimators) == {"safety"}


# --- the soft fleet ---


@pytest.mark.slow
def test_the_soft_fleet_is_the_hard_one_at_temperature_0():
    hard = fleetjax.make_config("navigation", "weighted", **{**TINY, "num_steps": 40, "uncertainty_threshold": 0.01})
    soft = hard.replace(allocation="soft", temperature=1e-4)
    one, other = (compiled(fleetjax.run)(c, KEYS[0]).metrics for c in (hard, soft))
    assert one.teleop_steps.sum() > 20
    np.testing.assert_allclose(other.teleop_steps, one.teleop_steps, atol=0.05)
    np.testing.assert_array_equal(other.violations, one.violations)
    np.testing.assert_allclose(other.reward, one.reward, rtol=1e-3, atol=1e-4)
    assert other.human_steps.dtype == jnp.float32


def test_the_metrics_of_a_soft_fleet_are_sums_of_shares_and_of_soft_successes(config):
    config, margin = config.replace(allocation="soft", temperature=0.5), np.array([0.4, -0.3, 2.0, 1.0, -4.0])
    env = fleetjax.envs.make("navigation")._replace(success_margin=lambda state: state.physics)
    violation, moving = np.array([False, False, True, False, False]), np.array([True, True, True, False, True])
    begun = jax.vmap(lambda x: fleetjax.envs.begin(physics=x, obs=x[None]))(jnp.asarray(margin, jnp.float32))
    stepped = begun._replace(violation=jnp.asarray(violation))
    weight = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    nothing = fleetjax.Metrics(*[jnp.zeros(())] * len(fleetjax.Metrics._fields))
    found = soft.relax(config, env, nothing, jnp.asarray(weight), stepped, jnp.asarray(moving))
    expected = 1 / (1 + np.exp(-margin / 0.5))
    np.testing.assert_allclose(found.successes, expected[moving & ~violation].sum(), rtol=1e-5)
    np.testing.assert_allclose(found.human_steps, 1.5, rtol=1e-6)
    np.testing.assert_allclose(found.teleop_steps, 1.1, rtol=1e-6)


def test_a_robot_keeps_the_share_that_it_had_while_its_human_is_bound_to_it(config):
    humans = fleetjax.HumanState(jnp.array([2, 4], jnp.int32), jnp.array([1, 9], jnp.int32))
    weight, score = jnp.array([0.0, 0.0, 0.3, 0.0, 0.6]), jnp.array([5.0, 0.0, 1.0, 0.2, 0.0])
    found = soft.share(config.replace(allocation="soft"), humans, weight, score, jnp.full(5, 3))
    assert float(found[2]) == pytest.approx(0.3)
    np.testing.assert_allclose(found, jnp.where(jnp.arange(5) == 2, 0.3, soft_top_k(score.at[2].set(0), 1, 0.1)), atol=1e-6)


@pytest.mark.slow
def test_pairs_of_a_soft_fleet_count_by_its_shares_and_it_continues_from_its_states(config):
    config = config.replace(allocation="soft", temperature=20.0, uncertainty_threshold=0.01)
    fleet, state = fleetjax.make_fleet(config, fleetjax.envs.make("navigation")), compiled(fleetjax.prepare)(config, KEYS[0])
    step, number = compiled(fleet.step), 0
    for t in range(3):
        before = state
        state, _ = step(before, jax.random.key(t))
        first, last = int(before.human_data.pairs.added), int(state.human_data.pairs.added)
        shares = np.asarray(state.weight)[np.asarray(state.given)]
        np.testing.assert_array_equal(state.human_data.weight[first:last], shares)
        number += np.sum((shares > 0.01) & (shares < 0.99))
    assert number > 0
    longer = fleetjax.extend(state, 20)
    whole = compiled(fleetjax.run)(config.replace(num_steps=3), KEYS[0], state)
    more = compiled(fleetjax.run)(config.replace(num_steps=3), KEYS[0], longer)
    jax.tree.map(np.testing.assert_array_equal, whole.metrics, more.metrics)
    assert int(whole.metrics.dropped.sum()) == 0


def test_what_a_soft_fleet_cannot_do_is_refused(config, capsys):
    config = config.replace(allocation="soft")
    with pytest.raises(ValueError, match="no human's action can be logged"):
        fleetjax.run_logged(config, KEYS[0])
    fleet = fleetjax.make_fleet(config, fleetjax.envs.make("navigation"))
    with pytest.raises(ValueError, match="omit available"):
        jax.eval_shape(fleet.plan, checks.state_shapes(config, fleetjax.envs.make("navigation")), KEYS[0], jnp.ones(2, bool))
    with pytest.raises(ValueError, match="use step"):
        fleet.advance(None, None, None, None, KEYS[0])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="augmented_copies = 4 must be 1"):  # asked of environments with images
        _check_soft(config.replace(augmented_copies=4), get_algorithm("weighted"), fleetjax.envs.make("navigation"))
    for command in ("run", "sweep"):
        given = ("navigation", "--algorithm", "weighted", "--allocation", "soft", "--output", "nowhere")
        assert "allocation = 'soft' is for derivatives in Python" in command_refused(capsys, command, *given)


# --- gradients ---


@pytest.mark.slow
def test_runs_of_a_pair_have_the_same_randomness_and_each_step_of_tuning_its_own(config):
    """The objective depends on the runs alone, and `temperature` has no effect on a hard fleet."""

    def worth(metrics, config):
        return jnp.sum(metrics.reward)

    with pytest.warns(UserWarning, match="does not depend on temperature"):
        found = fleetjax.sensitivity(config, KEYS, "temperature", objective=worth, num_samples=8)
    assert float(found.gradient["temperature"]) == 0
    with pytest.warns(UserWarning, match="does not depend on temperature"):
        tuned = fleetjax.tune(config, KEYS, "temperature", steps=3, objective=worth, num_samples=2)
    assert len(np.unique(tuned.objective)) == 3


def human_time(metrics, config):
    return jnp.sum(metrics.human_steps) / config.num_steps


@pytest.fixture(scope="module")
def smooth(config):
    """A configuration with thresholds that robots are near, and a state of its fleet."""
    config = config.replace(allocation="soft", temperature=0.5, uncertainty_threshold=0.05)
    return config, compiled(fleetjax.prepare)(config, KEYS[0])


@pytest.mark.slow
def test_the_relaxed_gradient_is_that_of_differences(smooth):
    config, state = smooth
    names = ("uncertainty_threshold", "risk_threshold", "uncertainty_weight", "risk_weight", "goal_weight", "learning_rate")
    values = {name: get_value(config, name) + (0.5 if name == "goal_weight" else 0.0) for name in names}

    def worth(values):
        metrics = fleetjax.run(config.replace(**values), KEYS[1], state).metrics
        return jnp.sum(metrics.human_steps) + jnp.sum(metrics.reward) + jnp.sum(metrics.policy_loss)

    slopes, worth = compiled(jax.grad(worth))(values), compiled(worth)
    for name in names:
        width = 1e-2 * values[name]
        above, below = (worth({**values, name: values[name] + sign * width}) for sign in (1, -1))
        np.testing.assert_allclose(slopes[name], (above - below) / (2 * width), rtol=0.01, atol=1e-4, err_msg=name)


@pytest.mark.slow
def test_smoothed_gradients_are_those_of_the_mean(config):
    def worth(metrics, config):
        return config.uncertainty_threshold**2 + 3 * config.parameters["risk_weight"] + 0 * jnp.sum(metrics.reward)

    found = fleetjax.sensitivity(config, KEYS, ["uncertainty_threshold", "risk_weight"], objective=worth, num_samples=200)
    expected = {"uncertainty_threshold": 2 * 0.03, "risk_weight": 3.0}
    np.testing.assert_allclose(found.value, 0.03**2 + 3, rtol=1e-6)
    for name, slope in expected.items():
        error = found.standard_error[name]
        assert abs(found.gradient[name] - slope) < 4 * error
    # of the products of two normal numbers: the noise of the other field counts, too
    noise = {
        "uncertainty_threshold": math.hypot(2**0.5 * 0.06, 0.3 / 0.003),
        "risk_weight": math.hypot(2**0.5 * 3, 0.00018 / 0.1),
    }
    for name, deviation in noise.items():
        assert 0.5 < found.standard_error[name] / (deviation / 200**0.5) < 2.5


def test_tuning_can_be_compiled(config):
    found = jax.eval_shape(lambda keys: fleetjax.tune(config, keys, "risk_weight", steps=2, num_samples=2), KEYS)
    assert found.values["risk_weight"].shape == (3,)


def test_a_width_may_be_traced(config):
    def found(config):
        width = {"risk_weight": 0.5 * config.parameters["risk_weight"]}
        return fleetjax.sensitivity(config, KEYS[0], "risk_weight", width=width, num_samples=2)

    assert jax.eval_shape(found, config).gradient["risk_weight"].shape == ()


@pytest.mark.long
def test_samples_side_by_side_are_those_one_after_the_other(config, monkeypatch):
    loss = lambda metrics, config: jnp.sum(metrics.policy_loss)  # noqa: E731
    derive = partial(fleetjax.sensitivity, config, KEYS[0], "learning_rate", objective=loss, num_samples=6)
    alone = derive()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    pair = 6 * checks.count_bytes(checks.state_shapes(config, fleetjax.envs.make("navigation")))
    monkeypatch.setattr(checks, "memory", lambda: 2 * 2 * pair)
    monkeypatch.setattr(checks, "check_memory", lambda *_: None)
    assert gradients.chunk_size(config, fleetjax.envs.make("navigation")) == 2
    together = derive()
    np.testing.assert_allclose(together.gradient["learning_rate"], alone.gradient["learning_rate"], rtol=0.05)
    monkeypatch.setattr(checks, "memory", lambda: 0)
    assert gradients.chunk_size(config, fleetjax.envs.make("navigation")) == 1


@pytest.mark.long
def test_the_estimate_of_memory_is_what_the_program_takes(config):
    soft, env = config.replace(allocation="soft", num_steps=64, human_capacity=300), fleetjax.envs.make("navigation")
    derive = gradients.make_gradient(soft, env, human_time, ("risk_threshold",), "relaxed", {}, 2)
    values, state = {"risk_threshold": jax.typeof(soft.risk_threshold)}, checks.state_shapes(soft, env)
    program = jax.jit(derive).lower(values, KEYS[0], state).compile()
    assert 0.5 < gradients.reverse_bytes(soft, env) / program.memory_analysis().temp_size_in_bytes < 2


@pytest.mark.slow
def test_whole_numbers_can_be_smoothed(config):
    worth = lambda metrics, config: config.min_teleop_time.astype(jnp.float32) ** 2  # noqa: E731
    found = fleetjax.sensitivity(
        config, KEYS[0], "min_teleop_time", objective=worth, width={"min_teleop_time": 2.0}, num_samples=400
    )
    assert abs(found.gradient["min_teleop_time"] - 10) < 4 * found.standard_error["min_teleop_time"] < 10


@pytest.mark.long
def test_relaxed_and_forward_gradients_agree(config):
    soft = config.replace(allocation="soft", temperature=0.5)
    fields = ("uncertainty_threshold", "risk_weight", "learning_rate")
    reverse = fleetjax.sensitivity(config.replace(temperature=0.5), KEYS, fields, method="relaxed", objective=human_time)
    forward = fleetjax.sensitivity(soft, KEYS, fields, method="forward", objective=human_time)
    np.testing.assert_allclose(forward.value, reverse.value, rtol=1e-5)
    for name in fields:
        np.testing.assert_allclose(forward.gradient[name], reverse.gradient[name], rtol=1e-2, atol=1e-5)
        np.testing.assert_allclose(forward.standard_error[name], reverse.standard_error[name], rtol=1e-2, atol=1e-5)
    assert reverse.gradient["uncertainty_threshold"] < 0


def test_a_field_that_does_not_matter_is_told(config):
    fields = ("risk_threshold", "takeover_time", "learning_rate")  # perfect humans take over at once
    cases: list[tuple[Any, set[str]]] = [
        (human_time, {"takeover_time"}),
        (lambda metrics, config: config.risk_threshold, {"takeover_time", "learning_rate"}),
    ]
    for objective, unused in cases:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            derive = jax.jit(
                lambda keys, worth=objective: fleetjax.sensitivity(
                    config, keys, fields, objective=worth, width={"takeover_time": 1.0}, num_samples=2
                )
            )
            derive.lower(KEYS)
        told = {name for name in fields for one in caught if f"does not depend on {name}," in str(one.message)}
        assert told == unused


def test_a_derivative_that_is_zero_is_told(config):
    with pytest.warns(UserWarning, match="derivative by uncertainty_threshold is exactly 0.*try method = 'smoothed'"):
        fleetjax.sensitivity(config, KEYS[0], "uncertainty_threshold", method="forward")


@pytest.mark.slow
def test_tuning_climbs_and_stays_within_the_range(config):
    def worth(metrics, config):
        return -(((config.uncertainty_threshold - 0.02) / 0.01) ** 2) + 10 * config.risk_threshold

    fields = ("uncertainty_threshold", "risk_threshold")
    tuned = fleetjax.tune(config, KEYS, fields, steps=60, objective=worth, method="forward")
    np.testing.assert_allclose(tuned.config.uncertainty_threshold, 0.02, rtol=0.03)
    np.testing.assert_allclose(tuned.config.risk_threshold, 1.0)
    assert tuned.values["risk_threshold"].shape == (61,)
    assert tuned.values["risk_threshold"][0] == 0.5
    assert np.max(tuned.values["risk_threshold"]) <= 1
    assert tuned.objective[-1] > tuned.objective[0]


def refused(config, *, fields: Any = "risk_threshold", keys=KEYS, **options):
    with pytest.raises(ValueError, match=r"\w") as error:
        fleetjax.sensitivity(config, keys, fields, **options)
    return str(error.value)


def test_bad_requests_are_refused_before_anything_is_computed(config, monkeypatch):
    monkeypatch.setattr(gradients, "prepare", None)
    assert "risk_threshold" in refused(config, fields="risk_treshold")
    assert "acts only before t = 0" in refused(config, fields="critic_noise")
    assert "num_robots is static" in refused(config, fields="num_robots")
    assert "normalize_observations is a switch" in refused(config, fields="normalize_observations")
    assert "method = 'smoothed'" in refused(config, fields="initial_period", method="relaxed")
    assert "each once" in refused(config, fields=())
    assert "each once" in refused(config, fields=("risk_threshold", "risk_threshold"))
    assert "random_threshold is a parameter of algorithm = 'random'" in refused(config, fields="random_threshold")
    for number in (3, 2.0, "4", True):
        assert f"num_samples = {number!r} must be an even number" in refused(config, num_samples=number)
    for width in ("wide", "0.1", {"risk_threshold": None}, math.inf, math.nan):
        assert "must be a finite number" in refused(config, width=width)
    for options, message in (
        ({"steps": 2.5}, "steps = 2.5 must be a whole number"),
        ({"steps": True}, "steps = True must be a whole number"),
        ({"learning_rate": -1.0}, "learning_rate = -1.0 must be a finite number above 0"),
        ({"learning_rate": math.nan}, "learning_rate = nan must be a finite number above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            fleetjax.tune(config, KEYS, "risk_threshold", **options)
    assert "method = 'reverse'" in refused(config, method="reverse")
    assert "keys must be" in refused(config, keys=jnp.zeros(2, jnp.uint32))
    assert "width of goal_weight = 0.0" in refused(config, fields="goal_weight")
    assert "width names risk_weight" in refused(config, width={"risk_weight": 1.0})
    cur = fleetjax.make_config("navigation", "cur", **TINY)
    assert "'weighted'" in refused(cur, method="relaxed")
    pixels = fleetjax.make_config("block_push", "weighted", num_steps=5)
    assert "success_margin" in refused(pixels, method="relaxed")
    native = fleetjax.make_config("humanoid", "weighted", **{**TINY, "backend": "native"})
    assert "use method = 'smoothed', or backend = 'mjx'" in refused(native, method="forward")
    needed = gradients.reverse_bytes(config.replace(allocation="soft"), fleetjax.envs.make("navigation"))
    monkeypatch.setattr(checks, "memory", lambda: needed - 1)
    assert "num_steps = 6 is too large" in refused(config, method="relaxed")
    for name in ("uncertainty_threshold", "risk_threshold"):
        with pytest.raises(ValueError, match=f"{name} = 0"):
            fleetjax.make_config("navigation", "weighted", **{name: 0.0})
    with pytest.raises(ValueError, match="goal_weight = 1"):
        fleetjax.make_config("humanoid", "weighted", goal_weight=1.0)
    with pytest.raises(ValueError, match="temperature = 0"):
        fleetjax.validate(config.replace(allocation="soft", temperature=0.0))


@pytest.fixture(scope="module")
def on_mjx():
    tiny = {**TINY, "num_robots": 2, "num_humans": 1, "num_steps": 3, "backend": "mjx", "learning_rate": 0.01}
    return fleetjax.make_config("humanoid", "weighted", **tiny)


@pytest.mark.long
def test_mjx_has_no_reverse_derivatives(on_mjx):
    assert "use method = 'forward' or 'smoothed'" in refused(on_mjx, method="relaxed")


@pytest.mark.long
def test_forward_derivatives_on_mjx_are_those_of_differences(on_mjx):
    def reward(metrics, config):
        return jnp.sum(metrics.reward)

    derive = compiled(partial(fleetjax.sensitivity, fields="learning_rate", objective=reward, method="forward"))
    found, state = derive(on_mjx, KEYS[0]), compiled(fleetjax.prepare)(on_mjx, KEYS[0])
    run = compiled(lambda rate: reward(fleetjax.run(on_mjx.replace(learning_rate=rate), KEYS[0], state).metrics, on_mjx))
    difference = (run(jnp.float32(0.0101)) - run(jnp.float32(0.0099))) / 0.0002
    np.testing.assert_allclose(found.gradient["learning_rate"], difference, rtol=0.1)
    assert difference != 0
