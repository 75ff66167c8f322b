"""The rules of critics, metrics, scores, data and evaluation, 12 to 19, one test or more each, by numbers computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from compiling import compiled
from reference.scenario import play
from toy_envs import ALWAYS, NEVER

import fleetjax
from fleetjax import priority, supervisors
from fleetjax.envs import EnvSpec
from fleetjax.learning import critic, imitation
from fleetjax.learning.buffer import is_buffer
from fleetjax.learning.networks import Normalizer
from fleetjax.learning.pretraining import collect_demonstrations

pytestmark = pytest.mark.usefixtures("toy_supervisors")

SPEC = EnvSpec("hand", 1, 1, 10, 1.0, has_goal=True, supervisor="toy_scripted")
IDENTITY = Normalizer(jnp.zeros(1), jnp.ones(1), jnp.float32(jnp.inf))
SMALL = fleetjax.Config().replace(
    hidden_sizes=(1,), ensemble_size=2, batch_size=8, num_robots=4, num_humans=2, critic_capacity=20, risk_discount=0.5
)


def logit(probability):
    return np.log(probability) - np.log1p(-np.asarray(probability))


def constant(params, outputs, *, weight=0.0):
    """Return parameters of stacked one-unit networks [K] that answer `outputs` plus `weight` * relu(last input)."""
    (first_name, first), (last_name, last) = sorted(params["params"].items())
    first = {"kernel": jnp.zeros_like(first["kernel"]).at[:, -1].set(1.0), "bias": jnp.zeros_like(first["bias"])}
    bias = jnp.asarray(outputs, jnp.float32).reshape(last["bias"].shape)
    return {"params": {first_name: first, last_name: {"kernel": jnp.full_like(last["kernel"], weight), "bias": bias}}}


def last_bias(params):
    """Return the biases of the last layer of stacked networks with one output, f32[K]."""
    return max(params["params"].items())[1]["bias"][:, 0]


def constant_policy(learner: imitation.Learner, outputs) -> imitation.PolicyState:
    """Return an ensemble whose members answer `outputs` [E, A] everywhere, before tanh or softmax."""
    state = compiled(learner.init)(jax.random.key(0), IDENTITY)
    return state._replace(params=constant(state.params, outputs))


def learned_targets(kind: str, steps: list[tuple[bool, bool]], config=SMALL) -> list[float]:
    """Return the mean target of each twin for transitions (violation, success), worked out from the first gradient.

    The twins answer 0.3 and 0.6; their targets sigmoid(action - 1) and sigmoid(action) with the policy's mean action, 0.5.
    """
    learner = imitation.make_learner(config, SPEC)
    parts = critic.make_critic(kind, config, SPEC, learner)
    answers = np.array([0.3, 0.6])
    policy = constant_policy(learner, np.arctanh([0.2, 0.8]))

    def gradient(key):
        state = parts.init(key)
        state = state._replace(
            params=constant(state.params, logit(answers)), target=constant(state.target, [-1.0, 0.0], weight=1.0)
        )
        violation, success = jnp.array(steps).T
        stored = jnp.full((len(steps), 1), -1.0)  # neither the old observation nor the old action may count
        batch = critic.Transition(stored, stored, stored, violation, success)
        state = parts.append(state, batch, jnp.ones(len(steps), bool))
        after = parts.update(state, policy, key)
        return last_bias(after.opt_state.mu) / 0.1  # Adam's first mean is a tenth of the gradient

    slope = np.asarray(compiled(gradient)(jax.random.key(0)))
    return list(answers - slope / (2 * answers * (1 - answers)))  # d/db (sigmoid(b) - y)^2 = 2 (q - y) q (1 - q)


LOW, HIGH = 1 / (1 + np.exp(0.5)), 1 / (1 + np.exp(-0.5))  # targets' answers at the mean action 0.5


@pytest.mark.parametrize(
    ("kind", "violation", "success", "expected"),
    [
        ("safety", False, False, 0.5 * HIGH),
        ("safety", True, False, 1.0),
        ("safety", False, True, 0.5 * HIGH),  # a success is no end for the safety critic
        ("goal", False, False, 0.999 * LOW),
        ("goal", True, False, 0.0),
        ("goal", False, True, 1.0),
    ],
)
def test_semantic_12_targets(kind, violation, success, expected):
    np.testing.assert_allclose(learned_targets(kind, [(violation, success)]), expected, atol=1e-4)


def test_semantic_12_batches_hold_their_share_of_positives():
    # One positive among three transitions, yet two of the eight samples.
    steps = [(False, False), (True, False), (False, False)]
    config = SMALL.replace(positive_fraction=0.25)
    np.testing.assert_allclose(learned_targets("safety", steps, config), 0.25 + 0.75 * 0.5 * HIGH, atol=1e-4)


def test_semantic_12_critics_store_every_step_of_moving_robots_before_resets():
    trace = play([[1, 0, 0, 0]], falls_at=[NEVER, 2, NEVER, NEVER], succeeds_at=[3, NEVER, NEVER, NEVER])
    safety, goal = (trace.last.estimators[kind] for kind in ("safety", "goal"))
    moves = int(trace.metrics.moving.sum())
    assert moves == 3 * 12 + 2
    for c, positives in ((safety, 1), (goal, 4)):
        assert int(c.positives.added) == positives
        assert int(c.negatives.added) == moves - positives
    np.testing.assert_array_equal(safety.positives.rows.next_obs[0], [1, 2, 0])
    np.testing.assert_array_equal(goal.positives.rows.next_obs[:4], [[0, 3, 0]] * 4)  # s' of the step, not the fresh state
    np.testing.assert_array_equal(goal.positives.rows.action[:4], np.ones((4, 1)))  # the human's
    rows = safety.negatives.rows
    time_outs = rows.next_obs[: moves - 1, 1] == 10
    assert time_outs.sum() == 2  # of robots 2 and 3; kept as steps that go on
    assert not rows.violation[: moves - 1].any()


def test_semantic_12_the_goal_critic_is_pretrained_on_the_expert_and_the_safety_critic_on_the_novice(monkeypatch):
    everything = fleetjax.Algorithm(priority.get_algorithm("cur").make_priority, estimators=("safety", "goal"))
    monkeypatch.setitem(priority.ALGORITHMS.entries, "everything", everything)
    env = toy_envs.scripted([NEVER, 4, NEVER, NEVER], [3, NEVER, NEVER, NEVER], horizon=6)
    sizes = {
        "num_robots": 4,
        "num_humans": 2,
        "hidden_sizes": (1,),
        "ensemble_size": 2,
        "batch_size": 4,
        "critic_capacity": 100,
    }
    data = {"num_demonstrations": 4, "num_critic_transitions": 48, "critic_noise": 0.0}
    steps = {"pretraining_steps": 1, "critic_pretraining_steps": 1}
    config = fleetjax.make_config(env, "everything", **sizes, **data, **steps)
    state = compiled(lambda key: fleetjax.prepare(config, key, env))(jax.random.key(0))
    # Twelve steps of each of four robots: one succeeds in every third, one falls in every fourth.
    for kind, positives in (("safety", 3), ("goal", 4)):
        assert int(state.estimators[kind].positives.added) == positives
        assert int(state.estimators[kind].negatives.added) == 48 - positives
    learner = imitation.make_learner(config, env.spec)
    novice, expert = (state.estimators[kind].negatives.rows for kind in ("safety", "goal"))
    assert expert.action[:44].tolist() == [[1.0]] * 44
    np.testing.assert_allclose(novice.action[:45], learner.predict(state.policy, novice.obs[:45])[0], atol=1e-5)


def test_semantic_15_uncertainty_is_the_variance_between_members():
    spec = SPEC._replace(action_size=2)
    learner = imitation.make_learner(SMALL, spec)
    state = constant_policy(learner, np.arctanh([[0.5, 0.2], [-0.5, 0.2]]))
    obs = jnp.zeros((3, 1))
    np.testing.assert_allclose(learner.predict(state, obs)[1], [0.125] * 3, rtol=1e-5)  # (0.25 + 0) / 2
    np.testing.assert_allclose(learner.predict(state, obs)[0], [[0.0, 0.2]] * 3, atol=1e-6)
    state = constant_policy(learner, [[20.0, 20.0], [-20.0, -20.0]])
    np.testing.assert_allclose(learner.predict(state, obs)[1], [1.0] * 3, rtol=1e-5)  # the largest possible


def test_semantic_15_uncertainty_of_discrete_actions_is_shannon_entropy():
    spec = SPEC._replace(action_size=3, discrete=True)
    learner = imitation.make_learner(SMALL, spec)
    state = constant_policy(learner, np.log([[0.25, 0.5, 0.25]]))
    assert float(learner.predict(state, jnp.zeros(1))[1]) == pytest.approx(1.5 * np.log(2), rel=1e-5)
    assert learner.predict(state, jnp.zeros(1))[0].tolist() == [0, 1, 0]


@pytest.mark.parametrize(("kind", "expected"), [("safety", 0.6), ("goal", 0.3)])
def test_semantic_15_risk_is_the_larger_twin_and_goal_the_smaller(kind, expected):
    parts = critic.make_critic(kind, SMALL, SPEC, imitation.make_learner(SMALL, SPEC))
    state = compiled(parts.init)(jax.random.key(0))
    state = state._replace(params=constant(state.params, logit([0.3, 0.6])))
    np.testing.assert_allclose(parts.value(state, IDENTITY, jnp.zeros((2, 1)), jnp.zeros((2, 1))), [expected] * 2, rtol=1e-5)


def test_semantic_18_every_member_resamples_all_pairs_so_far_for_each_new_pair():
    members, capacity, arrivals = 5, 400, 100
    data = imitation.create_data(SPEC, ensemble_size=members, capacity=capacity)

    def add(data, key):
        pairs = imitation.Pair(jnp.ones((4, 1)), jnp.ones((4, 1)))
        return imitation.append(data, pairs, jnp.array([True, False, True, True]), key), None

    data, _ = compiled(lambda data, keys: jax.lax.scan(add, data, keys))(data, jax.random.split(jax.random.key(0), arrivals))
    size = int(data.pairs.size)
    assert size == 3 * arrivals
    resample = np.asarray(data.resample).T
    so_far = 3 * (np.arange(size) // 3 + 1)
    assert np.all((resample[:, :size] >= 0) & (resample[:, :size] < so_far))
    assert not resample[:, size:].any()
    assert np.any(resample[:, 3:size] >= so_far[3:] - 3)  # the new pairs are among them
    quantile = (resample[:, :size] + 0.5) / so_far
    assert np.all(np.abs(quantile.mean(axis=1) - 0.5) < 4 / np.sqrt(12 * size))  # uniform
    assert np.all(np.abs(np.corrcoef(quantile) - np.eye(members)) < 4 / np.sqrt(size))  # each its own


def test_semantic_18_a_member_learns_from_its_own_resample_only():
    learner = imitation.make_learner(SMALL, SPEC)
    state = constant_policy(learner, [0.0, 0.0])
    data = imitation.create_data(SPEC, ensemble_size=2, capacity=2)
    pairs = imitation.Pair(jnp.zeros((2, 1)), jnp.array([[1.0], [-1.0]]))
    data = imitation.append(data, pairs, jnp.ones(2, bool), jax.random.key(0))
    data = data._replace(resample=jnp.array([[0, 1], [0, 1]]))  # one member sees only the first pair, one only the second
    after, loss = compiled(learner.update)(state, data, jax.random.key(0))
    np.testing.assert_allclose(last_bias(after.params), [3e-4, -3e-4], rtol=1e-3)  # Adam's first step is the learning rate
    assert float(loss) == pytest.approx(1.0)


def test_semantic_8_robots_that_start_in_violation_are_not_driven_before_the_fleet_starts():
    env = toy_envs.scripted([ALWAYS, NEVER, NEVER, ALWAYS], [NEVER] * 4, horizon=6)
    small = {"num_demonstrations": 24, "num_critic_transitions": 48, "batch_size": 4, "hidden_sizes": (1,)}
    config = fleetjax.make_config(env, "cur", num_robots=4, num_humans=2, num_steps=1, **small)
    state = compiled(lambda config, key: fleetjax.prepare(config, key, env))(config, jax.random.key(0))
    pairs = state.human_data.pairs
    assert int(pairs.size) == 24
    assert np.unique(pairs.rows.obs[:24, 0]).tolist() == [1, 2]
    safety = [x for x in jax.tree.leaves(state.estimators["safety"], is_leaf=is_buffer) if is_buffer(x)]
    seen = np.concatenate([np.asarray(x.rows.obs[: int(x.size), 0]) for x in safety])
    assert len(seen) > 12
    assert set(seen.tolist()) == {1.0, 2.0}


def test_demonstrations_end_where_all_robots_start_in_violation():
    env = toy_envs.scripted([ALWAYS] * 2, [NEVER] * 2, horizon=6)
    config = fleetjax.make_config(
        env, num_robots=2, num_humans=1, num_steps=1, batch_size=4, hidden_sizes=(1,), num_demonstrations=24
    )
    state = compiled(lambda config, key: fleetjax.prepare(config, key, env))(config, jax.random.key(0))
    assert int(state.human_data.pairs.size) == 0


def test_semantic_19_demonstrations_are_whole_episodes_the_last_one_cut():
    env = toy_envs.scripted([NEVER, 2, 5, 9, 9, 9, 9, 9], [3, NEVER, NEVER, 9, 9, 9, 9, 9], horizon=10)
    config = fleetjax.make_config(env, num_robots=4, num_humans=2, num_demonstrations=8, batch_size=4, hidden_sizes=(1,))
    supervisor = supervisors.make("toy_scripted", env)
    data = imitation.create_data(env.spec, ensemble_size=2, capacity=50)
    data = compiled(lambda data, key: collect_demonstrations(config, env, supervisor, imitation.append, data, key))(
        data, jax.random.key(0)
    )
    assert int(data.pairs.size) == 8
    robot_and_clock = data.pairs.rows.obs[:8, :2].astype(int).tolist()
    assert robot_and_clock == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [2, 0], [2, 1], [2, 2]]
    assert data.pairs.rows.action[:8].tolist() == [[1.0]] * 8


def test_semantic_19_evaluation_resets_at_once_from_the_start_and_learns_nothing():
    env = toy_envs.scripted([2, NEVER, NEVER, NEVER], [NEVER, 3, NEVER, NEVER])
    sizes = {"num_robots": 4, "num_humans": 2, "num_steps": 8, "hidden_sizes": (1,), "ensemble_size": 2, "batch_size": 4}
    config = fleetjax.make_config(env, "cur", **sizes, hard_reset_time=3, initial_period=1000, num_demonstrations=4)
    learner = imitation.make_learner(config, env.spec).init(
        jax.random.key(0), Normalizer(jnp.zeros(3), jnp.ones(3), jnp.float32(10))
    )
    result = compiled(lambda key, learner: fleetjax.evaluate(config, key, learner, env))(jax.random.key(0), learner)
    assert result.metrics.violations.tolist() == [0, 1, 0, 0, 0, 0, 1, 0]
    assert result.metrics.hard_resets.tolist() == [0, 0, 0, 0, 1, 0, 0, 0]
    assert result.metrics.human_steps.tolist() == [0, 0, 1, 1, 1, 0, 0, 1]
    assert result.metrics.teleop_steps.tolist() == [0] * 8
    assert result.metrics.successes.tolist() == [0, 0, 1, 0, 0, 1, 0, 0]  # fresh episodes
    jax.tree.map(np.testing.assert_array_equal, result.state.policy, learner)
