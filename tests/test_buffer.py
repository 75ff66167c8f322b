"""Buffers hold what a list would hold: all rows until they are full, then the newest (a ring) or the oldest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleetjax.learning import buffer

CAPACITY, BATCH = 7, 3
masks = st.lists(st.lists(st.booleans(), min_size=BATCH, max_size=BATCH), min_size=1, max_size=12)
append = jax.jit(buffer.append, static_argnames="overwrite")


def fill(steps: list[list[bool]], *, overwrite: bool) -> tuple[buffer.Buffer, list[int]]:
    """Return a buffer that was given consecutive numbers where the masks hold, and those numbers."""
    store, given = buffer.create({"x": jnp.zeros((), jnp.int32)}, CAPACITY), []
    for t, mask in enumerate(steps):
        rows = 1 + BATCH * t + np.arange(BATCH)
        store = append(store, {"x": jnp.asarray(rows)}, jnp.asarray(mask), overwrite=overwrite)
        given += [int(row) for row, is_new in zip(rows, mask, strict=True) if is_new]
    return store, given


@given(masks)
def test_a_store_keeps_the_first_rows_in_order(steps):
    store, given = fill(steps, overwrite=False)
    kept = given[:CAPACITY]
    assert int(store.size) == len(kept)
    np.testing.assert_array_equal(store.rows["x"], kept + [0] * (CAPACITY - len(kept)))


@pytest.fixture(scope="module", params=[buffer.COUNTED, 20])
def counted(request):
    """The usual limit, and a small one, which stands for the 2^30 rows that no test can add."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(buffer, "COUNTED", request.param)
        append.clear_cache()
        yield request.param
    append.clear_cache()


@given(steps=masks)
def test_a_ring_keeps_the_last_rows(counted, steps):
    store, given = fill(steps, overwrite=True)
    assert int(store.size) == min(len(given), CAPACITY)
    assert int(store.added) < counted
    ring = np.zeros(CAPACITY, int)
    for i, row in enumerate(given):
        ring[i % CAPACITY] = row
    np.testing.assert_array_equal(store.rows["x"], ring)
