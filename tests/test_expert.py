"""Shipped experts act as the policies that brax trained."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import train_expert
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks
from trainings import TRAININGS

from fleetjax import envs, expert_records, supervisors
from fleetjax.envs import allegro_hand, anymal
from fleetjax.supervisors import expert


@pytest.fixture(autouse=True)
def standard_promotion():
    """Let brax mix types."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def trained(name):
    """Return a training, brax's networks, and parameters in which every number matters."""
    training = TRAININGS[name]
    factory = train_expert.network_factory(training, training.stages[-1].mirror)
    nets = factory(48, 12, preprocess_observations_fn=running_statistics.normalize)
    policy = nets.policy_network.init(jax.random.key(0))
    policy = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(jax.random.key(1), x.shape), policy)
    statistics = running_statistics.init_state(specs.Array((48,), jnp.dtype("float32")))
    draws = 2.0 + 3.0 * jax.random.normal(jax.random.key(2), (50, 48))
    return training, nets, (running_statistics.update(statistics, draws), policy, None)


@pytest.mark.parametrize("name", ["humanoid", pytest.param("anymal", marks=pytest.mark.slow), "allegro_hand"])
def test_weights_act_as_brax_does(name):
    """tanh of the mean, the clipped mean of robot and mirror image, or the clipped mean."""
    training, nets, params = trained(name)
    obs = 5.0 * jax.random.normal(jax.random.key(3), (40, 48))
    policy = networks.make_inference_fn(nets)(params[:2], deterministic=True)
    action = np.clip(policy(obs, jax.random.key(0))[0], -1, 1)
    weights = train_expert.as_weights(params, training)
    np.testing.assert_allclose(expert.policy(weights, obs), action, atol=2e-5)
    np.testing.assert_allclose(expert.policy(weights, obs[7]), action[7], atol=2e-5)
    assert np.std(action) > 0.1


def test_symmetric_networks_treat_a_mirror_image_as_the_robot():
    training, nets, (statistics, policy, _) = trained("anymal")
    mirror = training.stages[-1].mirror
    assert mirror is not None
    value = nets.value_network.init(jax.random.key(4))
    obs = 5.0 * jax.random.normal(jax.random.key(3), (40, 48))
    mean, deviation = nets.policy_network.apply(statistics, policy, obs)
    mean_mirrored, deviation_mirrored = nets.policy_network.apply(statistics, policy, mirror.obs(obs))
    np.testing.assert_allclose(mean_mirrored, mirror.action(mean), atol=2e-5)
    np.testing.assert_allclose(deviation_mirrored, np.abs(mirror.action(deviation)), atol=2e-5)
    worth = nets.value_network.apply(statistics, value, obs)
    np.testing.assert_allclose(nets.value_network.apply(statistics, value, mirror.obs(obs)), worth, atol=2e-5)
    assert np.std(mean) > 0.1
    assert np.std(worth) > 0.1


def test_a_mirror_image_does_the_mirrored_thing_in_the_task_as_well():
    mirror, task = TRAININGS["anymal"].stages[-1].mirror, envs.make("anymal", "native")
    assert mirror is not None
    state = task.reset(jax.random.key(0), jnp.int32(0))
    image = _mirror_image(state, mirror)
    step = jax.jit(task.step)
    for key in jax.random.split(jax.random.key(1), 8):
        action = 0.3 * jax.random.normal(key, (12,))
        state = step(state, action, jnp.bool_(True), key)
        image = step(image, mirror.action(action), jnp.bool_(True), key)
        np.testing.assert_allclose(image.obs, mirror.obs(state.obs), atol=0.02)
        assert np.abs(image.obs - state.obs).max() > 0.3
    np.testing.assert_array_equal(mirror.obs(mirror.obs(state.obs)), state.obs)


def _mirror_image(state, mirror):
    """Return the beginning of an episode with left and right changed over: the robot stands straight, and does not move."""
    walker = state.physics
    joints = [mirror.action(x) for x in (walker.body.qpos[7:], walker.body.qvel[6:])]
    body = walker.body._replace(qpos=walker.body.qpos.at[7:].set(joints[0]), qvel=walker.body.qvel.at[6:].set(joints[1]))
    walker = walker._replace(body=body, command=walker.command * jnp.array([1, -1, -1]))
    return state._replace(physics=walker, obs=anymal.observe(walker, jnp.zeros(12)))


def test_a_stage_sets_the_noise_and_nothing_else():
    _, _, (_, policy, _) = trained("anymal")
    changed = train_expert.set_noise(policy, 0.25)["params"]
    np.testing.assert_allclose(np.exp(changed["std_logparam"]["log_value"]), np.full(12, 0.25), rtol=1e-6)
    for module in ("MLP_0", "Dense_0"):
        jax.tree.map(np.testing.assert_array_equal, changed[module], policy["params"][module])


@pytest.mark.slow
def test_networks_see_the_view_and_a_stage_sets_the_tolerance():
    training = TRAININGS["allegro_hand"]
    easy = train_expert.Task(training, training.stages[0]._replace(options={"tolerance": 4.0}))
    hard = train_expert.Task(training, training.stages[0]._replace(options={"tolerance": 0.0}))
    state = jax.jit(easy.reset)(jax.random.key(0))
    assert state.obs.shape == (easy.observation_size,) == (85,)
    reached, missed = (jax.jit(task.step)(state, jnp.zeros(16)) for task in (easy, hard))
    assert (float(reached.metrics["successes"]), float(missed.metrics["successes"])) == (1, 0)
    np.testing.assert_allclose(reached.reward - missed.reward, 2, atol=1e-5)
    np.testing.assert_array_equal(missed.pipeline_state.physics.goal, state.pipeline_state.physics.goal)
    assert np.abs(reached.pipeline_state.physics.goal - state.pipeline_state.physics.goal).max() > 1e-3
    np.testing.assert_allclose(reached.obs, allegro_hand.view(reached.pipeline_state.obs), atol=1e-5)
    np.testing.assert_allclose(reached.obs[69:], state.obs[69:], atol=1e-6)  # no change of the targets


@pytest.mark.parametrize("name", [path.stem for path in Path(expert.__file__).parent.glob("weights/*.npz")])
def test_every_shipped_expert_has_its_record(name):
    env = envs.make(name)
    record = expert_records.record(name)
    assert record["environment"] == name
    assert 0 < record["share_full_length"] <= 1
    assert record["mean_return_full_length"] >= record["mean_return"]
    weights, view = expert.load_weights(name), TRAININGS[name].view
    supervisor = supervisors.make(name, env)
    state = env.reset(jax.random.key(0), jnp.int32(0))
    assert weights["obs_mean"].shape == view(state.obs).shape
    np.testing.assert_array_equal(supervisor.act(state, jax.random.key(0)), expert.policy(weights, state.obs, view))
