"""The rules of the loop, 1 to 11, one test or more each; the others are in `test_semantics_learning.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from compiling import compiled
from reference import recording
from reference.scenario import HORIZON, NOBODY, TINY, M, N, T, make_counting_learner, play, program
from toy_envs import ALWAYS, NEVER

import fleetjax
from fleetjax.allocation import allocate
from fleetjax.envs import base
from fleetjax.learning import imitation
from fleetjax.types import HumanState

pytestmark = pytest.mark.usefixtures("toy_supervisors")

quick_allocate = compiled(allocate)


def test_semantic_01_order_of_a_timestep(monkeypatch):
    monkeypatch.setattr(imitation, "make_learner", make_counting_learner)
    run = program.__wrapped__(gradient_steps=1)  # not the cached one: it is traced with another learner
    scores = np.array([NOBODY] + [[1, 0, 0, 0]] * (T - 1), np.float32)
    timing = {"min_teleop_time": 5, "hard_reset_time": 5}
    trace = run(scores, np.array(NOBODY), np.array(NOBODY), timing, 0.0)
    # Robot 0 is teleoperated from t = 1 on, so D has t pairs after timestep t, and theta_t+1 has seen them all.
    seen = np.array([0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]) / 100
    np.testing.assert_allclose(trace.plan.signals.uncertainty[:, 3], seen)  # signals are of theta_t
    np.testing.assert_allclose(trace.metrics.reward, [0, *(1 + 3 * seen[1:])], rtol=1e-6)  # so are actions
    np.testing.assert_allclose(trace.metrics.uncertainty, seen, rtol=1e-6)  # so are metrics
    assert float(trace.last.policy.params) == pytest.approx(0.11)


def test_semantic_01_metrics_describe_the_state_before_the_step():
    trace = play([NOBODY], falls_at=[3, NEVER, NEVER, NEVER])
    assert trace.metrics.violations.tolist() == [0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]  # s_2 -> s_3
    assert trace.metrics.idle.tolist() == [0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1]  # c(s_3) = 1
    assert trace.plan.signals.violation[:, 0].tolist() == [0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1]


def test_semantic_02_type_is_decided_each_step_from_violation():
    trace = play([[2, 1, 0, 0]], falls_at=[3, NEVER, NEVER, NEVER], t_R=2)
    assert trace.plan.teleoperated[:, 0].tolist() == [1, 1, 1, 0, 0, 1, 1, 1, 0, 0, 1, 1]
    assert trace.plan.resetting[:, 0].tolist() == [0, 0, 0, 1, 1, 0, 0, 0, 1, 1, 0, 0]
    assert trace.plan.teleoperated[:, 1].all()
    assert not trace.plan.resetting[:, 1:].any()
    assert not trace.plan.teleoperated[:, 2:].any()


def test_semantic_03_duration_counts_completed_timesteps_and_restarts_with_the_type():
    trace = play([[2, 1, 0, 0]], falls_at=[3, NEVER, NEVER, NEVER], t_R=2)
    assert trace.plan.humans.robot.tolist() == [[0, 1]] * T
    assert trace.plan.humans.duration[:, 0].tolist() == [0, 1, 2, 0, 1, 0, 1, 2, 0, 1, 0, 1]
    assert trace.plan.humans.duration[:, 1].tolist() == list(range(T))
    np.testing.assert_array_equal(trace.humans.duration, trace.plan.humans.duration + 1)


def test_semantic_03_duration_of_humans_who_leave_and_come_is_zero():
    humans = HumanState(jnp.array([2, 0, -1]), jnp.array([7, 9, 0]))
    new = quick_allocate(jnp.array([0.0, 3.0, 2.0, 1.0]), humans, jnp.full(4, 5), jax.random.key(0))
    assert new.robot.tolist() == [2, 1, 3]
    assert new.duration.tolist() == [7, 0, 0]


def test_semantic_04_lock_holds_for_the_minimum_time():
    trace = play([[1, 0, 0, 0], [0, 2, 3, 0]], t_T=3)
    assert trace.humans.robot[:6].tolist() == [[0, -1], [0, 2], [0, 2], [1, 2], [1, 2], [1, 2]]


def test_semantic_04_human_is_free_after_a_completed_hard_reset():
    trace = play([NOBODY, [1, 0, 0, 0], NOBODY], falls_at=[1, NEVER, NEVER, NEVER], t_T=5, t_R=2)
    assert trace.humans.robot[:5, 0].tolist() == [-1, 0, 0, -1, -1]


def test_semantic_04_bound_teleoperator_whose_robot_falls_stays_and_resets_it():
    trace = play([[1, 0, 0, 0], NOBODY], falls_at=[2, NEVER, NEVER, NEVER], t_T=5, t_R=3)
    assert trace.humans.robot[:7, 0].tolist() == [0, 0, 0, 0, 0, -1, -1]
    assert trace.plan.resetting[:7, 0].tolist() == [0, 0, 1, 1, 1, 0, 0]
    assert trace.metrics.hard_resets[:7].tolist() == [0, 0, 0, 0, 1, 0, 0]


def test_semantic_04_lock_is_judged_by_the_stored_type_not_the_new_one():
    # At t = 2 the robot has fallen, but its human's last timestep was the second of a teleoperation, and t_T = 2.
    trace = play([[1, 0, 0, 0], NOBODY], falls_at=[2, NEVER, NEVER, NEVER], t_T=2, t_R=6)
    assert trace.humans.robot[:4, 0].tolist() == [0, 0, -1, -1]
    # At t = 3 it has fallen, the duration is 3, and t_T = 4: bound, although t_R = 2 would let it go.
    trace = play([[1, 0, 0, 0], NOBODY], falls_at=[3, NEVER, NEVER, NEVER], t_T=4, t_R=2)
    assert trace.humans.robot[:6, 0].tolist() == [0, 0, 0, 0, 0, -1]


def test_semantic_05_humans_stay_with_robots_chosen_again_and_others_go_in_order():
    humans = HumanState(jnp.array([2, 0, 4]), jnp.array([5, 6, 7]))
    new = quick_allocate(jnp.array([3.0, 5.0, 0.5, 4.0, 0.0]), humans, jnp.full(5, 5), jax.random.key(0))
    assert new.robot.tolist() == [1, 0, 3]
    assert new.duration.tolist() == [0, 6, 0]


def test_semantic_05_a_nan_score_counts_as_zero():
    human = HumanState(jnp.array([-1]), jnp.array([0]))
    new = quick_allocate(jnp.array([jnp.nan, 0.5, 1.0]), human, jnp.full(3, 5), jax.random.key(0))
    assert new.robot.tolist() == [2]
    new = quick_allocate(jnp.array([jnp.nan, 0.0, 0.0]), human, jnp.full(3, 5), jax.random.key(0))
    assert new.robot.tolist() == [-1]


def test_semantic_05_humans_left_over_are_free():
    humans = HumanState(jnp.array([0, -1]), jnp.array([9, 0]))
    new = quick_allocate(jnp.array([0.0, 1.0, 0.0]), humans, jnp.full(3, 5), jax.random.key(0))
    assert new.robot.tolist() == [1, -1]


def test_semantic_05_with_one_human_no_robot_is_starved_by_its_index():
    human = HumanState(jnp.array([-1]), jnp.array([0]))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), jnp.arange(60))
    first = compiled(jax.vmap(lambda key: allocate(jnp.ones(5), human, jnp.full(5, 5), key).robot[0]))(keys)
    assert set(first.tolist()) == {0, 1, 2, 3, 4}


def test_semantic_06_no_help_at_priority_zero_in_the_initial_period_but_locks_finish():
    env = toy_envs.scripted([3, 3, 3, 3], NOBODY, horizon=HORIZON)
    timing = {"min_teleop_time": 5, "hard_reset_time": 2, "initial_period": 8, "uncertainty_threshold": 0.0}
    sizes = {"num_robots": N, "num_humans": M, "num_steps": T, "gradient_steps": 0}
    config = fleetjax.make_config(env, "cu", **timing, **sizes, **TINY)

    def run(config):
        start = recording.start(config, env, jax.random.key(0))
        return recording.record(config, env, fleetjax.make_fleet(config, env), start, jax.random.key(0))

    trace = compiled(run)(config)
    # Two robots are teleoperated from t = 0. At t = 3 all have fallen and score 0, yet both locks go on as hard resets. The
    # other two robots wait until t = 8, when all have fallen again.
    assert trace.plan.score[3].tolist() == NOBODY
    assert trace.metrics.human_steps.tolist() == [2] * T
    assert trace.metrics.hard_resets[:8].tolist() == [0, 0, 0, 0, 2, 0, 0, 0]
    assert trace.metrics.idle[:9].tolist() == [0, 0, 0, 4, 4, 2, 2, 2, 4]
    waits = trace.plan.signals.violation[5]
    assert not np.asarray(trace.plan.score[5])[waits].any()
    assert np.all(np.asarray(trace.plan.score[8]) > 0)


def test_semantic_07_a_violating_robot_chosen_for_uncertainty_or_risk_is_reset():
    env = toy_envs.scripted(NOBODY, NOBODY)
    sizes = {"num_robots": N, "num_humans": M, "uncertainty_threshold": 0.0}
    config = fleetjax.make_config(env, "ur", **sizes, **TINY)
    fallen = jnp.array([True, False, False, True])

    def plan(key):
        state = recording.start(config, env, key)
        state = state._replace(env=state.env._replace(violation=fallen))
        return fleetjax.make_fleet(config, env).plan(state, key)[1]

    planned = compiled(plan)(jax.random.key(0))
    # The untrained members differ most where the observation is largest: at robots 2 and 3.
    assert np.argsort(planned.signals.uncertainty).tolist() == [0, 1, 2, 3]
    assert np.all((np.asarray(planned.signals.risk) > 0) & (np.asarray(planned.signals.risk) < 1))
    assert set(planned.humans.robot.tolist()) == {2, 3}
    assert planned.resetting.tolist() == [False, False, False, True]
    assert planned.teleoperated.tolist() == [False, False, True, False]


@pytest.mark.parametrize("t_R", [1, 3, 5])
def test_semantic_08_a_hard_reset_takes_exactly_its_time(t_R):
    trace = play([[0, 1, 0, 0]], falls_at=[NEVER, 1, NEVER, NEVER], t_T=1, t_R=t_R)
    lies = np.arange(1, 1 + t_R)
    assert np.flatnonzero(trace.plan.resetting[:, 1])[:t_R].tolist() == lies.tolist()
    assert np.flatnonzero(trace.metrics.hard_resets)[0] == t_R
    assert not trace.plan.resetting[t_R + 1, 1]
    # It does not move until it is drawn anew from its own initial distribution p_i^0.
    assert trace.env.obs[:t_R, 1].tolist() == [[1, 1, 0]] * t_R
    assert trace.env.obs[t_R, 1].tolist() == [1, 0, 0]


def test_semantic_08_a_robot_drawn_into_a_violation_needs_another_whole_reset():
    trace = play([[1, 0, 0, 0]], falls_at=[ALWAYS, NEVER, NEVER, NEVER], t_T=1, t_R=3)
    assert trace.metrics.hard_resets.tolist() == [0, 0, 1] * 4
    assert trace.plan.humans.duration[:, 0].tolist() == [0, 1, 2] * 4
    assert trace.plan.resetting[:, 0].all()


def test_semantic_08_times_are_traced():
    play([NOBODY], t_R=1)
    programs = program()._cache_size()
    play([NOBODY], t_R=7, t_T=3)
    assert program()._cache_size() == programs


def test_semantic_08_no_policy_acts_on_a_robot_in_violation():
    trace = play([NOBODY], falls_at=[1, 1, 1, 1])
    assert trace.metrics.moving.tolist() == [4] + [0] * 11
    assert trace.metrics.reward[1:].tolist() == [0] * 11
    assert int(trace.last.estimators["safety"].positives.added) == 4
    assert int(trace.last.estimators["safety"].negatives.added) == 0


@pytest.mark.parametrize(
    ("violation", "success", "clock", "expected"),
    [
        (True, True, 1, (True, False, False)),
        (True, True, HORIZON, (True, False, False)),
        (False, True, HORIZON, (False, True, True)),
        (False, False, HORIZON, (False, False, True)),
        (False, True, 1, (False, True, False)),
    ],
)
def test_semantic_09_violation_beats_success_and_time_out(violation, success, clock, expected):
    state = base.begin((), jnp.zeros(1))._replace(episode_step=jnp.int32(clock - 1))
    after = base.proceed(
        state,
        physics=(),
        obs=jnp.zeros(1),
        reward=jnp.float32(0),
        violation=jnp.array(violation),
        success=jnp.array(success),
        horizon=HORIZON,
    )
    assert (bool(after.violation), bool(after.success), bool(after.timeout)) == expected


@pytest.mark.parametrize(("clock", "violation", "success"), [(9, False, False), (10, False, True), (10, True, False)])
def test_semantic_09_locomotion_success_is_judged_on_the_step_that_reaches_the_horizon(clock, violation, success):
    state = base.begin((), jnp.zeros(1))._replace(episode_step=jnp.int32(clock - 1), episode_return=jnp.float32(94.0))
    after = base.proceed(
        state,
        physics=(),
        obs=jnp.zeros(1),
        reward=jnp.float32(2.0),
        violation=jnp.array(violation),
        horizon=HORIZON,
        success_return=95.0,
    )
    assert bool(after.success) == success
    assert float(after.episode_return) == 96.0


def test_semantic_09_the_configuration_says_which_return_is_a_success():
    """Its default is the environment's; it is traced, so that one program serves several readings."""
    env = toy_envs.scripted([NEVER] * N, [1] * N, horizon=4)
    env = env._replace(spec=env.spec._replace(success_return=50.0))
    config = fleetjax.make_config(env, "expert", num_robots=N, num_humans=N, num_steps=8)
    assert config.success_return == 50
    run = jax.vmap(lambda value: fleetjax.run(config.replace(success_return=value), jax.random.key(0), env=env))
    successes = compiled(run)(jnp.array([50.0, 3.5, 4.0])).metrics.successes  # a step under the supervisor is worth 1
    assert successes.tolist() == [[0] * 8, [0, 0, 0, N] * 2, [0] * 8]
    with pytest.raises(ValueError, match="success_return = inf must be"):
        config.replace(success_return=jnp.inf) and fleetjax.make_config(env, success_return=jnp.inf)


