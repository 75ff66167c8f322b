"""Imperfect people and links: each effect alone, and nothing where all are neutral."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import refused
from compiling import compiled

import fleetjax
from fleetjax import envs, humans
from fleetjax.config import validate
from fleetjax.fleet import make_fleet, make_parts, plan
from fleetjax.io import flags, plain
from fleetjax.keys import split_keys
from fleetjax.types import HumanState, Plan, Signals

N, M, A = 6, 3, 2
SMALL = {"num_robots": 20, "num_humans": 4, "num_steps": 80, "initial_period": 5, "pretraining_steps": 30}
SPEC = envs.make("navigation").spec
quick_run = compiled(fleetjax.run)


def model(**parameters):
    """Return a model of three humans over six robots, and what it carries at t = 0."""
    config = fleetjax.make_config("navigation", num_robots=N, num_humans=M, human_model="imperfect", **parameters)
    found = humans.HUMAN_MODELS.get("imperfect")(config, SPEC)
    return found, found.init(config, jax.random.key(0))


def planned(*robots: int) -> Plan:
    """Return a plan in which the humans teleoperate these robots, -1 = none."""
    robot = jnp.array(robots, jnp.int32)
    teleoperated = jnp.zeros(N, bool).at[jnp.where(robot >= 0, robot, N)].set(True, mode="drop")
    crew = HumanState(robot, jnp.zeros(M, jnp.int32))
    signals = Signals(*[None] * 5, episode_step=jnp.full(N, 100))
    return Plan(signals, jnp.zeros((N, A)), jnp.zeros(N), crew, teleoperated, jnp.zeros(N, bool))


def follow(found, aux, plans, actions=None):
    """Return actions [T, N, A] and given [T, N] of consecutive timesteps."""
    done, given, act = [], [], compiled(found.act)
    for t, one in enumerate(plans):
        action = jnp.full((N, A), 0.5) if actions is None else actions[t]
        aux, did, really = act(aux, one, action, jax.random.key(t))
        done.append(np.asarray(did))
        given.append(np.asarray(really))
    return np.stack(done), np.stack(given), aux


@functools.cache
def result_of(**parameters):
    return quick_run(fleetjax.make_config("navigation", **SMALL | parameters), jax.random.key(0))


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_neutral_people_do_what_perfect_ones_do():
    """From the same state; whole runs are other programs, which round differently."""
    perfect = fleetjax.make_config("navigation", **SMALL)
    neutral, env = perfect.replace(human_model="imperfect"), envs.make("navigation")
    state = result_of(num_steps=40).state
    steps = [compiled(make_fleet(config, env).step) for config in (perfect, neutral)]
    people = humans.make_imperfect(neutral, SPEC).init(neutral, jax.random.key(0))._replace(robot=state.humans.robot)
    taught = 0
    for t in range(6):
        key = jax.random.key(t)
        (one, counts), (other, others) = steps[0](state, key), steps[1](state._replace(people=people), key)
        for count, other_count in zip(counts, others, strict=True):
            np.testing.assert_allclose(count, other_count, rtol=1e-3)
        assert_same(one.humans, other.humans)
        rows = one.human_data.pairs.size
        jax.tree.map(
            lambda x, y, n=rows: np.testing.assert_allclose(x[:n], y[:n], atol=1e-5),
            one.human_data.pairs.rows,
            other.human_data.pairs.rows,
        )
        taught += int(rows) - int(state.human_data.pairs.size)
        state, people = one, other.people
    assert taught > 6


@pytest.mark.parametrize("name", [name for name in humans.HUMAN_MODELS.names() if humans.HUMAN_MODELS.get(name)])
def test_every_model_keeps_shapes_and_gives_only_where_humans_teleoperate(name):
    config = fleetjax.make_config("navigation", num_robots=N, num_humans=M, human_model=name)
    found = humans.HUMAN_MODELS.get(name)(config, SPEC)
    aux = found.init(config, jax.random.key(0))
    there = found.available(aux, jax.random.key(1))
    assert (there.shape, there.dtype) == ((M,), jnp.bool_)
    one = planned(4, -1, 0)
    after, action, given = found.act(aux, one, jnp.ones((N, A)), jax.random.key(2))
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert shapes(after) == shapes(aux)
    assert (action.shape, given.shape, given.dtype) == ((N, A), (N,), jnp.bool_)
    assert not np.any(given & ~one.teleoperated)


def test_takeover_times_are_lognormal_with_a_deviation_in_proportion_to_the_mean():
    mean = jnp.repeat(jnp.array([2.0, 10.0]), 100_000)
    times = np.asarray(humans.takeover_times(mean, jnp.full(mean.shape, 0.5), jax.random.key(0))).reshape(2, -1)
    np.testing.assert_allclose(times.mean(axis=1), [2, 10], rtol=0.01)
    np.testing.assert_allclose(times.std(axis=1), [1, 5], rtol=0.03)
    logs = np.log(times[0])
    assert abs(np.mean((logs - logs.mean()) ** 3) / logs.std() ** 3) < 0.05


def test_a_human_acts_only_after_the_takeover_and_later_from_another_robot():
    found, aux = model(takeover_time=3.0, takeover_spread=0.0, switching_lag=2.0)
    plans = [planned(0, -1, -1)] * 6 + [planned(2, -1, -1)] * 8
    _, given, _ = follow(found, aux, plans)
    assert given[:, 0].tolist() == [False] * 3 + [True] * 3 + [False] * 8
    assert given[:, 2].tolist() == [False] * 6 + [False] * 5 + [True] * 3


def test_values_for_each_human_act_on_that_human():
    found, aux = model(takeover_time=(0.0, 2.0, 4.0), takeover_spread=0.0)
    _, given, _ = follow(found, aux, [planned(5, 3, 1)] * 6)
    assert [int(np.argmax(given[:, robot])) for robot in (5, 3, 1)] == [0, 2, 4]


def test_a_late_action_is_that_of_some_timesteps_ago():
    found, aux = model(action_delay=(0.0, 3.0, 10.0))
    actions = [jnp.full((N, A), t / 100) for t in range(15)]
    done, given, _ = follow(found, aux, [planned(0, 1, 2)] * 15, actions)
    assert np.all(given[:, :3])
    for robot, late in ((0, 0), (1, 3), (2, 10)):
        np.testing.assert_allclose(done[late:, robot, 0], np.arange(15 - late) / 100, rtol=1e-6)


def test_the_mean_takeover_is_kept_though_timesteps_are_whole():
    found, aux = model(takeover_time=2.7, takeover_spread=0.0)
    act, waits = compiled(found.act), []
    for t in range(120):  # each human goes to another robot every timestep
        aux, _, _ = act(aux, planned(t % 2, 2 + t % 2, 4 + t % 2), jnp.zeros((N, A)), jax.random.key(t))
        waits.append(np.asarray(aux.wait))
    assert set(np.unique(waits)) == {2, 3}
    assert np.mean(waits) == pytest.approx(2.7, abs=0.08)


def test_humans_stay_until_they_could_act_for_the_shortest_teleoperation():
    """Humans need 7 timesteps to take over, and t_T = 3: none leaves a robot before it has acted on it 3 times."""
    config = fleetjax.make_config("navigation", "random", random_threshold=0.0, takeover_time=7.0, takeover_spread=0.0, **SMALL)
    config = config.replace(min_teleop_time=3)
    step = compiled(make_fleet(config, envs.make("navigation")).step)
    state, acted, left = compiled(fleetjax.prepare)(config, jax.random.key(0)), np.zeros(4, int), []
    for t in range(45):
        before = state
        state, _ = step(state, jax.random.key(t))
        robot, last = np.asarray(state.humans.robot), np.asarray(before.humans.robot)
        was_reset, is_reset, given = (np.asarray(x) for x in (before.resetting, state.resetting, state.given))
        gone = (last >= 0) & (robot != last)
        left += acted[gone & ~was_reset[last]].tolist()
        acted = np.where(gone | is_reset[robot], 0, acted) + given[robot]
    assert len(left) > 5
    assert min(left) == 3


def test_late_actions_are_never_those_for_the_robots_last_episode():
    found, aux = model(action_delay=3.0)
    actions = [jnp.full((N, A), t / 100) for t in range(12)]
    plans = [planned(0, 1, 2) for _ in range(12)]
    for t, one in enumerate(plans):  # robots 0 and 3 are reset at t = 6
        steps = jnp.where(jnp.arange(N) % 3 == 0, t % 6, t)
        plans[t] = one._replace(signals=one.signals._replace(episode_step=steps))
    done, _, _ = follow(found, aux, plans, actions)
    np.testing.assert_allclose(100 * done[:, 1, 0], np.maximum(np.arange(12) - 3, 0), atol=1e-4)
    np.testing.assert_allclose(100 * done[:, 0, 0], [0, 0, 0, 0, 1, 2, 6, 6, 6, 6, 7, 8], atol=1e-4)


@pytest.mark.slow
def test_late_discrete_actions_are_actions():
    """All that is taught on block pushing is one of its four actions, from the first timestep on."""
    config = fleetjax.make_config("block_push", "random", action_delay=4.0, random_threshold=0.0, num_steps=12)
    config = config.replace(num_demonstrations=70, pretraining_steps=0)
    data = quick_run(config, jax.random.key(0)).state.human_data
    action = np.asarray(data.pairs.rows.action[: int(data.pairs.size)])
    assert len(action) > 70 * config.augmented_copies
    np.testing.assert_array_equal(np.sort(action, axis=1), np.tile([0, 0, 0, 1], (len(action), 1)))


def test_noise_and_mistakes():
    found, aux = model(action_noise=(0.1, 0.0, 0.0), mistake_rate=(0.0, 0.3, 0.0))
    done, _, _ = follow(found, aux, [planned(0, 1, 2)] * 400, [jnp.zeros((N, A))] * 400)
    assert done[:, 0].std() == pytest.approx(0.1, rel=0.15)
    assert np.mean(np.any(done[:, 1] != 0, axis=-1)) == pytest.approx(0.3, abs=0.1)
    assert np.abs(done[:, 1]).max() > 0.8
    assert not np.any(done[:, 2:])


def test_takeovers_of_one_human_spread_as_its_own_spread_says():
    found, aux = model(takeover_time=20.0, takeover_spread=(0.0, 0.5, 1.0))
    act, waits = compiled(found.act), []
    for t in range(400):  # each human goes to another robot every timestep
        aux, _, _ = act(aux, planned(t % 2, 2 + t % 2, 4 + t % 2), jnp.zeros((N, A)), jax.random.key(t))
        waits.append(np.asarray(aux.wait))
    spread = np.std(waits, axis=0) / 20
    assert spread[0] == 0
    assert spread[1] == pytest.approx(0.5, abs=0.15)
    assert spread[2] > 0.65


def test_each_human_has_its_own_lag_fatigue_and_absence_time():
    found, aux = model(switching_lag=(2.0, 0.0, 4.0))
    _, given, _ = follow(found, aux, [planned(0, 1, 2)] * 2 + [planned(3, 4, 5)] * 6)
    assert [int(np.argmax(given[2:, robot])) for robot in (3, 4, 5)] == [2, 0, 4]
    found, aux = model(takeover_time=3.0, takeover_spread=0.0, fatigue=(0.0, 1.0, 2.0), action_noise=0.1)
    tired = aux._replace(busy=jnp.ones(M))
    done, given, _ = follow(found, tired, [planned(0, 1, 2)] * 400, [jnp.zeros((N, A))] * 400)
    assert [int(np.argmax(given[:, robot])) for robot in (0, 1, 2)] == [3, 6, 9]
    np.testing.assert_allclose(
        done[10:, :3].std(axis=(0, 2)), 0.1 * np.array([1, 1.84, 2.68]), rtol=0.2
    )  # busy on average 0.84
    found, aux = model(absence=0.5, absence_time=(4.0, 40.0, 400.0))
    act, changes, before = compiled(found.act), np.zeros(M), aux.away
    for t in range(1500):
        aux, _, _ = act(aux, planned(-1, -1, -1), jnp.zeros((N, A)), jax.random.key(t))
        changes, before = changes + np.asarray(before != aux.away), aux.away
    assert changes[0] > 3 * changes[1] > 9 * max(changes[2], 1)


def test_humans_with_their_own_values_are_swept_together():
    """A tuple of arrays: values for each human, and a leading axis of configurations."""

    def waits(scale):
        found, aux = model(takeover_time=(0.0 * scale, 2.0 * scale, 4.0 * scale), takeover_spread=0.0)
        return found.act(aux, planned(5, 3, 1), jnp.zeros((N, A)), jax.random.key(0))[0].wait

    np.testing.assert_array_equal(jax.vmap(waits)(jnp.array([1.0, 3.0])), [[0, 2, 4], [0, 6, 12]])


@pytest.mark.slow
def test_who_is_there_and_what_they_do_are_drawn_apart(monkeypatch):
    keys = {}

    def make(config, spec):
        found = humans.HUMAN_MODELS.get("imperfect")(config, spec)

        def available(aux, key):
            jax.debug.callback(lambda data: keys.update(available=data), jax.random.key_data(key))
            return found.available(aux, key)

        def act(aux, plan, action, key):
            jax.debug.callback(lambda data: keys.update(act=data), jax.random.key_data(key))
            return found.act(aux, plan, action, key)

        return found._replace(available=available, act=act)

    monkeypatch.setitem(humans.HUMAN_MODELS.entries, "watched", make)
    config = fleetjax.make_config("navigation", human_model="watched", **SMALL)
    state = compiled(fleetjax.prepare)(config, jax.random.key(0))
    compiled(make_fleet(config, envs.make("navigation")).step)(state, jax.random.key(1))
    jax.effects_barrier()
    assert not np.array_equal(keys["available"], keys["act"])


def test_fatigue_grows_with_work_and_lengthens_takeovers():
    found, aux = model(fatigue=1.0, takeover_time=4.0, takeover_spread=0.0)
    _, given, fresh = follow(found, aux, [planned(0, -1, -1)] * 200)
    assert np.argmax(given[:, 0]) == 4
    np.testing.assert_allclose(fresh.busy, [1 - (1 - 1 / humans.TIRING) ** 200, 0, 0], rtol=1e-4)
    tired = fresh._replace(busy=jnp.ones(M))
    _, given, _ = follow(found, tired, [planned(1, -1, -1)] * 12)
    assert np.argmax(given[:, 1]) == 8


def test_absence_is_a_share_of_the_time_in_spells_of_a_mean_length():
    found, aux = model(absence=(0.0, 0.3, 0.8), absence_time=10.0)
    one = planned(-1, -1, -1)

    def step(aux, key):
        aux = found.act(aux, one, jnp.zeros((N, A)), key)[0]
        return aux, ~found.available(aux, key)

    away = np.asarray(
        jax.jit(lambda aux, keys: jax.lax.scan(step, aux, keys)[1])(aux, jax.random.split(jax.random.key(1), 20_000))
    )
    np.testing.assert_allclose(away.mean(axis=0), [0, 0.3, 0.8], atol=0.05)
    ends = np.sum(away[:-1] & ~away[1:], axis=0)[1:]
    np.testing.assert_allclose(away.sum(axis=0)[1:] / ends, 10, rtol=0.15)


@pytest.mark.slow
def test_nobody_who_is_away_helps():
    config = fleetjax.make_config("navigation", absence=0.9, absence_time=20.0, **SMALL)
    fleet, state = make_fleet(config, envs.make("navigation")), fleetjax.prepare(config, jax.random.key(0))
    parts, step = make_parts(config, envs.make("navigation")), compiled(fleet.step)
    seen = 0
    for t in range(30):
        state, _ = step(state, jax.random.key(t))
        away = np.asarray(state.people.away)
        _, next_plan = plan(parts, state, split_keys(jax.random.key(t + 1), 20), jnp.asarray(~away))
        assert np.all(np.asarray(next_plan.humans.robot)[away] < 0)
        seen += away.sum()
    assert seen > 30


@pytest.mark.parametrize("works", [True, False])
def test_gilbert_and_elliotts_links(works):
    config = fleetjax.make_config(
        "navigation", num_robots=400, link_model="gilbert_elliott", link_failure_rate=0.1, link_repair_rate=0.3
    )
    links = humans.LINK_MODELS.get("gilbert_elliott")(config)
    state = links.init(jax.random.key(0))
    assert np.mean(state.works) == pytest.approx(0.75, abs=0.1)
    same = state._replace(works=jnp.full(400, works))
    np.testing.assert_allclose(links.quality(same, jnp.int32(0)), 0.9 if works else 0.3, rtol=1e-6)
    up = []
    for t in range(300):
        state = state._replace(works=humans.draw(links.quality(state, jnp.int32(t)), jax.random.key(t)))
        up.append(np.asarray(state.works))
    assert np.mean(up) == pytest.approx(0.3 / 0.4, abs=0.02)


def test_the_scenarios_of_unequal_links():
    config = fleetjax.make_config("navigation", num_robots=10, num_steps=100, link_model="swapping")
    chosen = set()
    for seed in range(3):
        swapping, unequal = (humans.LINK_MODELS.get(name)(config) for name in ("swapping", "unequal"))
        lines = swapping.init(jax.random.key(seed))
        assert_same(lines, unequal.init(jax.random.key(seed)))
        assert lines.poor.sum() == 7
        chosen.add(tuple(np.asarray(lines.poor).tolist()))
        part = humans.LINK_MODELS.get("swapping")(config.replace(num_steps=10))  # of the run, as a program computes it
        for t, poor, good in ((0, 0.2, 0.9), (20, 0.2, 0.9), (50, 0.55, 0.55), (80, 0.9, 0.2), (99, 0.9, 0.2)):
            expected = np.where(lines.poor, poor, good)
            for links in (swapping, part):
                np.testing.assert_allclose(links.quality(lines, jnp.int32(t)), expected, rtol=1e-5)
        np.testing.assert_allclose(unequal.quality(lines, jnp.int32(99)), np.where(lines.poor, 0.2, 0.9), rtol=1e-6)
    assert len(chosen) == 3


@pytest.mark.parametrize(("number", "poor"), [(90, 63), (170, 119), (180, 126)])
def test_seven_of_ten_links_are_poor(number, poor):
    config = fleetjax.make_config("navigation", num_robots=number, link_model="unequal")
    assert humans.LINK_MODELS.get("unequal")(config).init(jax.random.key(0)).poor.sum() == poor


@pytest.mark.slow
def test_poor_links_stay_poor_through_a_run():
    lines = result_of(link_model="unequal").state.links.values
    assert lines.poor.sum() == 14
    assert not lines.works.all()


@pytest.mark.slow
def test_no_action_arrives_over_a_link_that_does_not_work():
    """With links that never work, nothing is taught; violations are still reset."""
    result = result_of(link_model="gilbert_elliott", link_failure_rate=1.0, link_repair_rate=0.0)
    perfect = result_of()
    assert int(result.state.human_data.pairs.size) == 500  # the demonstrations
    assert int(perfect.state.human_data.pairs.size) > 600
    assert np.sum(result.metrics.human_steps) > 0


IMPERFECT = {
    "takeover_time": 2.0,
    "action_noise": 0.1,
    "mistake_rate": 0.05,
    "fatigue": 0.5,
    "absence": 0.2,
    "action_delay": 2.0,
}


@pytest.mark.slow
def test_runs_with_imperfect_people_go_on_from_a_state():
    config = fleetjax.make_config("navigation", link_model="unequal", **SMALL | IMPERFECT)
    start = compiled(fleetjax.prepare)(config, jax.random.key(0))
    whole = quick_run(config, jax.random.key(0), start)
    half = config.replace(num_steps=40, human_capacity=config.human_capacity)
    first = quick_run(half, jax.random.key(0), start)
    second = quick_run(half, jax.random.key(0), first.state)
    assert_same(whole.metrics.successes, jnp.concatenate([first.metrics.successes, second.metrics.successes]))
    assert_same(whole.state.people, second.state.people)
    assert np.sum(whole.metrics.human_steps) > 0


@pytest.mark.long
def test_values_sweep_without_compiling_again():
    config = fleetjax.make_config("navigation", **SMALL | IMPERFECT)
    run = jax.jit(fleetjax.run, compiler_options={"xla_backend_optimization_level": 0})
    for time in (1.0, 4.0):
        run(config.replace(takeover_time=time), jax.random.key(0))
    assert run._cache_size() == 1
    swept = jax.vmap(lambda x: config.replace(takeover_time=x))(jnp.array([1.0, 40.0]))
    quick, slow = jax.vmap(lambda c: fleetjax.run(c, jax.random.key(0)).state.human_data.pairs.size)(swept)
    assert int(quick) > int(slow)


def test_parameters_choose_the_model():
    assert fleetjax.make_config("navigation").human_model == "perfect"
    assert fleetjax.make_config("navigation", takeover_time=2.0).human_model == "imperfect"


def test_values_for_each_human_are_written_and_read():
    config = fleetjax.make_config("navigation", num_humans=2, action_noise=(0.1, 0.2))
    again = plain.from_plain(plain.to_plain(config))
    assert plain.to_plain(config)["action_noise"] == [0.1, 0.2]
    assert_same(again.action_noise, config.action_noise)


def test_a_file_holds_a_value_for_each_human(tmp_path, capsys):
    times = tmp_path / "times.txt"
    three = ("run", "navigation", "--num-humans", "3", "--takeover-time", f"@{times}")
    times.write_text("1 2.5\n4e1\n")
    assert flags.parse(three).takeover_time == (1.0, 2.5, 40.0)
    times.write_text("1 2")
    assert "takeover_time has 2 values for num_humans = 3" in refused(capsys, *three)
    times.write_text("1 2 soon")
    assert "--takeover-time: 'soon' must be a number" in refused(capsys, *three)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            {"action_noise": (0.1, 0.2)},
            "action_noise has 2 values for num_humans = 10; give one for each human, or one for all",
        ),
        ({"action_noise": (0.1,) * 9 + (-0.1,)}, "action_noise = -0.1.* must be at least 0"),
        ({"absence": 1.0}, "absence = 1.0 must be in"),
        (
            {"absence": 0.9, "absence_time": 8.0},
            "absence_time = 8.0 is too short for absence = 0.9, .*make it at least 9, or lower absence",
        ),
        (
            {"num_humans": 2, "absence": (0.0, 0.98), "absence_time": (1.0, 10.0)},
            "absence_time = 10.0 is too short for absence = 0.98, .* at least 49,",
        ),
        ({"link_failure_rate": 0.5, "link_model": "unequal"}, "link_failure_rate has no effect with link_model = 'unequal'"),
        ({"link_repair_rate": 0.5, "link_model": "perfect"}, "link_repair_rate has no effect with link_model = 'perfect'"),
        ({"action_delay": 11.0}, "action_delay = 11.0 must be in"),
        ({"human_model": "imperfet"}, "human_model = 'imperfet' is unknown; the closest are imperfect"),
        ({"link_model": "good"}, "link_model = 'good' is unknown"),
        ({"human_model": "perfect", "fatigue": 1.0}, "fatigue has no effect with human_model = 'perfect'; also pass"),
    ],
)
def test_bad_input_is_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        fleetjax.make_config("navigation", **parameters)


def test_the_largest_absence_is_allowed_and_what_is_just_possible():
    assert float(fleetjax.make_config("navigation", absence=0.99).absence) == pytest.approx(0.99)
    fleetjax.make_config("navigation", absence=0.9, absence_time=9.0)


def test_a_rate_of_links_chooses_their_model():
    assert fleetjax.make_config("navigation", link_failure_rate=0.2).link_model == "gilbert_elliott"
    assert fleetjax.make_config("navigation", "cur").link_model == "perfect"


@pytest.mark.parametrize(("name", "remedy"), [("takeover_time", "pass a tuple"), ("uncertainty_threshold", "use jax.vmap")])
def test_several_values_without_vmap_are_refused(name, remedy):
    config = fleetjax.make_config("navigation", **{name: np.array([1.0, 2.0, 3.0])})
    with pytest.raises(ValueError, match=rf"{name} has shape \(3,\), but a run takes one value.*{remedy}"):
        fleetjax.run(config, jax.random.key(0))


def test_only_one_value_for_all_humans_is_calibrated_or_differentiated(tmp_path, capsys):
    path = tmp_path / "times.txt"
    path.write_text("1 2 3")
    given = ["--num-humans", "3", "--takeover-time", f"@{path}", "--field", "takeover_time", "--human-time", "500"]
    assert "takeover_time has a value for each human" in refused(capsys, "calibrate", "navigation", *given)
    config = fleetjax.make_config("navigation", num_humans=3, takeover_time=(1.0, 2.0, 3.0))
    for width in (None, 0.1):
        with pytest.raises(ValueError, match="takeover_time has a value for each human"):
            fleetjax.sensitivity(config, jax.random.key(0), ["takeover_time"], method="smoothed", width=width)


def test_a_changed_configuration_is_checked():
    with pytest.raises(ValueError, match="takeover_time has no effect"):
        validate(fleetjax.make_config("navigation").replace(takeover_time=2.0))
