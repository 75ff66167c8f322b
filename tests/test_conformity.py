"""What every registered environment, supervisor and algorithm must do; none of them is named here."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled

import fleetjax
from fleetjax import HumanState, Signals, envs, priority, supervisors
from fleetjax.config import get_value
from fleetjax.learning.estimators import ESTIMATORS
from fleetjax.physics.base import PhysicsState

NUM_ROBOTS = 8
NUM_STEPS = 200

each_env = pytest.mark.parametrize("name", fleetjax.list_envs())
each_supervisor = pytest.mark.parametrize("name", fleetjax.list_supervisors())
each_algorithm = pytest.mark.parametrize("name", fleetjax.list_algorithms())


class Suite:
    """An environment, eight robots that each hold one extreme action, and all states that they pass through."""

    def __init__(self, name: str):
        self.env = env = envs.make(name)
        self.robots = jnp.arange(NUM_ROBOTS)
        self.keys = jax.random.split(jax.random.key(0), NUM_ROBOTS)
        self.reset = compiled(jax.vmap(env.reset))
        self.step = compiled(jax.vmap(env.step))
        self.active = jnp.ones(NUM_ROBOTS, bool)
        self.start = self.reset(self.keys, self.robots)
        draws = jax.random.normal(jax.random.key(1), (NUM_ROBOTS, env.spec.action_size))
        self.action = jax.nn.one_hot(draws.argmax(1), draws.shape[1]) if env.spec.discrete else jnp.sign(draws)

        def hold(state, key):
            after = jax.vmap(env.step)(state, self.action, self.active, jax.random.split(key, NUM_ROBOTS))
            return after, after

        scan = compiled(lambda start, keys: jax.lax.scan(hold, start, keys)[1])
        self.step_keys = jax.random.split(jax.random.key(2), NUM_STEPS)
        self.states = scan(self.start, self.step_keys)

    def before_violation(self):
        """Return, for each robot that falls, its state one step before, and what the step needs; others as at step 1."""
        fall = np.asarray(self.states.violation).argmax(axis=0)
        assert fall.max() > 0, "no robot violates: hold other actions"
        last = np.maximum(fall - 1, 0)
        state = jax.tree.map(lambda x: x[last, np.arange(NUM_ROBOTS)], self.states)
        keys = jnp.stack([jax.random.split(self.step_keys[last[i] + 1], NUM_ROBOTS)[i] for i in range(NUM_ROBOTS)])
        return state, keys, fall > 0


suite = functools.cache(Suite)


def types(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype, getattr(x, "weak_type", False)), tree)


def assert_same(tree, other):
    jax.tree.map(np.testing.assert_array_equal, tree, other)


def bodies(physics) -> list[PhysicsState]:
    """Return what the physics backends step, out of an environment's own state."""
    parts = jax.tree.leaves(physics, is_leaf=lambda x: isinstance(x, PhysicsState))
    return [part for part in parts if isinstance(part, PhysicsState)]


def assert_close(tree, other):
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), tree, other)


# Environments


@each_env
def test_env_keeps_shapes_and_types(name):
    env = suite(name).env
    key, action = jax.random.key(0), jax.ShapeDtypeStruct((env.spec.action_size,), jnp.float32)
    first = jax.eval_shape(env.reset, key, jnp.int32(0))
    assert types(jax.eval_shape(env.step, first, action, True, key)) == types(first)
    assert (first.obs.shape, first.obs.dtype) == ((env.spec.observation_size,), jnp.float32)
    scalars = [(leaf.shape, leaf.dtype) for leaf in first[2:]]
    assert scalars == [((), jnp.dtype(t)) for t in ("float32", "bool", "bool", "bool", "float32", "int32")]
    if env.next_goal:
        assert types(jax.eval_shape(env.next_goal, first, key)) == types(first)


@each_env
def test_env_spec_says_who_it_is(name):
    spec = suite(name).env.spec
    assert spec.name == name
    assert spec.supervisor in fleetjax.list_supervisors()
    assert spec.control_step > 0
    assert envs.make(name) is envs.make(name)


@each_env
def test_env_starts_by_key(name):
    s = suite(name)
    assert_same(s.reset(s.keys, s.robots), s.start)
    assert len(np.unique(np.asarray(s.start.obs), axis=0)) == NUM_ROBOTS
    assert not np.any(s.start.violation | s.start.success | s.start.timeout)
    assert not np.any(s.start.reward)
    assert not np.any(s.start.episode_return)
    assert not np.any(s.start.episode_step)


