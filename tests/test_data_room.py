"""Nothing that people taught is lost silently, and a run starts only from a state that fits it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from compiling import compiled

import fleetjax
from fleetjax.learning import critic, imitation, pretraining

pytestmark = pytest.mark.usefixtures("toy_supervisors")

SMALL = {
    "num_robots": 4,
    "num_humans": 2,
    "num_steps": 30,
    "ensemble_size": 2,
    "hidden_sizes": (4,),
    "batch_size": 8,
    "gradient_steps": 1,
    "critic_capacity": 50,
    "num_demonstrations": 20,
    "pretraining_steps": 1,
    "critic_pretraining_steps": 1,
    "num_critic_transitions": 20,
    "uncertainty_threshold": 0.0,
}
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def config():
    return fleetjax.make_config("navigation", "uc", **SMALL)


@pytest.fixture(scope="module")
def safe():
    """An environment in which nothing happens, so that humans teach at every timestep."""
    return toy_envs.scripted([0] * 4, [0] * 4, horizon=50)


@pytest.fixture(scope="module")
def safe_config(safe):
    return fleetjax.make_config(safe, "uc", **SMALL)


@pytest.fixture(scope="module")
def run(safe):
    return compiled(functools.partial(fleetjax.run, env=safe))


@pytest.fixture(scope="module")
def full(safe_config, run):
    """The result of a run whose humans taught at every timestep; its state has no room left."""
    result = run(safe_config, KEY)
    assert int(result.metrics.teleop_steps.sum()) == 60
    assert int(result.metrics.dropped.sum()) == 0
    assert int(result.state.human_data.pairs.added) == 80 == result.state.human_data.pairs.capacity
    return result


def test_a_full_state_is_refused_and_extended_it_keeps_all(safe, safe_config, run, full):
    with pytest.raises(
        ValueError, match=r"num_steps = 30 can produce 60 human pairs.*room for 0 more.*fleetjax\.extend\(state, 60\)"
    ):
        fleetjax.run(safe_config, KEY, full.state, safe)
    extended = fleetjax.extend(full.state, 60)
    before, after = full.state.human_data, extended.human_data
    kept = jax.tree.map(lambda rows: rows[:80], (after.pairs.rows, after.resample))
    jax.tree.map(np.testing.assert_array_equal, kept, (before.pairs.rows, before.resample))
    again = run(safe_config, KEY, extended)
    assert int(again.state.human_data.pairs.added) == 140
    assert int(again.metrics.dropped.sum()) == 0


def test_pairs_without_room_are_counted_where_the_state_is_traced(safe_config, run, full):
    again = run(safe_config, KEY, full.state)
    assert int(again.state.human_data.pairs.added) == 80
    np.testing.assert_array_equal(again.metrics.dropped, again.metrics.teleop_steps)
    assert int(again.metrics.dropped.sum()) == 60


def test_a_run_longer_than_its_state_has_room_for_is_refused_even_when_traced(config):
    start = jax.eval_shape(lambda: fleetjax.prepare(config, KEY))
    with pytest.raises(ValueError, match=r"num_steps = 50.*room for 80 more.*extend\(state, 20\)"):
        jax.eval_shape(lambda state: fleetjax.run(config.replace(num_steps=50), KEY, state), start)


@pytest.mark.parametrize("name", ["num_demonstrations", "extra_demonstrations"])
def test_a_swept_number_of_demonstrations_needs_a_capacity(config, name):
    numbers = jnp.array([25, 60])
    with pytest.raises(ValueError, match=f"{name} is traced. Also pass human_capacity: .* times augmented_copies, plus 60"):
        jax.vmap(lambda n: config.replace(**{name: n}))(numbers)
    explicit = jax.vmap(lambda n: config.replace(**{name: n}, human_capacity=200))(numbers)
    assert explicit.human_capacity == 200
    assert jax.vmap(lambda n: config.replace(human_capacity=200).replace(**{name: n}))(numbers).human_capacity == 200


@pytest.mark.slow
def test_demonstrations_without_room_are_counted_at_the_start(config):
    """Where a sweep's capacity is too small for its larger setting; the smaller one loses nothing."""
    numbers = jnp.array([25, 60])
    sweep = jax.vmap(lambda n: config.replace(num_demonstrations=n, human_capacity=64, num_steps=2))(numbers)
    result = compiled(jax.vmap(fleetjax.run, in_axes=(0, None)))(sweep, KEY)
    taught = result.metrics.teleop_steps.sum(axis=1)
    assert taught.tolist() == [4, 4]
    assert result.state.human_data.pairs.added.tolist() == [29, 64]
    assert result.metrics.dropped[:, 0].tolist() == [0, 0]
    assert result.metrics.dropped.sum(axis=1).tolist() == [0, 0]
    tight = jax.vmap(lambda n: config.replace(num_demonstrations=n, human_capacity=40, num_steps=2))(numbers)
    result = compiled(jax.vmap(fleetjax.run, in_axes=(0, None)))(tight, KEY)
    assert result.state.human_data.pairs.added.tolist() == [29, 40]
    assert result.metrics.dropped.tolist() == [[0, 0], [22, 2]]


