"""What an algorithm may bring: parameters of its own, an allocator, estimators, and what its rule may see."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from commands import refused
from compiling import compiled

import fleetjax
from fleetjax import cli, priority
from fleetjax.io import plain

pytestmark = pytest.mark.usefixtures("toy_supervisors")

SMALL = {
    "num_robots": 4,
    "num_humans": 2,
    "num_steps": 12,
    "min_teleop_time": 3,
    "hard_reset_time": 2,
    "ensemble_size": 2,
    "hidden_sizes": (4,),
    "batch_size": 4,
    "gradient_steps": 1,
    "critic_capacity": 60,
    "num_demonstrations": 20,
    "pretraining_steps": 1,
    "critic_pretraining_steps": 1,
    "num_critic_transitions": 20,
}
KEY = jax.random.key(0)


def everybody(config):
    """All robots alike."""
    return priority.stateless(lambda signals, key: jnp.ones_like(signals.uncertainty))


def remember_signals(names):
    """Return a rule that helps robot 0 alone, and remembers what it saw."""

    def make(config):
        n = config.num_robots

        def score(signals, aux, key):
            return (jnp.arange(n) == 0).astype(jnp.float32), {name: getattr(signals, name) for name in names}

        kinds = {"helped": bool, "help_time": jnp.int32}
        return fleetjax.Priority(lambda: {name: jnp.zeros(n, kinds.get(name, jnp.float32)) for name in names}, score)

    return make


def run_and_watch(config, env):
    """Return what the rule remembered at each timestep, the humans behind it, and the metrics."""
    step = fleetjax.make_fleet(config, env).step

    def timestep(state, t):
        state, metrics = step(state, jax.random.fold_in(KEY, t))
        return state, (state.priority, state.humans, metrics)

    start = compiled(functools.partial(fleetjax.prepare, env=env))(config, KEY)
    return jax.device_get(compiled(lambda s: jax.lax.scan(timestep, s, jnp.arange(config.num_steps))[1])(start))


def test_parameters_are_traced_checked_swept_and_the_algorithms_alone(capsys):
    def make(config):
        weight = config.parameters["weight"]
        return priority.stateless(lambda signals, key: jnp.where(signals.uncertainty >= weight, 1.0, 0.0))

    own = {"weight": fleetjax.Field("uncertainty from which on it helps", high=2, default=0.5)}
    fleetjax.register_priority("weighing", make, estimators=(), parameters=own)
    config = fleetjax.make_config("navigation", "weighing", **SMALL, weight=0.0)
    assert config.parameters["weight"].dtype == jnp.float32
    assert float(fleetjax.make_config("navigation", "weighing").parameters["weight"]) == 0.5
    assert "weight" not in config.replace(algorithm="uc").parameters
    with pytest.raises(ValueError, match=r"weight = 3\.0 must be in \[0, 2\]"):
        fleetjax.make_config("navigation", "weighing", weight=3)
    elsewhere = "weight is a parameter of algorithm = 'weighing', not of 'uc'"
    with pytest.raises(ValueError, match=elsewhere):
        fleetjax.make_config("navigation", "uc", weight=0.1)
    with pytest.raises(ValueError, match=elsewhere):
        fleetjax.make_config("navigation", "uc").replace(weight=0.1)
    assert "weight is a parameter of" in refused(capsys, "run", "navigation", "--weight", "0.1")
    assert cli.main(["list"]) == 0
    assert "own parameter of weighing: weight 0.5" in capsys.readouterr().out
    assert plain.to_plain(config)["weight"] == 0.0

    program = compiled(lambda config: fleetjax.run(config, KEY).metrics.human_steps.sum())
    assert int(program(config)) == 24
    assert int(program(config.replace(weight=2.0))) == 0
    assert program._cache_size() == 1
    sweep = jax.vmap(lambda w: config.replace(weight=w))(jnp.array([0.0, 2.0]))
    assert compiled(jax.vmap(lambda c: fleetjax.run(c, KEY).metrics.human_steps.sum()))(sweep).tolist() == [24, 0]


def test_an_allocator_takes_the_place_of_the_papers_and_sees_the_signals():
    """It sends every human to the robot whose number in the observation is largest."""

    def make_allocate(config):
        def allocate(score, humans, min_time, key, available=None, signals=None):
            last = jnp.argmax(signals.obs[:, 0]).astype(jnp.int32)
            robot = jnp.where(jnp.arange(config.num_humans) == 0, last, -1)
            return fleetjax.HumanState(robot, jnp.where(humans.robot == robot, humans.duration, 0))

        return allocate

    fleetjax.register_algorithm("last", fleetjax.Algorithm(everybody, make_allocate=make_allocate))
    env = toy_envs.scripted([0] * 4, [0] * 4, horizon=50)
    _, humans, metrics = run_and_watch(fleetjax.make_config(env, "last", **SMALL), env)
    assert humans.robot.tolist() == [[3, -1]] * 12
    assert humans.duration[:, 0].tolist() == list(range(1, 13))
    assert metrics.human_steps.tolist() == [1] * 12


def test_an_estimator_is_initialised_fed_updated_and_seen_by_the_rule():
    """One that counts: 100 at the start, 1 for each step of a moving robot, 1000 for each gradient step."""

    def make(config, env, learner, supervisor):
        def init(key, data, policy):
            return 100.0 + 0.0 * data.pairs.size.astype(jnp.float32)

        def append(state, steps, moving):
            assert steps.robot_action.shape == steps.action.shape == (4, 1)
            return state + jnp.sum(moving.astype(jnp.float32))

        return fleetjax.Estimator(
            init=init,
            value=lambda state, policy, obs, robot_action: jnp.full(obs.shape[0], state),
            append=append,
            update=lambda state, policy, data, key: state + 1000.0,
        )

    fleetjax.register_estimator("counter", make)

    def make_rule(config):
        def score(signals, aux, key):
            return jnp.zeros(4), signals.estimates["counter"]

        return fleetjax.Priority(lambda: jnp.zeros(4), score)

    fleetjax.register_priority("counting", make_rule, estimators=("counter",))
    env = toy_envs.scripted([3, 0, 0, 0], [0] * 4, horizon=50)
    seen, _, _ = run_and_watch(fleetjax.make_config(env, "counting", **SMALL), env)
    moved = np.array([0, 4, 4, 4] + [3] * 8).cumsum()
    np.testing.assert_allclose(seen[:, 0], 100 + moved + 1000 * np.arange(12))


def test_a_rule_sees_the_help_of_the_last_timestep():
    names = ("helped", "help_time", "correction")
    fleetjax.register_priority("watching", remember_signals(names), estimators=())
    env = toy_envs.scripted([4, 0, 0, 0], [0] * 4, horizon=50)
    seen, humans, metrics = run_and_watch(fleetjax.make_config(env, "watching", **SMALL), env)
    # Robot 0 alone is helped: taught for four timesteps, reset for two, and so on.
    assert humans.duration[:, 0].tolist() == [1, 2, 3, 4, 1, 2] * 2
    assert seen["helped"][:, 0].tolist() == [False] + [True] * 11
    assert seen["help_time"][:, 0].tolist() == [0, 1, 2, 3, 4, 1, 2, 1, 2, 3, 4, 1]
    assert not seen["helped"][:, 1:].any()
    assert not seen["help_time"][:, 1:].any()
    taught = np.array([False, True, True, True, True, False, False, True, True, True, True, False])
    assert ((seen["correction"][:, 0] > 0) == taught).all()
    assert not seen["correction"][:, 1:].any()
    assert metrics.teleop_steps.tolist() == [1, 1, 1, 1, 0, 0] * 2


@pytest.mark.parametrize("sees", [False, True])
def test_a_ceiling_sees_what_the_supervisor_would_do(sees):
    found = []

    def make(config):
        def score(signals, key):
            found.append(None if signals.human_action is None else signals.human_action.shape)
            return jnp.zeros(4)

        return priority.stateless(score)

    fleetjax.register_algorithm("ceiling", fleetjax.Algorithm(make, sees_supervisor=sees))
    config = fleetjax.make_config("navigation", "ceiling", **SMALL)
    jax.eval_shape(lambda config: fleetjax.run(config, KEY), config)  # of its own: traces of one function are shared
    assert set(found) == {(4, 2) if sees else None}


def test_algorithms_change_defaults():
    constraint, trained = (fleetjax.make_config("navigation", name) for name in ("constraint", "constraint_trained"))
    plain = fleetjax.make_config("navigation", "cur")
    assert int(constraint.pretraining_steps) == int(plain.pretraining_steps) == 1000
    assert int(trained.pretraining_steps) == 1000 + plain.num_steps * plain.gradient_steps
    assert int(constraint.extra_demonstrations) == int(trained.extra_demonstrations) == 19424
    assert int(fleetjax.make_config("navigation", "constraint", extra_demonstrations=7).extra_demonstrations) == 7
    assert fleetjax.make_config("navigation", "expert", num_robots=7).num_humans == 7
