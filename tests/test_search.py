"""The search for a parameter's value, against functions that are known."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleetjax.search import Scale, solve

PLAIN, BOUNDED = Scale(bounded=False), Scale(bounded=True)


@given(
    st.floats(0.003, 300), st.floats(0.3, 3), st.floats(0.01, 10), st.booleans(), st.floats(10, 1e5)
)  # where it is, how steep, where the search begins, whether it falls, what is wanted
def test_a_monotone_function_is_solved_in_few_measurements(place, power, start, falls, wanted):
    sign = -1 if falls else 1
    found = solve(lambda x: wanted * (x / place) ** (sign * power), wanted, start, PLAIN, tolerance=0.02, most=25)
    assert found[-1][1] == pytest.approx(wanted, rel=0.02)
    assert found[0][0] == pytest.approx(start)


@given(st.floats(0.01, 0.9999))
def test_values_between_0_and_1_stay_there(place):
    """As Random's threshold: human time in proportion to what lies above it."""
    asked = []

    def measure(x):
        asked.append(x)
        return 1e5 * (1 - x)

    found = solve(measure, 1e5 * (1 - place), 0.9, BOUNDED, tolerance=0.02, most=20)
    assert found[-1][1] == pytest.approx(1e5 * (1 - place), rel=0.02)
    assert all(0 < x < 1 for x in asked)


def test_a_hump_is_crossed():
    """Human time need not fall with a threshold."""
    found = solve(lambda x: 100 + 50 * math.exp(-(math.log(x) ** 2) / 4), 140, 0.2, PLAIN, tolerance=0.01, most=20)
    assert found[-1][1] == pytest.approx(140, rel=0.01)


def test_without_a_solution_the_search_ends_and_the_nearest_is_among_what_was_tried():
    found = solve(lambda x: 500 + 1 / x, 100, 1.0, PLAIN, tolerance=0.01, most=9)
    assert len(found) <= 9
    assert min(number for _, number in found) == pytest.approx(500, rel=0.01)


def test_a_jump_over_the_wanted_number_ends():
    found = solve(lambda x: 1000.0 if x < 0.7 else 10.0, 100, 0.1, PLAIN, tolerance=0.01, most=40)
    assert len(found) < 40
    assert found[-1][0] == pytest.approx(0.7, rel=1e-2)
