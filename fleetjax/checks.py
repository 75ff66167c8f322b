"""What is refused before anything is computed: runs beyond the memory, and states that do not fit their configuration."""

import math
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from fleetjax import envs, sharding
from fleetjax.config import Config, all_fields, get_value, taught_pairs, validate
from fleetjax.envs import Env
from fleetjax.fleet import FleetState, init, make_parts
from fleetjax.learning import imitation
from fleetjax.learning.buffer import Buffer, is_buffer
from fleetjax.learning.networks import Normalizer
from fleetjax.metrics import Metrics
from fleetjax.physics.base import check_backend
from fleetjax.precision import in_32_bits

_GIB = 2**30
_REMEDY = "call prepare with this configuration"
# Where Linux keeps the limit of a container's memory: control groups, version 2 and 1.
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


@in_32_bits
def state_shapes(config: Config, env: Env) -> FleetState:
    """Return shapes and types of a fleet's state; nothing is computed."""

    def blank(config: Config, key: jax.Array) -> FleetState:
        parts = make_parts(config, env)
        zeros = jnp.zeros(env.spec.observation_size)
        data = imitation.data_of(config, env.spec)
        policy = parts.learner.init(key, Normalizer(zeros, zeros, zeros[0]))
        return init(parts, key, policy, data, {name: e.init(key, data, policy) for name, e in parts.estimators.items()})

    return jax.eval_shape(blank, config, jax.random.key(0))


def check_run(config: Config, env: Env | None = None, state: FleetState | None = None) -> Env:
    """Check all that can be checked before a run is computed; return its environment.

    Args:
        config: configuration.
        env: the environment, if it is not the registered one that the configuration names.
        state: the state to start from, if there is one.

    Raises:
        ValueError: if the configuration is not valid, this process cannot use the backend, the run cannot fit the memory, or
            it cannot start from the state.
    """
    env = check_plan(config, env, state)
    check_backend(config.backend)
    return env


def check_plan(config: Config, env: Env | None = None, state: FleetState | None = None, *, copies: int = 1) -> Env:
    """Check as `check_run`, but not the backend: another process, which may have a GPU, computes `copies` of it at once."""
    check_kind("env", env, Env, "fleetjax.envs.make(name)")
    check_kind("state", state, FleetState, "what prepare returns, or the state of a run's Result")
    validate(config, env)
    check_single(config)
    check_mesh(config)
    env = env or envs.make(config.environment, config.backend)
    shapes = state_shapes(config, env)
    check_memory(config, shapes, copies)
    if state is not None:
        check_state(config, env, state, shapes)
    return env


def check_single(config: Config) -> None:
    """Check that each field has one value.

    Raises:
        ValueError: if one has several, which are a sweep.
    """
    for name, field in all_fields(config.algorithm).items():
        shapes = [jnp.shape(value) for value in jax.tree.leaves(get_value(config, name))] if field.traced else []
        if any(shapes):
            each = "; to give each human a value, pass a tuple" if field.per_human else ""
            raise ValueError(f"{name} has shape {max(shapes)}, but a run takes one value; for a sweep, use jax.vmap{each}")


