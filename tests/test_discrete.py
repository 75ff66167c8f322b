"""C.U.R. with discrete actions on the small board of `toy_envs`: one classifier, entropy as uncertainty."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from compiling import compiled

import fleetjax
from fleetjax.envs import begin
from fleetjax.learning import imitation

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("toy_supervisors")]

NUM_CHOICES = 4


@pytest.fixture(scope="module")
def outcome(toy_supervisors):
    """Return the environment, the configuration, and the result of a run."""
    env = toy_envs.grid()
    config = fleetjax.make_config(
        env,
        "cur",
        num_robots=10,
        num_humans=3,
        num_steps=300,
        uncertainty_threshold=0.5,
        hard_reset_time=3,
        num_demonstrations=20,
        batch_size=20,
        hidden_sizes=(32,),
        learning_rate=1e-2,
        pretraining_steps=30,
        num_critic_transitions=100,
        critic_pretraining_steps=20,
        critic_capacity=1000,
    )
    run = compiled(lambda key: fleetjax.run(config, key, env=env))
    return env, config, run(jax.random.key(0))


def test_pairs_are_choices_of_the_teacher(outcome):
    _, _, result = outcome
    pairs = result.state.human_data.pairs
    number = int(pairs.size)
    assert number == 20 + int(result.metrics.teleop_steps.sum())
    actions = np.asarray(pairs.rows.action[:number])
    assert set(actions.ravel()) == {0.0, 1.0}
    np.testing.assert_array_equal(actions.sum(axis=1), 1)
    assert np.all(actions.any(axis=0))


def test_uncertainty_is_the_entropy_of_one_classifier_and_falls(outcome):
    _, _, result = outcome
    uncertainty = np.asarray(result.metrics.uncertainty)
    assert {leaf.shape[0] for leaf in jax.tree.leaves(result.state.policy.params)} == {1}
    assert uncertainty.min() >= 0
    assert uncertainty.max() <= np.log(NUM_CHOICES)
    assert uncertainty[-50:].mean() < 0.5 * uncertainty[:10].mean()


def test_robots_fall_less_and_succeed_more_as_the_classifier_learns(outcome):
    _, _, result = outcome
    metrics = jax.tree.map(np.asarray, result.metrics)
    assert metrics.violations[-100:].sum() < metrics.violations[:100].sum()
    assert metrics.successes[-100:].sum() > metrics.successes[:100].sum()


def test_the_classifier_agrees_with_the_teacher(outcome):
    env, config, result = outcome
    cells = itertools.product(range(toy_envs.BOARD), repeat=4)
    physics = jnp.array([cell for cell in cells if cell[:2] != cell[2:]])
    states = jax.vmap(lambda p: begin(p, p.astype(jnp.float32) * (2 / (toy_envs.BOARD - 1)) - 1))(physics)
    robot = imitation.make_learner(config, env.spec).predict(result.state.policy, states.obs)[0]
    teacher = jax.vmap(toy_envs.teach_grid)(states)
    assert float(jnp.mean(jnp.argmax(robot, axis=1) == jnp.argmax(teacher, axis=1))) > 0.85