def test_capacity_follows_the_other_fields_unless_it_is_given(config):
    assert config.human_capacity == 80
    assert config.replace(num_steps=10).human_capacity == 40
    assert config.replace(num_steps=10).replace(num_steps=100).human_capacity == 220
    given = config.replace(human_capacity=500)
    assert given.replace(num_steps=10).human_capacity == 500
    assert given.replace(human_capacity=0).human_capacity == 80
    assert jax.eval_shape(lambda c: c.replace(num_steps=100), config).human_capacity == 220


def test_a_capacity_that_is_given_does_not_grow_unasked(config):
    assert fleetjax.make_config("navigation", "uc", **SMALL, human_capacity=80).human_capacity == 80
    with pytest.raises(ValueError, match=r"human_capacity = 3 is less than the 80 pairs .* omit it, or pass at least 80"):
        fleetjax.make_config("navigation", "uc", **SMALL, human_capacity=3)
    with pytest.raises(ValueError, match=r"human_capacity = 3 .* pass at least 80"):
        fleetjax.validate(config.replace(human_capacity=3))
    assert config.replace(human_capacity=100).replace(num_steps=100).human_capacity == 220  # a longer run needs more


def test_extend_takes_several_fleets_and_refuses_nonsense(config):
    several = jax.eval_shape(lambda keys: jax.vmap(lambda k: fleetjax.prepare(config, k))(keys), jax.random.split(KEY, 3))
    rows = jax.eval_shape(lambda s: fleetjax.extend(s, 5), several).human_data
    assert rows.pairs.rows.obs.shape == (3, 85, 8)
    assert rows.resample.shape == (3, 85, 2)
    one = jax.eval_shape(lambda: fleetjax.prepare(config, KEY))
    for number in (-1, 1.5, True, 2**31):
        with pytest.raises(ValueError, match="num_pairs"):
            fleetjax.extend(one, number)


@pytest.mark.parametrize(
    ("environment", "algorithm", "change", "message"),
    [
        ("navigation", "uc", {"num_humans": 3}, "num_humans = 3, but the state was prepared for 2"),
        ("navigation", "uc", {"num_robots": 5}, "num_robots = 5, but the state was prepared for 4"),
        ("block_push", "uc", {}, "environment = 'block_push', but the state was prepared for 'navigation'"),
        ("navigation", "cur", {}, "algorithm = 'cur' keeps other estimators or another memory than 'uc'"),
        ("navigation", "thrifty_dagger", {}, "algorithm = 'thrifty_dagger' keeps other estimators or another memory than 'uc'"),
        ("navigation", "uc", {"hidden_sizes": (4, 4)}, r"structure that .*, hidden_sizes, estimators, .*; call prepare with"),
        ("navigation", "uc", {"hidden_sizes": (5,)}, r"its \.policy\.params.*float32\[2, 4\]; expected float32\[2, 5\]"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_with_both_sides_named(config, environment, algorithm, change, message):
    state = jax.eval_shape(lambda: fleetjax.prepare(config, KEY))
    other = fleetjax.make_config(environment, algorithm, **SMALL | change)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda state: fleetjax.run(other, KEY, state), state)


def test_several_fleets_are_not_taken_for_one(config):
    several = jax.eval_shape(lambda keys: jax.vmap(lambda k: fleetjax.prepare(config, k))(keys), jax.random.split(KEY, 3))
    with pytest.raises(ValueError, match="the state holds several fleets"):
        jax.eval_shape(lambda state: fleetjax.run(config, KEY, state), several)


@pytest.mark.parametrize("num_robots", [3, 20])
def test_every_robot_of_the_fleet_is_demonstrated_and_no_other(num_robots):
    """The first number of an observation is the robot; episodes have five steps."""
    env = toy_envs.scripted([0] * num_robots, [0] * num_robots, horizon=5)
    config = fleetjax.make_config(env, "uc", **SMALL | {"num_robots": num_robots, "num_demonstrations": 5 * num_robots})
    start = compiled(lambda key: fleetjax.prepare(config, key, env))(KEY)
    robots = np.asarray(start.human_data.pairs.rows.obs[: 5 * num_robots, 0])
    np.testing.assert_array_equal(robots, np.repeat(np.arange(num_robots), 5))


def test_critics_see_robots_from_all_along_a_large_fleet(monkeypatch):
    """With four at a time out of ten, and episodes of five steps."""
    monkeypatch.setattr(pretraining, "MOST_LANES", 4)
    env = toy_envs.scripted([0] * 10, [0] * 10, horizon=5)
    config = fleetjax.make_config(env, "cur", **SMALL | {"num_robots": 10, "num_critic_transitions": 60, "critic_capacity": 60})
    learner = imitation.make_learner(config, env.spec)
    parts = critic.make_critic("safety", config, env.spec, learner)
    act = lambda state, key: jnp.zeros((4, 1))  # noqa: E731
    store = compiled(lambda key: pretraining.collect_transitions(config, env, act, parts.append, parts.init(key), key))(KEY)
    robots, steps = np.unique(np.asarray(store.negatives.rows.obs[:60, 0]), return_counts=True)
    assert robots.tolist() == list(range(10))
    assert steps.tolist() == [10, 10] + [5] * 8
