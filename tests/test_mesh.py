"""A fleet that is divided among devices is the same fleet. The devices are eight virtual ones; see `conftest.py`."""

import os
import re
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import fleetjax
from fleetjax import priority, sharding
from fleetjax.allocation import choose
from fleetjax.experiment import step_once
from fleetjax.humans import HUMAN_MODELS, LINK_MODELS
from fleetjax.learning import buffer
from fleetjax.priority import lexicographic

DEVICES = 8
COLLECTIVE = re.compile(r"= (\S+|\(.*?\)) (all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter)(?:-start)?\(")
SMALL = {
    "num_robots": 40,
    "num_humans": 5,
    "num_steps": 30,
    "initial_period": 3,
    "num_demonstrations": 100,
    "batch_size": 32,
    "pretraining_steps": 20,
    "num_critic_transitions": 200,
    "critic_pretraining_steps": 10,
    "critic_capacity": 1003,  # which eight devices do not divide
}


@cache
def mesh_of(size=DEVICES):
    return jax.make_mesh((size,), ("any",), devices=jax.devices()[:size])


@cache
def small(algorithm, environment="navigation", **others):
    return fleetjax.make_config(environment, algorithm, **SMALL | others)


run = jax.jit(fleetjax.run, static_argnames=("mesh", "env"))
prepare = jax.jit(fleetjax.prepare)


@cache
def on_mesh(function, num_humans):
    """Return the function, traced for a mesh."""

    def traced(*args):
        with sharding.over(mesh_of(), num_humans):
            return function(*args)

    return jax.jit(traced)


choose_on_mesh = {number: on_mesh(partial(choose, number=number), number) for number in (1, 3, 16)}
quick_choose = jax.jit(choose, static_argnums=2)
quick_lexicographic = jax.jit(lexicographic)
few_values = st.lists(st.integers(0, 3), min_size=16, max_size=16)  # so that there are many ties


@given(few_values, st.integers(0, 100), st.sampled_from(list(choose_on_mesh)))
def test_devices_choose_together_whom_one_would_choose(scores, seed, number):
    scores, key = jnp.array(scores, jnp.float32), jax.random.key(seed)
    alone, together = quick_choose(scores, key, number), choose_on_mesh[number](scores, key)
    np.testing.assert_array_equal(alone, together)


@given(st.lists(few_values, min_size=2, max_size=2), st.integers(0, 100), st.sampled_from(list(choose_on_mesh)))
def test_ranks_on_a_mesh_lead_to_the_same_choice(table, seed, number):
    columns, key = [jnp.array(column, jnp.float32) for column in table], jax.random.key(seed)
    ranks, divided = quick_lexicographic(*columns), on_mesh(lexicographic, number)(*columns)
    np.testing.assert_array_equal(ranks > 0, divided > 0)
    (best, robots), (divided_best, divided_robots) = (quick_choose(scores, key, number) for scores in (ranks, divided))
    np.testing.assert_array_equal(np.where(best > 0, robots, -1), np.where(divided_best > 0, divided_robots, -1))


quick_append = jax.jit(partial(buffer.append, overwrite=True))


@given(st.integers(0, 60), st.sampled_from([1, 2, 8]), st.sampled_from([1, 3, 8]))
def test_a_ring_keeps_its_rows_in_any_number_of_parts(added, before, after):
    ring = buffer.create(jnp.zeros((), jnp.int32), 24)
    for number in range(added):
        ring = quick_append(ring, jnp.array([number]), jnp.array([True]))
    ring = buffer.in_parts(buffer.in_parts(ring, before), after)
    found = np.asarray(buffer.read(ring, jnp.arange(int(ring.size))))
    assert sorted(found.tolist()) == list(range(max(0, added - 24), added))
    assert ring.added.shape == ((after,) if after > 1 else ())


def test_a_part_of_a_ring_takes_the_rows_of_its_own_robots():
    ring = buffer.in_parts(buffer.create(jnp.zeros((), jnp.int32), 8), 2)
    mask = jnp.array([True, False, True, True])
    ring = buffer.append(ring, jnp.array([10, 11, 20, 21]), mask, overwrite=True)
    assert ring.added.tolist() == [1, 2]
    assert buffer.read(ring, jnp.arange(3)).tolist() == [10, 20, 21]


