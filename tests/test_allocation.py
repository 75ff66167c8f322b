"""Properties of the allocation, alone and inside the loop."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from compiling import compiled
from hypothesis import given
from hypothesis import strategies as st
from reference import oracle, recording

import fleetjax
from fleetjax import allocation
from fleetjax.allocation import allocate, helper_of
from fleetjax.types import HumanState

pytestmark = pytest.mark.usefixtures("toy_supervisors")

SHAPES = [(7, 3), (5, 5), (4, 1)]  # robots, humans
MIN_TELEOP_TIME, HARD_RESET_TIME = 4, 2
quick_allocate = compiled(allocate)


class Scene(NamedTuple):
    """Arguments of `allocate`, as NumPy arrays; `resetting` bool[N] says where `min_time` is t_R."""

    score: np.ndarray
    robot: np.ndarray
    duration: np.ndarray
    resetting: np.ndarray
    seed: int
    available: np.ndarray

    @property
    def min_time(self) -> np.ndarray:
        return np.where(self.resetting, HARD_RESET_TIME, MIN_TELEOP_TIME)

    @property
    def bound(self) -> np.ndarray:
        """bool[M] humans who may not leave."""
        return self.available & (self.robot >= 0) & (self.duration < self.min_time[self.robot])


@st.composite
def scenes(draw, values=(0.0, 0.0, float("nan"), 0.25, 1.0, 1.0, 2.0)) -> Scene:
    n, m = draw(st.sampled_from(SHAPES))
    robots = draw(st.permutations(range(n)))[:m]
    assigned = draw(st.lists(st.booleans(), min_size=m, max_size=m))
    durations = draw(st.lists(st.integers(1, 6), min_size=m, max_size=m))
    return Scene(
        score=np.array(draw(st.lists(st.sampled_from(values), min_size=n, max_size=n)), np.float32),
        robot=np.where(assigned, robots, -1).astype(np.int32),
        duration=np.where(assigned, durations, 0).astype(np.int32),
        resetting=np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n))),
        seed=draw(st.integers(0, 1000)),
        available=np.array(draw(st.lists(st.sampled_from([True, True, True, False]), min_size=m, max_size=m))),
    )


def solve(scene: Scene) -> HumanState:
    """Return the allocation as NumPy arrays."""
    humans = HumanState(jnp.array(scene.robot), jnp.array(scene.duration))
    key = jax.random.key(scene.seed)
    new = quick_allocate(jnp.array(scene.score), humans, jnp.array(scene.min_time), key, jnp.array(scene.available))
    return jax.tree.map(np.asarray, new)


@given(scenes())
def test_a_robot_has_at_most_one_human_and_a_human_at_most_one_robot(scene):
    robot = solve(scene).robot
    helped = robot[robot >= 0]
    assert len(set(helped)) == len(helped)
    assert robot.min() >= -1
    assert robot.max() < len(scene.score)


@given(scenes())
def test_nobody_is_newly_sent_to_a_robot_of_priority_zero_or_nan(scene):
    new = solve(scene)
    sent = (new.robot >= 0) & ~scene.bound
    assert np.all(scene.score[new.robot[sent]] > 0)


@given(scenes())
def test_locks_hold(scene):
    new = solve(scene)
    np.testing.assert_array_equal(new.robot[scene.bound], scene.robot[scene.bound])


@given(scenes())
def test_humans_who_are_not_there_are_free(scene):
    new = solve(scene)
    assert np.all(new.robot[~scene.available] == -1)


@given(scenes())
def test_duration_is_kept_by_those_who_stay_and_zero_for_the_others(scene):
    new = solve(scene)
    stays = (new.robot >= 0) & (new.robot == scene.robot)
    np.testing.assert_array_equal(new.duration, np.where(stays, scene.duration, 0))


@given(scenes())
def test_a_human_whose_robot_is_chosen_again_stays_with_it(scene):
    new = solve(scene)
    for human, robot in enumerate(scene.robot):
        if scene.available[human] and robot >= 0 and robot in new.robot:
            assert new.robot[human] == robot


@given(scenes())
def test_the_highest_scores_get_the_unlocked_humans_as_many_as_there_are(scene):
    new = solve(scene)
    competing = [i for i in range(len(scene.score)) if i not in scene.robot[scene.bound] and scene.score[i] > 0]
    chosen = [i for i in competing if i in new.robot]
    left_out = [i for i in competing if i not in new.robot]
    assert len(chosen) == min(len(competing), int(np.sum(scene.available & ~scene.bound)))
    assert min(scene.score[chosen], default=np.inf) >= max(scene.score[left_out], default=0.0)


@given(scenes())
def test_allocation_is_algorithm_1(scene):
    n, m = len(scene.score), len(scene.robot)
    problem = oracle.Problem(
        *(n, m, "c", MIN_TELEOP_TIME, HARD_RESET_TIME, 0, 0.0, 0.0, 0.0, 0.0, 0.0), True, 1, ring_sizes={}, new_goals=False
    )
    fleet = oracle.start(problem, {}, num_members=1)
    for j, i in enumerate(scene.robot):
        if i >= 0:
            fleet.alpha[i, j], fleet.duration[i] = 1, scene.duration[j]
            fleet.type[i] = oracle.HARD_RESET if scene.resetting[i] else oracle.TELEOP
    tie_order = np.asarray(allocation.tie_order(jax.random.key(scene.seed), n))
    alpha = oracle.allocate(problem, fleet, list(scene.score), tie_order, scene.available)
    np.testing.assert_array_equal(recording.matrix(solve(scene).robot, n), alpha)


@given(scenes(), st.data())
def test_permuting_robots_and_tie_order_permutes_the_allocation(scene, data):
    n = len(scene.score)
    new_name = np.array(data.draw(st.permutations(range(n))))  # robot i is called new_name[i] now
    tie_order = np.array(data.draw(st.permutations(range(n))))
    renamed_robot = np.where(scene.robot >= 0, new_name[scene.robot], -1).astype(np.int32)
    renamed = scene._replace(
        score=scene.score[np.argsort(new_name)],
        robot=renamed_robot,
        resetting=scene.resetting[np.argsort(new_name)],
    )
    before, after = solve_in_order(scene, tie_order), solve_in_order(renamed, new_name[tie_order])
    np.testing.assert_array_equal(after.robot, np.where(before.robot >= 0, new_name[before.robot], -1))
    np.testing.assert_array_equal(after.duration, before.duration)


def solve_in_order(scene: Scene, tie_order: np.ndarray) -> HumanState:
    """Return the allocation with ties broken in a given order of the robots."""
    humans = HumanState(jnp.array(scene.robot), jnp.array(scene.duration))
    return jax.tree.map(np.asarray, quick_allocate_in_order(scene.score, humans, scene.min_time, tie_order, scene.available))


@compiled
def quick_allocate_in_order(score, humans, min_time, tie_order, available) -> HumanState:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(allocation, "tie_order", lambda key, n: tie_order)
        return allocate(score, humans, min_time, jax.random.key(0), available)


@pytest.mark.parametrize("num_humans", [1, 2])
def test_ties_are_broken_fairly(num_humans):
    num_robots, num_draws = 5, 4000
    humans = HumanState(jnp.full(num_humans, -1), jnp.zeros(num_humans, jnp.int32))
    score = jnp.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.5])
    keys = jax.random.split(jax.random.key(7), num_draws)
    robot = compiled(jax.vmap(lambda key: allocate(score, humans, jnp.full(6, 5), key).robot))(keys)
    counts = np.bincount(np.asarray(robot).ravel(), minlength=6)
    assert counts[5] == 0
    expected = num_draws * num_humans / num_robots
    chi_square = np.sum((counts[:5] - expected) ** 2) / expected
    assert chi_square < 18.5  # the 0.1 % point with 4 degrees of freedom


@given(scenes())
def test_helper_of_is_the_inverse_of_the_allocation(scene):
    new = solve(scene)
    helper = np.asarray(helper_of(jax.tree.map(jnp.asarray, new), len(scene.score)))
    for human, robot in enumerate(new.robot):
        assert robot == -1 or helper[robot] == human
    assert np.sum(helper >= 0) == np.sum(new.robot >= 0)


@functools.cache
def loop(algorithm: str, num_robots: int, num_humans: int):
    """Return a compiled `(t_T, t_R, falls_at[N], seed) -> Trace` of 40 timesteps."""
    sizes = {"num_robots": num_robots, "num_humans": num_humans, "num_steps": 40, "hidden_sizes": (2,), "ensemble_size": 2}
    data = {"batch_size": 4, "num_demonstrations": 4, "gradient_steps": 0}
    data |= {"random_threshold": 0.4} if algorithm == "random" else {}
    base = fleetjax.make_config(toy_envs.scripted([0], [0]), algorithm, **sizes, **data)

    def run(min_teleop_time, hard_reset_time, falls_at, seed):
        env = toy_envs.scripted(falls_at, jnp.zeros(num_robots, jnp.int32))
        config = base.replace(min_teleop_time=min_teleop_time, hard_reset_time=hard_reset_time)
        key = jax.random.key(seed)
        return recording.record(config, env, fleetjax.make_fleet(config, env), recording.start(config, env, key), key)

    jitted = compiled(run)
    return lambda *args: jax.tree.map(np.asarray, jitted(*args))


def draw_loops(num_robots: int):
    falls_at = st.lists(st.integers(0, 12), min_size=num_robots, max_size=num_robots).map(np.array)
    return st.tuples(st.integers(1, 7), st.integers(1, 7), falls_at, st.integers(0, 1000))


def lengths_of_finished_runs(mask: np.ndarray) -> list[int]:
    """Return how long each run of True in `mask` bool[T, N] lasted, robot by robot, without those that reach the end."""
    runs = []
    for column in mask.T:
        ends = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
        runs += [end - begin for begin, end in ends.reshape(-1, 2) if end < len(column)]
    return runs


@given(draw_loops(4))
def test_a_hard_reset_costs_as_many_human_steps_and_idle_steps_as_it_lasts_when_help_is_instant(settings):
    _, hard_reset_time, falls_at, _ = settings
    trace = loop("constraint", 4, 4)(*settings)
    assert set(lengths_of_finished_runs(trace.plan.signals.violation)) <= {hard_reset_time}
    assert set(lengths_of_finished_runs(trace.plan.resetting)) <= {hard_reset_time}
    resets, robot = trace.metrics.hard_resets.sum(), trace.humans.robot[-1]
    unfinished = np.sum(trace.humans.duration[-1], where=(robot >= 0) & trace.env.violation[-1][robot])
    assert trace.metrics.human_steps.sum() == trace.metrics.idle.sum() == hard_reset_time * resets + unfinished
    assert resets >= np.sum((falls_at > 0) & (falls_at + hard_reset_time <= 40))


@given(draw_loops(5))
def test_a_hard_reset_costs_as_many_human_steps_when_robots_must_wait(settings):
    trace = loop("random", 5, 2)(*settings)
    assert set(lengths_of_finished_runs(trace.plan.resetting)) <= {settings[1]}
    assert min(lengths_of_finished_runs(trace.plan.signals.violation), default=settings[1]) >= settings[1]


@given(draw_loops(5))
def test_locks_hold_in_the_loop(settings):
    min_teleop_time, hard_reset_time, _, _ = settings
    trace = loop("random", 5, 2)(*settings)
    robot, resetting = trace.humans.robot, trace.plan.resetting
    for t in range(1, len(robot)):
        for human in np.flatnonzero((robot[t] != robot[t - 1]) & (robot[t - 1] >= 0)):
            min_time = hard_reset_time if resetting[t - 1, robot[t - 1, human]] else min_teleop_time
            assert trace.humans.duration[t - 1, human] >= min_time


@given(draw_loops(5))
def test_counts_add_up(settings):
    trace = loop("random", 5, 2)(*settings)
    metrics, under_reset = trace.metrics, trace.plan.resetting.sum(axis=1)
    np.testing.assert_array_equal(metrics.idle + metrics.moving, 5)
    np.testing.assert_array_equal(metrics.human_steps, metrics.teleop_steps + under_reset)
    assert metrics.human_steps.max() <= 2
    assert np.all(under_reset <= metrics.idle)
    assert np.all(metrics.hard_resets <= under_reset)
    assert np.all(metrics.teleop_steps <= metrics.moving)
    assert metrics.violations.sum() - metrics.hard_resets.sum() == trace.env.violation[-1].sum()
    assert metrics.teleop_steps.sum() == trace.last.human_data.pairs.added
