"""The model of imperfect humans from the record of a console session."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fleetjax.console import fitting
from fleetjax.console.engine import EMPTY, PERSON, SIMULATED
from fleetjax.console.fitting import Takeover
from fleetjax.humans import takeover_times

KIND = np.dtype([("timestep", "<i4"), *((name, kind, (2,)) for name, kind in
                 (("seat", "u1"), ("robot", "<i4"), ("given", "u1"), ("confirmed", "u1")))])  # fmt: skip


def record(seat: list[int], robot: list[int], acts: list[int], confirmed: list[int] | None = None) -> np.ndarray:
    """Return rows in which seat 0 does this, and the simulated supervisor has seat 1."""
    rows = np.zeros(len(seat), KIND)
    rows["seat"][:, 0], rows["seat"][:, 1] = seat, SIMULATED
    rows["robot"][:, 0], rows["given"][:, 0] = robot, acts
    rows["given"][:, 1] = 1
    if confirmed:
        rows["confirmed"][:, 0] = confirmed
    return rows


def test_a_takeover_lasts_from_the_assignment_to_the_first_action():
    robot = [-1, 4, 4, 4, 4, 7, 7, -1, 2, 2, 3]
    given = [0, 0, 0, 1, 1, 0, 1, 0, 0, 0, 0]
    rows = record([PERSON] * 11, robot, given)
    assert fitting.takeovers(rows, 0) == [Takeover(2, True, False), Takeover(1, True, True), Takeover(2, False, False)]
    assert fitting.takeovers(rows, 1) == []


def test_a_hard_reset_is_an_action_and_what_others_do_in_the_seat_is_none():
    rows = record([PERSON, PERSON, PERSON, EMPTY, EMPTY], [1, 1, 1, 1, 1], [0, 0, 0, 1, 1], [0, 0, 1, 0, 0])
    assert fitting.takeovers(rows, 0) == [Takeover(2, True, False)]
    simulated = record([SIMULATED] * 4, [1, 1, 2, 2], [1, 1, 1, 1])
    assert fitting.takeovers(simulated, 0) == []


def test_absence_is_the_time_between_people():
    seat = [EMPTY, PERSON, PERSON, EMPTY, EMPTY, SIMULATED, PERSON, EMPTY, PERSON, EMPTY]
    assert fitting.absences(record(seat, [-1] * 10, [0] * 10), 0) == (8, [3, 1])


def session(times: np.ndarray, lag: np.ndarray, patience: int) -> np.ndarray:
    """Return the record of a person who acts after these times, by turns on a new robot after a rest and after another one."""
    robot, given, free = [], [], True
    for number, (time, later) in enumerate(zip(times, lag, strict=True)):
        wait = round(time + (0 if free else later))
        length = min(wait + 2, patience)
        robot += [number % 90] * length
        given += [int(t >= wait) for t in range(length)]
        free = number % 2 == 1
        if free:
            robot, given = [*robot, -1, -1], [*given, 0, 0]
    return record([PERSON] * len(robot), robot, given)


@pytest.mark.parametrize("patience", [1000, 25])
def test_the_fit_finds_the_model_that_people_follow(patience):
    mean, number = 20.0, 600
    times = np.asarray(takeover_times(jnp.full(number, mean), jnp.full(number, 0.6), jax.random.key(0)))
    found = fitting.fit(session(times, np.full(number, 8.0), patience), [0], absence_time=100.0)
    assert abs(found.takeover_time - mean) < 2.5
    assert abs(found.takeover_spread - 0.6) < 0.12
    assert abs(found.switching_lag - 8) < 4
    assert (found.absence, found.absence_time) == (0, 100)


@pytest.mark.parametrize(("mean", "spread", "help_time"), [(6.0, 0.5, 5), (2.7, 0.5, 3), (6.0, 0.3, 5)])
def test_help_that_ends_before_most_takeovers_does_not_bias_the_fit(mean, spread, help_time):
    """Takeovers are whole timesteps, and help of L timesteps shows those of less than L."""
    number = 4000
    key, other = jax.random.split(jax.random.key(1))
    times = np.asarray(takeover_times(jnp.full(number, mean), jnp.full(number, spread), key))
    whole = np.floor(times + np.asarray(jax.random.uniform(other, (number,)))).astype(int)
    found = fitting._lognormal([Takeover(min(int(time), help_time), bool(time < help_time), False) for time in whole])
    assert found[0] == pytest.approx(mean, rel=0.1)
    assert found[1] == pytest.approx(spread, abs=0.1)


def test_people_who_act_at_once_need_no_time():
    rows = record([PERSON] * 12, [n // 2 for n in range(12)], [1] * 12)
    assert fitting.fit(rows, [0], absence_time=100.0).takeover_time == 0


@pytest.mark.parametrize(
    ("times", "longer"), [([0] * 10, [3]), ([0] * 20, [30]), ([0] * 20 + [10], []), ([0] * 5 + [20] * 5, [])]
)
def test_people_of_whom_many_act_at_once_have_the_mean_of_their_times(times, longer):
    rows = session(np.array(times + longer, float), np.zeros(len(times + longer)), 1000)
    end = np.flatnonzero(rows["robot"][:, 0] >= 0)
    if longer:  # the last help ends before the first action
        rows["given"][end[-longer[0] - 2] :, 0] = 0
        rows = np.concatenate([rows, record([PERSON], [-1], [0])])
    found = fitting.fit(rows, [0], absence_time=100.0)
    assert 0 <= found.takeover_time <= max(times + longer) + 2
    assert found.takeover_spread <= fitting.WIDEST


def test_people_who_are_hardly_there_are_away_as_long_as_the_model_allows():
    seat = [PERSON] * 10 + [EMPTY] * 2000 + [PERSON]
    robot = [n // 2 for n in range(10)] + [-1] * 2001
    found = fitting.fit(record(seat, robot, [1] * 10 + [0] * 2001), [0], absence_time=100.0)
    assert (found.absence, found.absence_time) == (0.99, 2000)


def test_too_few_actions_are_refused():
    rows = record([PERSON] * 4, [1, 1, 2, 2], [0, 1, 0, 1])
    with pytest.raises(ValueError, match="took over robots 2 times; at least 5"):
        fitting.fit(rows, [0], absence_time=100.0)
    assert list(fitting.report(rows, absence_time=100.0))[1:] == [(name, "2", *"-----") for name in ("seat 1", "all")]