@each_env
def test_env_steps_by_key(name):
    s = suite(name)
    assert_same(s.step(s.start, s.action, s.active, s.keys), s.step(s.start, s.action, s.active, s.keys))


@each_env
def test_env_observes_finite_numbers(name):
    s = suite(name)
    assert np.all(np.isfinite(s.start.obs))
    assert np.all(np.isfinite(s.states.obs))
    assert np.all(np.isfinite(s.states.reward))


@each_env
def test_env_keeps_the_accounts_of_an_episode(name):
    s = suite(name)
    total = np.zeros(NUM_ROBOTS, np.float32)
    for t in range(NUM_STEPS):
        total += np.asarray(s.states.reward[t])
        np.testing.assert_allclose(s.states.episode_return[t], total, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(s.states.episode_step, np.arange(1, NUM_STEPS + 1)[:, None].repeat(NUM_ROBOTS, 1))


@each_env
def test_env_never_resets_itself(name):
    """A robot in violation mostly stays there, and what follows depends on the state alone, not on flags and accounts."""
    s = suite(name)
    state, keys, falls = s.before_violation()
    ended = s.step(state, s.action, s.active, keys)
    assert np.all(ended.violation[falls])
    ended = ended._replace(timeout=s.active, success=s.active, episode_step=jnp.full(NUM_ROBOTS, s.env.spec.horizon))
    fresh = envs.begin(ended.physics, ended.obs)
    unmarked = jax.tree.map(lambda x, like: jnp.broadcast_to(x, like.shape), fresh, ended)
    one, other = (s.step(x, s.action, s.active, keys) for x in (ended, unmarked))
    assert_same((one.physics, one.obs, one.reward, one.violation), (other.physics, other.obs, other.reward, other.violation))
    np.testing.assert_array_equal(one.episode_step, s.env.spec.horizon + 1)
    assert np.mean(one.violation[falls]) > 0.5


@each_env
def test_env_times_out_at_its_horizon(name):
    s = suite(name)
    for steps_left in (2, 1):
        late = s.start._replace(episode_step=jnp.full(NUM_ROBOTS, s.env.spec.horizon - steps_left))
        after = s.step(late, s.action, s.active, s.keys)
        assert not np.any(after.violation)
        np.testing.assert_array_equal(after.timeout, steps_left == 1)


@each_env
def test_env_violation_beats_success_and_timeout(name):
    s = suite(name)
    assert not np.any(s.states.violation & (s.states.success | s.states.timeout))
    state, keys, falls = s.before_violation()
    rich = jnp.full(NUM_ROBOTS, 1e9, jnp.float32)
    late = state._replace(episode_step=jnp.full(NUM_ROBOTS, s.env.spec.horizon - 1), episode_return=rich)
    after = s.step(late, s.action, s.active, keys)
    assert np.all(after.violation[falls])
    assert not np.any(after.violation & (after.success | after.timeout))


def test_a_violation_beats_what_else_a_step_says():
    before = envs.begin(jnp.zeros(1), jnp.zeros(1))
    yes = jnp.ones((), bool)
    for violation in (yes, ~yes):
        one = envs.proceed(
            before, physics=before.physics, obs=before.obs, reward=jnp.ones(()), violation=violation, horizon=1, success=yes
        )
        assert (bool(one.success), bool(one.timeout)) == (not violation, not violation)


@each_env
def test_env_leaves_inactive_robots_alone(name):
    """They do not touch the others; where a physics backend runs, it does not touch them either."""
    s = suite(name)
    half = s.robots % 2 == 0
    everyone, some = (s.step(s.start, s.action, active, s.keys) for active in (s.active, half))
    assert_same(jax.tree.map(lambda x: x[half], some), jax.tree.map(lambda x: x[half], everyone))
    assert_same(*(jax.tree.map(lambda x: x[~half], bodies(state.physics)) for state in (some, s.start)))


@each_env
def test_env_permutes_with_its_robots(name):
    s = suite(name)
    order = jax.random.permutation(jax.random.key(3), NUM_ROBOTS)
    permuted = jax.tree.map(lambda x: x[order], s.start)
    assert_same(s.reset(s.keys[order], s.robots[order]), permuted)
    after = s.step(s.start, s.action, s.active, s.keys)
    assert_same(s.step(permuted, s.action[order], s.active, s.keys[order]), jax.tree.map(lambda x: x[order], after))


@each_env
def test_env_vmapped_is_a_loop_and_jitted_is_not_jitted(name):
    s = suite(name)
    middle = jax.tree.map(lambda x: x[20], s.states)
    after = s.step(middle, s.action, s.active, s.keys)
    single = compiled(s.env.step)
    for i in range(NUM_ROBOTS):
        one = jax.tree.map(lambda x, i=i: x[i], middle)
        expected = jax.tree.map(lambda x, i=i: x[i], after)
        assert_close(single(one, s.action[i], s.active[i], s.keys[i]), expected)
    assert_close(s.env.step(one, s.action[i], s.active[i], s.keys[i]), expected)


# Supervisors


@each_supervisor
def test_supervisor_gives_actions(name):
    serves = [e for e in fleetjax.list_envs() if suite(e).env.spec.supervisor == name]
    assert serves, "no registered environment has this supervisor by default"
    for e in serves:
        s = suite(e)
        act = compiled(jax.vmap(supervisors.make(name, s.env).act))
        for state in (s.start, jax.tree.map(lambda x: x[-1], s.states)):
            action = np.asarray(act(state, s.keys))
            assert (action.shape, action.dtype) == ((NUM_ROBOTS, s.env.spec.action_size), np.float32)
            assert np.all(np.isfinite(action))
            if s.env.spec.discrete:
                assert np.all((action == 0) | (action == 1))
                assert np.all(action.sum(axis=1) == 1)
            assert np.all(np.abs(action) <= 1)
            assert_same(act(state, s.keys), action)


# Algorithms


def make_signals(key: jax.Array) -> Signals:
    """Return plausible signals of 24 robots, of which some are sure, safe, or in violation."""
    keys = jax.random.split(key, 9)
    draws = [jnp.maximum(jax.random.uniform(k, (24,), minval=-0.5), 0.0) for k in keys[:3]]
    violation, helped = (jax.random.bernoulli(k, 0.3, (24,)) for k in keys[3:5])
    estimates = {name: jax.random.uniform(keys[5], (24,)) for name in ESTIMATORS.names()}
    return Signals(
        violation=violation,
        uncertainty=draws[0],
        risk=draws[1],
        goal=draws[2],
        timestep=jnp.int32(40),
        estimates=estimates,
        obs=jax.random.normal(keys[6], (24, 8)),
        robot_action=jax.random.uniform(keys[7], (24, 2), minval=-1.0),
        helped=helped,
        help_time=helped.astype(jnp.int32),
        given=helped & ~violation,
        correction=jnp.where(helped & ~violation, draws[0], 0.0),
        human_action=jax.random.uniform(keys[8], (24, 2), minval=-1.0),
        link=jnp.ones(24, jnp.float32),
        episode_step=jnp.arange(24),
    )


def decide(name, config, signals, aux, key):
    """Score, then give six humans to the robots, by the algorithm's own allocator."""
    algorithm = priority.get_algorithm(name)
    score, aux = algorithm.make_priority(config).score(signals, aux, key)
    humans = HumanState(jnp.full(6, -1, jnp.int32), jnp.zeros(6, jnp.int32))
    return score, aux, algorithm.make_allocate(config)(score, humans, jnp.full(24, 5), key, None, signals).robot


@functools.cache
def jitted(name):
    return compiled(functools.partial(decide, name))


def settings_of(name):
    """Return settings in which every rule helps somebody."""
    lower = {"random_threshold": 0.4, "thrifty_threshold": 0.5, "round_robin_threshold": 5.0}
    own = priority.get_algorithm(name).parameters
    config = fleetjax.make_config("navigation", initial_period=50, num_robots=24, num_humans=6)
    return config.replace(algorithm=name, **{field: value for field, value in lower.items() if field in own})


@each_algorithm
def test_algorithm_scores(name):
    """f32[N] >= 0; a memory of fixed structure; whoever is helped has a score; jit or not; thresholds do not recompile."""
    settings = settings_of(name)
    aux = priority.get_algorithm(name).make_priority(settings).init()
    own = [field for field, value in settings.parameters.items() if jnp.issubdtype(value.dtype, jnp.floating)]
    traced = ("uncertainty_threshold", "risk_threshold", *own)
    halved = settings.replace(**{field: get_value(settings, field) / 2 for field in traced})
    helped = 0
    for i, config in enumerate((settings, settings.replace(initial_period=20), halved)):
        signals, key = make_signals(jax.random.key(i)), jax.random.key(i)
        score, after, robot = jitted(name)(config, signals, aux, key)
        assert (score.shape, score.dtype) == ((24,), jnp.float32)
        assert np.all(score >= 0)
        assert np.all(np.asarray(score)[robot[robot >= 0]] > 0)
        assert types(after) == types(aux)
        helped += np.sum(robot >= 0)
        aux = after
    eager, _ = priority.get_algorithm(name).make_priority(halved).score(signals, aux, key)
    np.testing.assert_allclose(eager, jitted(name)(halved, signals, aux, key)[0], rtol=1e-5, atol=1e-6)
    assert helped > 0
    assert jitted(name)._cache_size() == 1


@each_algorithm
def test_algorithm_gives_no_human_for_nan(name):
    """A NaN signal speaks for nobody: whoever gets a score, or help, would have a score if it were 0."""
    settings = settings_of(name)
    aux = priority.get_algorithm(name).make_priority(settings).init()
    for field in ("uncertainty", "risk", "goal"):
        signals = make_signals(jax.random.key(0))
        with_nan, with_zero = (
            signals._replace(**{field: getattr(signals, field).at[::3].set(value)}) for value in (jnp.nan, 0.0)
        )
        expected = np.asarray(jitted(name)(settings, with_zero, aux, jax.random.key(0))[0])
        score, _, robot = jitted(name)(settings, with_nan, aux, jax.random.key(0))
        assert not np.any((score > 0) & (expected == 0))
        assert np.all(expected[robot[robot >= 0]] > 0)
        assert len(np.unique(robot[robot >= 0])) == np.sum(robot >= 0)


@functools.cache
def jitted_allocate(make_allocate):
    """Return a compiled allocator; algorithms that share their maker share it."""
    return compiled(lambda config, *args: make_allocate(config)(*args))


def shared_settings():
    """Return settings of any algorithm, for allocators that read none of its own."""
    return fleetjax.make_config("navigation", num_robots=24, num_humans=6)


@each_algorithm
def test_algorithm_allocates(name):
    """Humans who are bound and there stay, nobody comes to a score of 0 or NaN, no robot has two, and who is away has none."""
    make_allocate = priority.get_algorithm(name).make_allocate
    own = make_allocate is not priority.Algorithm.make_allocate
    config = settings_of(name) if own else shared_settings()
    came = stayed = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        score = jnp.asarray(np.where(rng.random(24) < 0.3, 0, rng.random(24)), jnp.float32).at[3].set(jnp.nan)
        score = score if seed < 3 else jnp.zeros(24)
        robot = np.where(rng.random(6) < 0.3, -1, rng.permutation(24)[:6])
        duration = np.where(robot < 0, 0, rng.integers(0, 8, 6))
        min_time, available = rng.integers(1, 7, 24), rng.random(6) < 0.8
        humans = HumanState(jnp.asarray(robot, jnp.int32), jnp.asarray(duration, jnp.int32))
        key, signals = jax.random.key(seed), make_signals(jax.random.key(seed))
        for there in (None, jnp.asarray(available)):
            args = (score, humans, jnp.asarray(min_time, jnp.int32), key, there, signals)
            after = jitted_allocate(make_allocate)(config, *args)
            assert types(after) == types(humans)
            assert_same(after, make_allocate(config)(*args))
            now, time = np.asarray(after.robot), np.asarray(after.duration)
            present = np.ones(6, bool) if there is None else available
            bound = present & (robot >= 0) & (duration < min_time[robot])
            stays = (robot >= 0) & (now == robot)
            np.testing.assert_array_equal(now[bound], robot[bound])
            np.testing.assert_array_equal(time, np.where(stays, duration, 0))
            assert np.all(now[~present] == -1)
            assert len(np.unique(now[now >= 0])) == np.sum(now >= 0)
            free = ~bound & (now >= 0)
            assert np.all(np.asarray(score)[now[free]] > 0)
            came, stayed = came + np.sum(free), stayed + np.sum(bound)
    assert came > 0
    assert stayed > 0