def check_mesh(config: Config) -> None:
    """Check that the fleet can be divided over the mesh for which it is traced.

    Raises:
        ValueError: if the number of robots is not a multiple of the number of devices, or the allocation is soft.
    """
    here, n = sharding.division(), config.num_robots
    if here is None:
        return
    size = here.mesh.size
    if n % size:
        sizes = [str(near) for near in (n // size * size, (n // size + 1) * size) if near >= config.num_humans]
        raise ValueError(
            f"num_robots = {n} cannot be divided equally among {size} devices; use num_robots = {' or '.join(sizes)}"
        )
    if config.allocation == "soft":
        raise ValueError("allocation = 'soft' runs on one device only; leave out the mesh")


def robot_bytes(config: Config, state: FleetState) -> int:
    """Return about how many bytes of memory a robot takes while a run is computed, 3 S + 8 K (H + A).

    S is the size of its state, which a run holds three times: at the start, at the end and in between. Beside it are two
    layers of H units, and two actions of A numbers, of each of the K members of the policy; a number has 4 bytes. What the
    physics needs inside a step, and how a network sees images, is not counted. Nothing is computed.

    Args:
        config: configuration.
        state: shapes of the fleet's state.
    """
    action_size = state.human_data.pairs.rows.action.shape[-1]
    in_state = count_bytes(state.env) // config.num_robots
    return 3 * in_state + 8 * config.ensemble_size * (max(config.hidden_sizes) + action_size)


def check_memory(config: Config, state: FleetState, copies: int = 1) -> None:
    """Check that the arrays that a run cannot do without fit the memory.

    Args:
        config: configuration.
        state: shapes of the fleet's state.
        copies: runs that are computed side by side.

    Raises:
        ValueError: if they do not; the message has the estimate, the memory there is, and the field to reduce.
    """
    learnt = jax.tree.leaves(state.estimators, is_leaf=is_buffer)
    stores = [x for x in learnt if isinstance(x, Buffer)]
    parts = {
        "num_robots": config.num_robots * robot_bytes(config, state),
        "hidden_sizes": 2 * count_bytes(state.policy) + count_bytes([x for x in learnt if not isinstance(x, Buffer)]),
        "human_capacity": count_bytes(state.human_data),
        "critic_capacity": count_bytes(stores),
        "num_steps": config.num_steps * 4 * len(Metrics._fields),
    }
    divided, everywhere = sharding.shares()
    for name in parts:
        parts[name] = math.ceil(parts[name] * (divided if name in ("num_robots", "critic_capacity") else everywhere))
    needed, limit = copies * sum(parts.values()), memory()
    who = "the run needs" if copies == 1 else f"{copies} runs side by side need"
    if needed > limit:
        largest = max(parts, key=lambda name: parts[name])
        raise ValueError(
            f"{largest} = {getattr(config, largest)} is too large: {who} at least {needed / _GIB:,.2f} GiB of memory "
            f"({copies * parts[largest] / _GIB:,.2f} GiB for this field), but only {limit / _GIB:,.2f} GiB are available"
        )


def count_bytes(tree: Any) -> int:
    """Return the size of a pytree of arrays, or of their shapes."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def memory() -> int:
    """Return the bytes of memory of the default device; on a CPU, what this process may have of the machine's."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"]
    limits = [Path(name).read_text().strip() for name in _LIMITS if Path(name).is_file()]
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([machine, *(int(limit) for limit in limits if limit.isdecimal())])


def is_key(value: Any) -> bool:
    """Return whether a value is a JAX key, or an array of them."""
    return isinstance(value, jax.Array) and bool(jnp.issubdtype(value.dtype, jax.dtypes.prng_key))


def check_key(key: Any) -> None:
    """Check that an argument is a single JAX key.

    Raises:
        ValueError: if it is not.
    """
    if not is_key(key) or key.ndim:
        raise ValueError(
            "key must be a single JAX key, such as jax.random.key(0); for several keys, use jax.vmap or jax.lax.map"
        )


def check_kind(what: str, value: Any, kind: type, remedy: str) -> None:
    """Check that an argument is what it should be, unless it is None.

    Raises:
        ValueError: if it is something else.
    """
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"{what} must be of type {kind.__name__}, not {type(value).__name__}; pass {remedy}")


def check_state(config: Config, env: Env, state: FleetState, shapes: FleetState) -> None:
    """Check that a run can start from a state.

    Args:
        config: configuration.
        env: the environment.
        state: where to start.
        shapes: what the state must look like.

    Raises:
        ValueError: if the state is another environment's or fleet's, its layout differs (other networks, estimators or memory
            of the rule), or (where its numbers are concrete) it has no room for the pairs that the run can give.
    """
    made = state.origin
    if made.environment not in ("", env.spec.name):
        raise ValueError(f"environment = {env.spec.name!r}, but the state was prepared for {made.environment!r}; {_REMEDY}")
    if state.resetting.ndim != 1:
        raise ValueError("the state holds several fleets; use jax.vmap or jax.lax.map over them")
    sizes = {"num_robots": state.resetting.shape[0], "num_humans": state.humans.robot.shape[0]}
    for name, found in sizes.items():
        if found != getattr(config, name):
            raise ValueError(f"{name} = {getattr(config, name)}, but the state was prepared for {found}; {_REMEDY}")
    wanted, given = _layout(shapes), _layout(state)
    if jax.tree.structure(wanted) != jax.tree.structure(given):
        raise ValueError(_other_structure(config, made.algorithm))
    for (path, found), leaf in zip(jax.tree_util.tree_leaves_with_path(given), jax.tree.leaves(wanted), strict=True):
        if (found.shape, found.dtype) != (leaf.shape, leaf.dtype):
            raise ValueError(
                f"the state does not fit the configuration: its {jax.tree_util.keystr(path)} is {_shown(found)}; "
                f"expected {_shown(leaf)}; {_REMEDY}"
            )
    _check_room(config, state)


def _other_structure(config: Config, made_for: str) -> str:
    """Return the message for a state with another structure than a run needs."""
    if config.algorithm == made_for:
        differ = "allocation, hidden_sizes, estimators, human_model, link_model"
        return f"the state does not have the structure that this configuration needs ({differ}); {_REMEDY}"
    return (
        f"algorithm = {config.algorithm!r} keeps other estimators or another memory than {made_for!r}, for which the state was "
        f"prepared; {_REMEDY}"
    )


def _layout(state: FleetState) -> FleetState:
    """Return shapes and types; of buffers those of a row, since any capacity will do."""

    def describe(x: Any) -> Any:
        if isinstance(x, Buffer):
            whole = jax.ShapeDtypeStruct((), x.added.dtype)  # in any number of parts
            return x._replace(rows=jax.tree.map(lambda rows: _struct(rows, 1), x.rows), added=whole)
        return _struct(x)

    data = state.human_data
    described = jax.tree.map(describe, state, is_leaf=is_buffer)
    rows = {"resample": _struct(data.resample, 1), "weight": None if data.weight is None else _struct(data.weight, 1)}
    return described._replace(human_data=described.human_data._replace(**rows), origin=FleetState._field_defaults["origin"])


def _struct(x: Any, first_axis: int = 0) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape[first_axis:], x.dtype)


def _shown(x: jax.ShapeDtypeStruct) -> str:
    return f"{x.dtype}{list(x.shape)}"


def _check_room(config: Config, state: FleetState) -> None:
    pairs = state.human_data.pairs
    stored = 0 if isinstance(pairs.added, Tracer) else int(pairs.added)
    missing = stored + taught_pairs(config) - pairs.capacity
    if missing > 0:
        raise ValueError(
            f"num_steps = {config.num_steps} can produce {taught_pairs(config)} human pairs, but the state has room for "
            f"{pairs.capacity - stored} more; make room with fleetjax.extend(state, {missing})"
        )
