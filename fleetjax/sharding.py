"""One fleet over many devices: the robots are divided among them, all else is on each of them.

A program is traced within `over(mesh, num_humans)`. The compiler divides what is written for the whole fleet. This module has
what it needs help with, so that the amount that devices exchange does not grow with the number of robots.
"""

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

ROBOTS = "robots"  # the axis of the mesh
DIVIDED, EVERYWHERE = PartitionSpec(ROBOTS), PartitionSpec()


class Division(NamedTuple):
    """How a fleet is divided: the devices, and M, of which no device needs to know more robots than that."""

    mesh: Mesh
    num_humans: int


_DIVISION: ContextVar[Division | None] = ContextVar("division", default=None)


@contextlib.contextmanager
def over(mesh: Mesh | None, num_humans: int) -> Iterator[None]:
    """Trace the programs of this block for a fleet that is divided over a mesh; None = not divided."""
    division = None if mesh is None else Division(flat(mesh), num_humans)
    token = _DIVISION.set(division)
    try:
        with contextlib.nullcontext() if division is None else jax.sharding.use_abstract_mesh(division.mesh.abstract_mesh):
            yield
    finally:
        _DIVISION.reset(token)


def division() -> Division | None:
    """Return how the fleet is divided that is traced now; None = it is not."""
    return _DIVISION.get()


def shares() -> tuple[float, float]:
    """Return how much of what is divided, and how many copies of what is everywhere, one memory holds.

    The virtual devices of a CPU have one memory; so have the CPU devices of a process on its own.
    """
    here = division()
    if here is None:
        return 1.0, 1.0
    devices = here.mesh.devices.reshape(-1)
    together = len(here.mesh.local_devices) if devices[0].platform == "cpu" else 1
    return together / devices.size, float(together)


def flat(mesh: Mesh) -> Mesh:
    """Return the devices of any mesh in a row, with one axis for the robots, which the compiler divides."""
    return Mesh(mesh.devices.reshape(-1), (ROBOTS,), axis_types=(AxisType.Auto,))


def on_each(function: Callable[..., Any], spec: PartitionSpec, *args: Any) -> Any:
    """Return what each device makes of its own robots' rows of `args` [N, ...]; `spec` says whether that is divided too."""
    here = division()
    assert here
    # check_vma: neither callbacks nor what was gathered say how they vary.
    return jax.shard_map(function, mesh=here.mesh, in_specs=DIVIDED, out_specs=spec, check_vma=False)(*args)


def gather(tree: Any) -> Any:
    """Return, within `on_each`, the rows of all devices."""
    return jax.lax.all_gather(tree, ROBOTS, tiled=True)


def own_part(x: jax.Array) -> jax.Array:
    """Return, within `on_each`, the rows of what was gathered that came from this device."""
    return x.reshape(jax.lax.axis_size(ROBOTS), -1)[jax.lax.axis_index(ROBOTS)]


def total(rows: jax.Array) -> jax.Array:
    """Return the sum [...] of rows [N, ...]. On a mesh it rounds the same way for any number of processes."""
    if division() is None:
        return jnp.sum(rows, axis=0)
    return on_each(lambda own: jnp.sum(gather(jnp.sum(own, axis=0, keepdims=True)), axis=0), EVERYWHERE, rows)


def vmap(function: Callable[..., Any], *args: Any) -> Any:
    """Return `jax.vmap(function)(*args)`. On a mesh each device maps its own robots, with its own calls of the host."""
    mapped = jax.vmap(function)
    return mapped(*args) if division() is None else on_each(mapped, DIVIDED, *args)


def put(x: jax.Array, index: jax.Array, values: Any) -> jax.Array:
    """Return [N] with `values` [K] at `index` i32[K]; those beyond N are dropped. On a mesh each device keeps its own rows."""
    here = division()
    if here is None:
        return x.at[index].set(values, mode="drop")

    def put_own(x: jax.Array, index: jax.Array, values: jax.Array) -> jax.Array:
        place = index - jax.lax.axis_index(ROBOTS) * x.size
        return x.at[jnp.where(place >= 0, place, x.size)].set(values, mode="drop")

    specs = (DIVIDED, EVERYWHERE, EVERYWHERE)
    return jax.shard_map(put_own, mesh=here.mesh, in_specs=specs, out_specs=DIVIDED)(x, index, jnp.asarray(values))


def pin(tree: Any, spec: PartitionSpec) -> Any:
    """Return a pytree whose leaves are divided over the mesh as `spec` says; the same pytree where there is no mesh."""
    here = division()
    return tree if here is None else jax.lax.with_sharding_constraint(tree, NamedSharding(here.mesh, spec))


def everywhere(tree: Any) -> Any:
    """Return a pytree that every device has."""
    return pin(tree, EVERYWHERE)