def test_semantic_09_soft_resets_are_free_and_leave_humans_where_they_are():
    trace = play([[2, 0, 1, 0]], succeeds_at=[3, NEVER, NEVER, NEVER])
    assert trace.metrics.successes.tolist() == [0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1]
    assert trace.env.obs[:6, 0, 1].tolist() == [1, 2, 0, 1, 2, 0]  # the next observation is the new state's
    assert trace.env.obs[:, 1, 1].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 1, 2]  # time-out at the horizon
    assert trace.humans.robot.tolist() == [[0, 2]] * T
    assert trace.humans.duration[:, 0].tolist() == list(range(1, T + 1))
    assert trace.metrics.idle.tolist() == [0] * T
    assert trace.metrics.hard_resets.tolist() == [0] * T
    np.testing.assert_array_equal(trace.last.human_data.pairs.rows.obs[:10:2, 1], [0, 1, 2, 0, 1])


def test_semantic_10_a_success_counts_once_and_the_episode_goes_on_with_a_new_goal():
    trace = play([[1, 0, 0, 0]], succeeds_at=[3, NEVER, NEVER, 10], new_goals=True)
    assert trace.metrics.successes.tolist() == [0, 0, 1, 0, 0, 1, 0, 0, 1, 1, 0, 0]
    assert trace.env.obs[:, 0, 2].tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 3, 0, 0, 0]  # the new goal is in the next observation
    assert trace.env.episode_step[:, 0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 1, 2]  # ends at the horizon only
    assert trace.env.episode_return[:9, 0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert trace.env.obs[9, 3].tolist() == [3, 0, 0]  # a success on the horizon is counted, then reset
    # The goal critic sees the goal that was reached, before the new one.
    stored = trace.last.estimators["goal"].positives
    assert int(stored.added) == 4
    np.testing.assert_array_equal(stored.rows.next_obs[:4], [[0, 3, 0], [0, 6, 1], [0, 9, 2], [3, 10, 0]])
    assert int(trace.last.estimators["safety"].positives.added) == 0


def test_semantic_11_every_teleoperated_step_gives_a_pair_also_one_that_ends_in_a_violation():
    trace = play([[1, 0, 0, 0]], falls_at=[2, NEVER, NEVER, NEVER], t_R=3)
    pairs = trace.last.human_data.pairs
    assert trace.metrics.teleop_steps.tolist() == [1, 1, 0, 0, 0, 1, 1, 0, 0, 0, 1, 1]
    assert int(pairs.added) == 6
    assert pairs.rows.obs[:6].tolist() == [[0, 0, 0], [0, 1, 0]] * 3
    assert pairs.rows.action[:6].tolist() == [[1]] * 6


def test_semantic_11_nothing_is_recorded_that_no_supervisor_gave():
    silent = play([[1, 0, 0, 0]], silence=1.0)
    alone = play([NOBODY])
    assert silent.metrics.teleop_steps.tolist() == [1] * T
    assert int(silent.last.human_data.pairs.added) == 0
    np.testing.assert_array_equal(silent.metrics.reward, alone.metrics.reward)  # the policy acts instead