@pytest.mark.parametrize(
    ("algorithm", "environment"),
    [
        ("random", "navigation"),
        pytest.param("cur", "navigation", marks=pytest.mark.long),
        pytest.param("cur", "humanoid", marks=pytest.mark.long),
    ],
)
def test_a_timestep_from_the_same_state_agrees_to_rounding(algorithm, environment):
    config, key = small(algorithm, environment, num_steps=5, initial_period=0), jax.random.key(0)
    state = prepare(config, key)
    alone, divided = run(config, key, state), run(config, key, state, mesh=mesh_of())
    for name in alone.metrics._fields:
        # Critics on a mesh draw other batches, so it is the first timestep that must agree.
        here, there = (np.asarray(getattr(result.metrics, name))[0] for result in (alone, divided))
        np.testing.assert_allclose(here, there, rtol=1e-4, atol=1e-5, err_msg=name)
    one = jax.jit(step_once, static_argnums=1)(config, fleetjax.envs.make(environment, config.backend), state, key)
    there = run(config.replace(num_steps=1), key, state, mesh=mesh_of()).state
    np.testing.assert_array_equal(one.humans.robot, there.humans.robot)
    np.testing.assert_allclose(one.env.obs, there.env.obs, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(one.human_data.resample, there.human_data.resample)
    for here, elsewhere in zip(jax.tree.leaves(one.policy.params), jax.tree.leaves(there.policy.params), strict=True):
        np.testing.assert_allclose(here, elsewhere, rtol=1e-3, atol=1e-5)


step_alone, step_on_mesh = (compiled(partial(fleetjax.run, mesh=mesh)) for mesh in (None, mesh_of()))


def assert_a_step_agrees(config):
    """After some timesteps on one device, the next is the same on eight: who helps whom, and what is remembered."""
    key = jax.random.key(4)
    state = compiled(fleetjax.prepare)(config, key)
    for _ in range(6):
        state = step_alone(config, key, state).state
    alone, divided = (step(config, key, state).state for step in (step_alone, step_on_mesh))
    for name in ("robot", "duration"):
        np.testing.assert_array_equal(getattr(alone.humans, name), getattr(divided.humans, name))
    for name in ("priority", "people", "links", "given"):
        here, there = (jax.tree.leaves(getattr(after, name)) for after in (alone, divided))
        for one, other in zip(here, there, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5, err_msg=name)
    return alone


def with_memory_or_allocator():
    """Return the algorithms that remember something of the fleet, or choose robots in a way of their own."""
    found = []
    for name in fleetjax.list_algorithms():
        algorithm = priority.get_algorithm(name)
        memory = jax.eval_shape(algorithm.make_priority(small(name, num_humans=40)).init)
        if jax.tree.leaves(memory) or algorithm.make_allocate is not priority.Algorithm.make_allocate:
            found.append(name)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", with_memory_or_allocator())
def test_an_algorithm_with_a_memory_or_an_allocator_helps_the_same_robots_on_a_mesh(name):
    own = priority.get_algorithm(name).defaults(small("constraint"))
    humans = {"num_humans": own.get("num_humans", SMALL["num_humans"])}
    assert_a_step_agrees(small(name, num_steps=1, initial_period=0, human_capacity=500, **humans))


@pytest.mark.slow
@pytest.mark.parametrize("links", LINK_MODELS.names())
@pytest.mark.parametrize("people", [name for name in HUMAN_MODELS.names() if name != "perfect"])
def test_people_and_links_are_the_same_on_a_mesh(people, links):
    given = {
        "takeover_time": 2.3,
        "action_delay": 2.0,
        "action_noise": 0.1,
        "mistake_rate": 0.1,
        "absence": 0.2,
        "fatigue": 1.0,
    }
    given = given if people != "perfect" else {}
    config = small(
        "random", num_steps=1, human_capacity=500, random_threshold=0.0, human_model=people, link_model=links, **given
    )
    after = assert_a_step_agrees(config)
    assert int(after.human_data.pairs.size) > SMALL["num_demonstrations"]


def test_where_nothing_rounds_a_run_agrees_to_the_bit():
    config, key = small("expert", num_humans=40), jax.random.key(1)
    alone, divided = run(config, key), run(config, key, mesh=mesh_of())
    for here, there in zip(jax.tree.leaves(alone.state.env), jax.tree.leaves(divided.state.env), strict=True):
        np.testing.assert_array_equal(jax.device_get(here), jax.device_get(there))
    for name in set(alone.metrics._fields) - {"reward", "uncertainty"}:  # sums over robots, which do round
        np.testing.assert_array_equal(getattr(alone.metrics, name), getattr(divided.metrics, name))
    assert not divided.state.env.obs.sharding.is_fully_replicated


@pytest.mark.parametrize(
    "algorithm",
    [pytest.param("expert", marks=pytest.mark.slow), pytest.param("random", marks=pytest.mark.long)],
)
def test_a_run_of_humanoids_in_native_physics_agrees_in_what_does_not_round(algorithm):
    num_humans = SMALL["num_robots"] if algorithm == "expert" else 8
    given = {"num_steps": 12, "initial_period": 0, "num_humans": num_humans, "backend": "native"}
    config, key = small(algorithm, "humanoid", **given), jax.random.key(4)
    alone, divided = run(config, key), run(config, key, mesh=mesh_of())
    for name, here in alone.metrics._asdict().items():
        there = getattr(divided.metrics, name)
        if jnp.issubdtype(here.dtype, jnp.integer):
            np.testing.assert_array_equal(here, there, err_msg=name)
        else:
            np.testing.assert_allclose(here, there, rtol=1e-3, atol=1e-5, err_msg=name)
    for part in ("humans", "resetting", "timestep"):
        jax.tree.map(np.testing.assert_array_equal, getattr(alone.state, part), getattr(divided.state, part))
    assert int(divided.metrics.human_steps.sum()) > 0
    assert len(divided.state.env.obs.sharding.device_set) == DEVICES
    np.testing.assert_allclose(alone.state.env.obs, divided.state.env.obs, rtol=1e-3, atol=1e-3)


@pytest.mark.long
@pytest.mark.statistical
def test_runs_agree_in_distribution():
    config, keys = small("cur", num_steps=200), jax.random.split(jax.random.key(2), 10)
    totals = {
        mesh: np.array([int(run(config, key, mesh=mesh).metrics.successes.sum()) for key in keys]) for mesh in (None, mesh_of())
    }
    assert totals[None].std() > 0
    assert stats.ks_2samp(totals[None], totals[mesh_of()]).pvalue > 0.001


@pytest.mark.slow
def test_runs_from_the_start_and_from_each_others_ends_share_one_program():
    config, key = small("cur", num_steps=2, pretraining_steps=1, critic_pretraining_steps=1), jax.random.key(0)
    again = jax.jit(lambda state: fleetjax.run(config, key, state, mesh=mesh_of()).state)
    state = jax.jit(lambda: fleetjax.prepare(config, key, mesh=mesh_of()))()
    again(again(again(state)))
    assert again._cache_size() == 1


def test_a_run_continues_on_another_number_of_devices():
    config, key = small("random", num_steps=6), jax.random.key(3)
    half = run(config, key, mesh=mesh_of()).state
    moved = jax.device_put(half, jax.devices()[0])
    ends = [run(config, key, half, mesh=mesh_of()).metrics, run(config, key, moved).metrics]
    np.testing.assert_array_equal(ends[0].human_steps, ends[1].human_steps)
    np.testing.assert_allclose(ends[0].reward, ends[1].reward, rtol=1e-4)


def exchanged(config):
    """Return the shape and the kind of every collective of a run's program."""
    shapes = jax.eval_shape(fleetjax.prepare, config, jax.random.key(0))
    text = run.lower(config, jax.random.key(0), shapes, mesh=mesh_of()).compile().as_text()
    return sorted(COLLECTIVE.findall(text))


@pytest.mark.parametrize(
    ("algorithm", "environment", "number"),
    [
        ("random", "navigation", 11),
        pytest.param("random", "navigation", 11, marks=pytest.mark.slow),  # optimised
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in [("cur", "navigation", 18), ("random", "humanoid", 11), ("cur", "humanoid", 17)]
        ),
    ],
)
def test_what_devices_exchange_does_not_grow_with_the_fleet(algorithm, environment, number):
    given = {"critic_capacity": 2000, "human_capacity": 400}
    few, many = (exchanged(small(algorithm, environment, num_robots=n, **given)) for n in (64, 128))
    assert few == many
    assert 0 < len(few) < 40
    if "JAX_DISABLE_MOST_OPTIMIZATIONS" not in os.environ:  # which merge collectives
        assert len(few) == number  # as docs/scale.md says


def test_a_fleet_that_devices_cannot_divide_is_refused():
    with pytest.raises(
        ValueError, match=r"num_robots = 42 cannot be divided equally among 8 devices; use num_robots = 40 or 48"
    ):
        fleetjax.run(small("random", num_robots=42), jax.random.key(0), mesh=mesh_of())


def test_the_soft_allocation_is_refused():
    with pytest.raises(ValueError, match="allocation = 'soft' runs on one device only"):
        fleetjax.run(small("weighted", allocation="soft"), jax.random.key(0), mesh=mesh_of())
