"""The state of a fleet on a mesh of devices: robots and what critics store of them are divided, all else is everywhere."""

from collections.abc import Callable
from typing import Any

import jax

from fleetjax import sharding
from fleetjax.fleet import FleetState
from fleetjax.learning.buffer import Buffer, in_parts, is_buffer
from fleetjax.priority import PerRobot


def alone(function: Callable[[], Any]) -> Any:
    """Return what a function without arguments returns, which every device of the mesh computes for itself."""
    return function() if sharding.division() is None else sharding.on_each(function, sharding.EVERYWHERE)


def spread(state: FleetState) -> FleetState:
    """Return a state whose rings have a part for each device of the mesh, or are undivided without one."""
    here = sharding.division()
    return place(with_parts(state, 1 if here is None else here.mesh.size))


def with_parts(state: FleetState, parts: int) -> FleetState:
    """Return a state whose rings have so many parts; 1 = undivided."""

    def cut(x: Any) -> Any:
        return in_parts(x, parts) if isinstance(x, Buffer) and x.added.size != parts else x

    return state._replace(estimators=_map(cut, state.estimators))


def place(state: FleetState) -> FleetState:
    """Return a state that is divided over the mesh."""
    robots = (state.env, state.resetting, state.given, state.correction)
    env, resetting, given, correction = sharding.pin(robots, sharding.DIVIDED)

    def put(x: Any) -> Any:
        if not isinstance(x, Buffer) or not x.added.ndim:
            return sharding.everywhere(x)
        return sharding.pin(x, sharding.DIVIDED)

    def put_memory(x: Any) -> Any:
        return sharding.pin(x, sharding.DIVIDED) if isinstance(x, PerRobot) else sharding.everywhere(x)

    memories = (state.priority, state.people, state.links)
    memory, people, links = jax.tree.map(put_memory, memories, is_leaf=lambda x: isinstance(x, PerRobot))
    others = (state.timestep, state.humans, state.policy, state.human_data)
    timestep, humans, policy, human_data = sharding.everywhere(others)
    return state._replace(
        timestep=timestep,
        env=env,
        humans=humans,
        resetting=resetting,
        given=given,
        correction=correction,
        policy=policy,
        human_data=human_data,
        estimators=_map(put, state.estimators),
        priority=memory,
        people=people,
        links=links,
    )


def _map(function: Callable[[Any], Any], estimators: Any) -> Any:
    return jax.tree.map(function, estimators, is_leaf=is_buffer)
