"""Numbers that are not finite stay where they arise: one robot stands in violation, or a run says that it diverged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from reference import recording

import fleetjax
from fleetjax import envs, metrics, tree
from fleetjax.fleet import make_fleet

N, BAD = 6, 2  # robots, and which of them is spoilt
SPOILT = [np.nan, np.inf, -np.inf]


def make_config(name: str, algorithm: str, **changed) -> fleetjax.Config:
    small = {
        "num_robots": N,
        "num_humans": N,
        "hidden_sizes": (4,),
        "ensemble_size": 2,
        "batch_size": 4,
        "num_demonstrations": 4,
        "augmented_copies": 1,
    }
    short = {"num_steps": 40, "hard_reset_time": 3, "human_capacity": 400, "critic_capacity": 300, "uncertainty_threshold": 0.0}
    return fleetjax.make_config(name, algorithm, **small | short | {"initial_period": 0, "gradient_steps": 0} | changed)


def fleet_of(config: fleetjax.Config):
    """Return the environment, the fleet, and a first state with data in its buffers, so that everything can be learnt."""
    env = envs.make(config.environment, config.backend)
    fleet = make_fleet(config, env)
    state = recording.start(config, env, jax.random.key(0))
    return env, fleet, state


def rows(part, keep):
    return jax.tree.map(lambda x: np.asarray(x)[keep], part)


OTHERS = np.arange(N) != BAD


def spoil_obs(state, value):
    return state._replace(env=state.env._replace(obs=state.env.obs.at[BAD, 1].set(value)))


def spoil_physics(state, value):
    """The first real number of the robot's own state, whatever the environment keeps there."""
    leaves, structure = jax.tree.flatten(state.env.physics)
    first = next(i for i, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.ndim > 1)
    leaves[first] = leaves[first].at[BAD].set(value)
    return state._replace(env=state.env._replace(physics=jax.tree.unflatten(structure, leaves)))


def spoil_nothing(state, value):
    return state


@pytest.mark.parametrize(
    "name", [pytest.param(e, marks=[] if e == "navigation" else pytest.mark.slow) for e in fleetjax.list_envs()]
)
def test_one_robots_numbers_do_not_reach_its_neighbours(name):
    """State, observation, or a human's action: it is a violation, reset within a few timesteps, and nobody else is touched."""
    config = make_config(name, "u")  # everybody is teleoperated, so that a human's action is taken
    env, fleet, first = fleet_of(config)

    def step(state, key, spoilt_action):
        state, plan = fleet.plan(state, key)
        action = 0.1 * jax.random.normal(key, (N, env.spec.action_size))
        return fleet.advance(state, plan, action.at[BAD, 0].add(spoilt_action), plan.teleoperated, key)

    step = compiled(step)
    expected, _ = step(first, jax.random.key(1), 0.0)
    for value in SPOILT:
        for spoil, action in ((spoil_obs, 0.0), (spoil_physics, 0.0), (spoil_nothing, value)):
            after, counts = step(spoil(first, value), jax.random.key(1), action)
            jax.tree.map(np.testing.assert_array_equal, rows(after.env, OTHERS), rows(expected.env, OTHERS))
            stayed_sound = name == "navigation" and action  # its actions are clipped: infinity is just a long step
            if np.isnan(action) or not stayed_sound:
                assert bool(after.env.violation[BAD]), (spoil, value)
                assert int(counts.violations) == int(np.sum(expected.env.violation[OTHERS])) + 1
            shown = (after.env.obs, after.env.reward, after.env.episode_return, after.human_data.pairs.rows)
            assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(shown))
            assert np.all(np.isfinite(counts.reward))
    for t in range(2, 8):
        after, counts = step(after, jax.random.key(t), 0.0)
    assert np.all(tree.finite((after.env.obs, after.env.physics)))


@pytest.fixture(scope="module", params=["cur", "thrifty_dagger", "ensemble_dagger"])
def learning(request):
    config = make_config("navigation", request.param)
    _, fleet, first = fleet_of(config)

    def run(state):
        return jax.lax.scan(lambda s, t: fleet.step(s, jax.random.fold_in(jax.random.key(5), t)), state, jnp.arange(40))

    return compiled(run), first


@pytest.mark.parametrize("spoil", [spoil_obs, spoil_physics])
def test_where_nothing_is_learnt_and_nobody_competes_neighbours_never_differ(learning, spoil):
    run, first = learning
    (expected, expected_counts), (after, counts) = run(first), run(spoil(first, np.nan))
    jax.tree.map(np.testing.assert_array_equal, rows(after.env, OTHERS), rows(expected.env, OTHERS))
    assert int(counts.violations[0]) == int(expected_counts.violations[0]) + 1
    assert not counts.diverged.any()
    assert np.all(np.isfinite(after.env.obs))
    for stored in (after.human_data.pairs.rows, after.estimators, after.priority):
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(stored))
    assert int(counts.hard_resets.sum()) >= 1
    assert bool(after.env.episode_step[BAD] > 0) or bool(after.env.violation[BAD])


def spoil_member(state):
    params = jax.tree.map(lambda x: x.at[1].set(jnp.nan), state.policy.params)
    return state._replace(policy=state.policy._replace(params=params))


def spoil_critic(kind):
    def spoil(state):
        critic = state.estimators[kind]
        target = jax.tree.map(lambda x: x.at[0].set(jnp.inf), critic.target)
        return state._replace(estimators=state.estimators | {kind: critic._replace(target=target)})

    return spoil


def spoil_memory(state):
    return state._replace(priority=state.priority._replace(mean=jnp.full(2, jnp.nan)))


@pytest.mark.parametrize(
    ("algorithm", "spoil", "named"),
    [
        ("cur", spoil_member, ("policy",)),
        ("cur", spoil_critic("safety"), ("safety critic",)),
        ("thrifty_dagger", spoil_critic("goal"), ("goal critic",)),
        ("thrifty_dagger", spoil_memory, ("priority",)),
    ],
)
def test_what_diverged_and_when_first_is_told(algorithm, spoil, named):
    config = make_config("navigation", algorithm)
    _, fleet, first = fleet_of(config)

    @compiled
    def run(state):
        def step(state, t):
            state = jax.lax.cond(t == 7, spoil, lambda s: s, state)
            return fleet.step(state, jax.random.fold_in(jax.random.key(5), t))

        return jax.lax.scan(step, state, jnp.arange(12))

    _, counts = run(first)
    assert metrics.first_divergence(counts) == (7, named)
    assert metrics.first_divergence(jax.tree.map(lambda x: x[:7], counts)) is None


@pytest.mark.slow
def test_learning_that_diverges_is_told():
    """Steps as long as f32 goes blow up the policy, really, in the first timesteps with data."""
    config = make_config("navigation", "cur", gradient_steps=1, learning_rate=3e38, num_demonstrations=20, pretraining_steps=1)
    counts = compiled(fleetjax.run)(config, jax.random.key(0)).metrics
    first, names = metrics.first_divergence(counts) or (None, ())
    assert first is not None
    assert set(names) & {"policy", "safety critic"}


def test_rows_are_finite_or_not():
    a = jnp.array([[1.0, 2.0], [jnp.nan, 0.0], [0.0, jnp.inf]])
    assert tree.finite((a, jnp.array([1.0, 1.0, 1.0]))).tolist() == [True, False, False]
    assert tree.finite((a[:1], jnp.array([-jnp.inf]))).tolist() == [False]
