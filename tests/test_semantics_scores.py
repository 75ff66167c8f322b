"""The rules of metrics and scores, 13, 14, 16 and 17, one test or more each, by numbers computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from reference.scenario import NOBODY, play
from toy_envs import NEVER

import fleetjax
from fleetjax import priority
from fleetjax.metrics import Metrics
from fleetjax.types import Signals

pytestmark = pytest.mark.usefixtures("toy_supervisors")


def test_semantic_13_metrics():
    trace = play(
        [[0, 0, 1, 0], [3, 2, 1, 0], [3, 2, 1, 0], [3, 2, 1, 0], NOBODY],
        falls_at=[1, 2, NEVER, NEVER],
        succeeds_at=[NEVER, NEVER, NEVER, 4],
        t_T=2,
        t_R=3,
    )
    # Robot 0 falls at t = 0 and robot 1 at t = 1. Human 0 teleoperates robot 2 for two timesteps, then resets robot 1; human 1
    # resets robot 0. Both robots fall again, at t = 4 and t = 6, and lie. Robot 3 succeeds at t = 3.
    assert trace.humans.robot[:7].tolist() == [[2, -1], [2, 0], [1, 0], [1, 0], [1, -1], [-1, -1], [-1, -1]]
    expected = {
        "violations": [1, 1, 0, 0, 1, 0, 1],
        "idle": [0, 1, 2, 2, 1, 1, 1],
        "moving": [4, 3, 2, 2, 3, 3, 3],
        "hard_resets": [0, 0, 0, 1, 1, 0, 0],
        "human_steps": [1, 2, 2, 2, 1, 0, 0],
        "teleop_steps": [1, 1, 0, 0, 0, 0, 0],
        "switches": [1, 1, 2, 0, 1, 1, 0],
        "successes": [0, 0, 0, 1, 0, 0, 0],
    }
    assert {name: getattr(trace.metrics, name)[:7].tolist() for name in expected} == expected
    policy = trace.recorded["robot_action"][:, :, 0]
    assert trace.metrics.reward[0] == pytest.approx(policy[0, [0, 1, 3]].sum() + 1, rel=1e-5)
    assert trace.metrics.reward[2] == pytest.approx(policy[2, [2, 3]].sum(), rel=1e-5)


def test_semantic_13_a_reset_costs_five_idle_timesteps_when_help_is_instant():
    scores = [NOBODY] * 6 + [[1, 1, 0, 0]] * 5 + [NOBODY]
    trace = play(scores, falls_at=[6, 6, NEVER, NEVER], t_R=5)
    assert trace.metrics.idle.tolist() == [0] * 6 + [2] * 5 + [0]
    assert trace.metrics.human_steps.tolist() == [0] * 6 + [2] * 5 + [0]
    assert trace.metrics.hard_resets.tolist() == [0] * 10 + [2] + [0]


def test_semantic_14_rohe_is_successes_per_hundred_human_steps_scaled_by_the_team():
    zeros = jnp.zeros(3)
    metrics = Metrics(*[zeros] * len(Metrics._fields))._replace(
        successes=jnp.array([1, 0, 2]), human_steps=jnp.array([50, 50, 0])
    )
    config = fleetjax.make_config("navigation", num_robots=100, num_humans=10)
    np.testing.assert_allclose(fleetjax.rohe(metrics, config), [0.1 / 1.5, 0.1 / 2, 0.3 / 2], rtol=1e-6)
    np.testing.assert_allclose(fleetjax.rohe(metrics, config, time_unit=1), [0.1 / 51, 0.1 / 101, 0.3 / 101], rtol=1e-6)
    many = metrics._replace(human_steps=np.full(3, 2**30, np.int32))  # their sum is beyond 32 bits
    np.testing.assert_allclose(fleetjax.rohe(many, config)[2], 0.3 / (1 + 3 * 2**30 / 100), rtol=1e-6)


def test_semantic_16_orders_are_lexicographic():
    signals = Signals(
        violation=jnp.array([False, True, False, True, False, False]),
        uncertainty=jnp.array([0.4, 0.0, 0.9, 0.4, 0.1, 0.2]),
        risk=jnp.array([0.6, 0.9, 0.0, 0.0, 0.9, 0.4]),
        goal=jnp.zeros(6),
        timestep=jnp.int32(0),
    )

    def score(name):
        config = fleetjax.Config().replace(uncertainty_threshold=0.2, risk_threshold=0.5)
        rule = priority.get_algorithm(name).make_priority(config)
        return compiled(rule.score)(signals, (), jax.random.key(0))[0].tolist()

    assert score("cur") == [3, 5, 4, 6, 1, 2]
    assert score("uc") == score("ensemble_dagger") == [3, 1, 5, 4, 0, 2]
    assert score("r") == [1, 2, 0, 0, 2, 0]


def test_semantic_17_thrifty_scores_by_hand():
    config = fleetjax.Config().replace(algorithm="thrifty_dagger", thrifty_weight=0.25, thrifty_threshold=0.7)
    rule = priority.get_algorithm("thrifty_dagger").make_priority(config)
    signals = Signals(jnp.array([True, False]), jnp.array([0.1, 0.3]), jnp.zeros(2), jnp.array([0.5, 0.5]), jnp.int32(0))
    score, moments = rule.score(signals, rule.init(), jax.random.key(0))
    # z(U) = -1, 1 and z(1 - Q_G) = 0: sums -0.75 and 0.75. Robot 1 is above; robot 0 violates.
    assert score.tolist() == [1, 2]
    signals = signals._replace(
        violation=jnp.array([False, False]), uncertainty=jnp.array([0.2, 0.4]), goal=jnp.array([0.1, 0.5])
    )
    score, moments = rule.score(signals, moments, jax.random.key(0))
    # All four so far: U has mean 0.25, deviation 0.1118; 1 - Q_G has mean 0.6, deviation 0.1732. Robot 0: -0.335 + 0.433;
    # robot 1: 1.006 - 0.144.
    np.testing.assert_allclose(moments.mean, [0.25, 0.6], rtol=1e-5)
    np.testing.assert_allclose(np.sqrt(moments.squares / 4), [0.1118034, 0.1732051], rtol=1e-4)
    assert score.tolist() == [0, 1]


@pytest.mark.parametrize(("threshold", "expected"), [(0.75, [0, 0]), (0.74, [0, 1])])
def test_semantic_17_at_the_threshold_thrifty_is_zero(threshold, expected):
    config = fleetjax.Config().replace(algorithm="thrifty_dagger", thrifty_weight=0.25, thrifty_threshold=threshold)
    rule = priority.get_algorithm("thrifty_dagger").make_priority(config)
    signals = Signals(jnp.zeros(2, bool), jnp.array([0.0, 1.0]), jnp.zeros(2), jnp.zeros(2), jnp.int32(0))
    assert rule.score(signals, rule.init(), jax.random.key(0))[0].tolist() == expected


def test_semantic_17_random_scores_every_robot_violating_or_not():
    rule = priority.get_algorithm("random").make_priority(fleetjax.Config().replace(algorithm="random", random_threshold=0.25))
    none = jnp.zeros(4)
    signals = Signals(jnp.array([True, False, True, False]), none, none, none, jnp.int32(0))
    key = jax.random.key(5)
    uniform = np.asarray(jax.random.uniform(key, (4,)))
    assert ((uniform < 0.25).sum(), (uniform >= 0.25).sum()) == (1, 3)
    assert rule.score(signals, (), key)[0].tolist() == np.where(uniform < 0.25, 0, uniform).tolist()
