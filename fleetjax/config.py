"""The configuration of a run: the values of its parameters, which `field.py` declares.

Static fields shape the program. Traced fields are arrays: `vmap` over them sweeps them in one compilation.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from fleetjax import envs, humans, priority, supervisors
from fleetjax.field import FIELDS, KINDS, OF_HUMANS, OF_LINKS, SHAPES_OF_HUMANS, Field, Fields, owners
from fleetjax.physics.base import BACKENDS
from fleetjax.priority import estimators_of
from fleetjax.registry import unknown


@dataclasses.dataclass(frozen=True)
class Config(Fields):
    """Parameters of a run. Make one with `make_config`; change one with `replace`.

    Attributes:
        parameters: the algorithm's own, by name: f32, i32 or bool scalars, traced.
        capacity_given: whether `human_capacity` was set explicitly; otherwise it is derived from the other fields.
    """

    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    capacity_given: bool = False

    def replace(self, **changes: Any) -> "Config":
        """Return a config with some fields, or parameters of its algorithm, changed.

        Traced ones become i32, f32 or bool scalars. A new algorithm brings its own parameters, with their defaults.

        Raises:
            ValueError: if a field is unknown, a parameter is another algorithm's, an integer field gets a value that is not an
                integer, or the number of demonstrations is traced and no `human_capacity` says how many pairs there may be.
        """
        algorithm = changes.get("algorithm", self.algorithm)
        known = all_fields(algorithm)
        for name in changes:
            if name not in known:
                raise ValueError(_not_known(name, algorithm))
        typed = {name: _typed(name, known[name], value) for name, value in changes.items()}
        own = self.parameters
        if not own or algorithm != self.algorithm:
            own = _default_parameters(changes.get("environment", self.environment), algorithm)
        own = {**own, **{name: typed.pop(name) for name in list(typed) if name not in FIELDS}}
        return _with_capacity(self, dataclasses.replace(self, **typed, parameters=own), changes)


ALLOCATIONS = ("hard", "soft")
_LARGEST = 2**31 - 1
_LARGEST_EXACT = 2**24  # beyond it f32 skips whole numbers
_DEMONSTRATIONS = ("num_demonstrations", "extra_demonstrations")
_TRACED = [name for name, field in FIELDS.items() if field.traced]
_STATIC = [name for name, field in FIELDS.items() if not field.traced]
jax.tree_util.register_dataclass(Config, data_fields=[*_TRACED, "parameters"], meta_fields=[*_STATIC, "capacity_given"])


def all_fields(algorithm: str) -> dict[str, Field]:
    """Return the fields of `Config` and the parameters of a registered algorithm, by name.

    Raises:
        ValueError: if the algorithm is unknown.
    """
    return FIELDS | dict(priority.get_algorithm(algorithm).parameters)


def get_value(config: Config, name: str) -> Any:
    """Return the value of a field, or of a parameter of the algorithm."""
    return getattr(config, name) if name in FIELDS else config.parameters[name]


def _not_known(name: str, algorithm: str) -> str:
    """Return the message for a name that is no field and none of an algorithm's parameters."""
    others = owners(name)
    if others:
        have = ", ".join(map(repr, others))
        return f"{name} is a parameter of algorithm = {have}, not of {algorithm!r}; omit it, or choose that algorithm"
    return unknown("config field", name, all_fields(algorithm))


def _default_parameters(environment: str, algorithm: str) -> dict[str, Any]:
    """Return an algorithm's own parameters, with the defaults that an environment gives them."""
    changed = envs.get_defaults(environment) if environment in envs.ENVIRONMENTS else {}
    own = priority.get_algorithm(algorithm).parameters
    return {name: _typed(name, field, changed.get(name, field.default)) for name, field in own.items()}


def _typed(name: str, field: Field, value: Any) -> Any:
    """Return a value as its field holds it.

    Raises:
        ValueError: if it has another type, or is an integer beyond 32 bits.
    """
    if field.per_human and isinstance(value, (tuple, list)):
        return tuple(_as_array(name, field, one) for one in value)
    return _as_array(name, field, value) if field.traced else _as_static(name, field, value)


def _as_static(name: str, field: Field, value: Any) -> Any:
    kind = field.kind
    if kind is str and isinstance(value, str):
        return value
    if kind is str or not (isinstance(value, (tuple, list)) if kind is tuple else _is_integer(value)):
        raise ValueError(f"{name} = {value!r} must be {KINDS[kind]}")
    numbers = list(value) if kind is tuple else [value]
    if not all(map(_is_integer, numbers)):
        raise ValueError(f"{name} = {value!r} must hold whole numbers")
    if any(abs(number) > _LARGEST for number in numbers):
        raise ValueError(f"{name} = {value!r} must lie within 32 bits")
    return tuple(map(int, numbers)) if kind is tuple else int(numbers[0])


def _is_integer(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _as_array(name: str, field: Field, value: Any) -> jax.Array:
    kind = field.kind
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    is_bool, is_int, is_float = (jnp.issubdtype(array.dtype, t) for t in (jnp.bool_, jnp.integer, jnp.floating))
    if kind is bool:
        if not is_bool:
            raise ValueError(f"{name} = {value!r} must be True or False")
        return _on_device(array, jnp.bool_)
    if isinstance(value, (list, tuple)) or not array.size or not (is_int or is_float):  # arrays are sweeps
        huge = isinstance(value, int) and not isinstance(value, bool)  # beyond what NumPy holds
        raise ValueError(f"{name} = {value!r} must {'lie within 32 bits' if huge else 'be a number'}")
    if kind is int:
        _check_whole(name, field, array)
    return _on_device(array, jnp.int32 if kind is int else jnp.float32)


def _on_device(array: "jax.Array | np.ndarray", dtype: Any) -> jax.Array:
    """Return numbers as JAX's, known ones as known: within a trace, `jnp.asarray` would make a tracer of them."""
    if not _is_concrete(array):
        return jnp.asarray(array, dtype)
    with jax.ensure_compile_time_eval(), np.errstate(over="ignore"):  # what becomes infinite is out of range
        return jnp.asarray(array, dtype)


def _check_whole(name: str, field: Field, array: "jax.Array | np.ndarray") -> None:
    """Check that numbers are whole and lie within 32 bits.

    Raises:
        ValueError: if they do not, or are floats so large that they may stand for another whole number.
    """
    is_float = jnp.issubdtype(array.dtype, jnp.floating)
    values = np.asarray(array, np.float64) if _is_concrete(array) else None
    whole = not is_float if values is None else np.all(np.isfinite(values) & (values == np.round(values)))
    if not whole:
        raise ValueError(f"{name} = {array} must be a whole number{f' of {field.unit}' if field.unit else ''}")
    if values is None:
        return
    if np.any(np.abs(values) > _LARGEST):
        raise ValueError(f"{name} = {array} must lie within 32 bits")
    if is_float and np.any(np.abs(values) > _LARGEST_EXACT):
        raise ValueError(f"{name} = {array} is a float beyond 2^24, where floats skip whole numbers; pass an int")


def _is_concrete(value: Any) -> bool:
    return not isinstance(value, Tracer)


def taught_pairs(config: Config) -> int:
    """Return how many pairs humans can add while the fleet runs, augmented copies included."""
    updates = priority.get_algorithm(config.algorithm).updates
    return config.augmented_copies * config.num_humans * config.num_steps if updates else 0


def needed_human_capacity(config: Config) -> int:
    """Return how many pairs a run can collect; demonstrations count where they are concrete."""
    offline = 0
    if priority.get_algorithm(config.algorithm).pretrains and _has_concrete_offline(config):
        offline = int(np.max(np.asarray(config.num_demonstrations) + np.asarray(config.extra_demonstrations)))
    return max(config.augmented_copies * offline + taught_pairs(config), 1)


def _has_concrete_offline(config: Config) -> bool:
    return all(_is_concrete(getattr(config, name)) for name in _DEMONSTRATIONS)


def _with_capacity(before: Config, after: Config, changes: Mapping[str, Any]) -> Config:
    """Return `after` with room for the human data of a run: what was asked for, or what follows from the other fields.

    Raises:
        ValueError: if it would follow from a number of demonstrations that is traced.
    """
    if changes.get("human_capacity"):
        return dataclasses.replace(after, capacity_given=True)
    needed = needed_human_capacity(after)
    if after.capacity_given and "human_capacity" not in changes:
        return dataclasses.replace(after, human_capacity=max(after.human_capacity, needed))
    if _has_concrete_offline(after) or not priority.get_algorithm(after.algorithm).pretrains:
        return dataclasses.replace(after, human_capacity=needed, capacity_given=False)
    for name in _DEMONSTRATIONS:
        if name in changes and not _is_concrete(getattr(after, name)):
            raise ValueError(
                f"{name} is traced. Also pass human_capacity: the largest number of demonstrations times "
                f"augmented_copies, plus {taught_pairs(after)}"
            )
    longer = max(0, taught_pairs(after) - taught_pairs(before))
    return dataclasses.replace(after, human_capacity=before.human_capacity + longer)


def make_config(environment: "str | envs.Env", algorithm: str = "cur", **overrides: Any) -> Config:
    """Return the configuration of an experiment, with the paper's defaults for this environment and algorithm.

    Args:
        environment: registered name, or an `Env` to be passed to `run` as well.
        algorithm: registered name.
        **overrides: fields of `Config`, and the algorithm's own parameters.

    Raises:
        ValueError: if a name or a field is unknown, a parameter is another algorithm's, or a value is out of range.

    >>> config = make_config("navigation", "cur", num_robots=20)
    >>> config.num_robots, int(config.min_teleop_time)
    (20, 5)

    Reference: paper, Section 5.2 and Appendix (simulation hyper-parameters).
    """
    env = environment if isinstance(environment, envs.Env) else None
    name = env.spec.name if env else str(environment)
    defaults = {} if env else envs.get_defaults(name)
    known = all_fields(algorithm)
    for override in overrides:
        if override not in known:
            raise ValueError(_not_known(override, algorithm))
    of_place = {key: value for key, value in defaults.items() if key in known}
    of_field = {key: field.default for key, field in known.items()}
    if any(override in OF_HUMANS for override in overrides):
        overrides = {"human_model": "imperfect"} | overrides
    if any(override in OF_LINKS for override in overrides):
        overrides = {"link_model": "gilbert_elliott"} | overrides
    config = Config().replace(**of_field | of_place | {"environment": name, "algorithm": algorithm} | overrides)
    of_others = dict(priority.get_algorithm(algorithm).defaults(config))
    bar = (env or envs.make(name, config.backend)).spec.success_return
    if bar is not None:
        of_others["success_return"] = bar
    config = config.replace(**{**of_others, **overrides})  # again: a human_capacity that is given must not grow unasked
    validate(config, env)
    return config


def check_one_for_all(config: Config, name: str) -> None:
    """Check that a field has one value for all humans.

    Raises:
        ValueError: if it has a tuple, a value for each.
    """
    if isinstance(get_value(config, name), tuple):
        raise ValueError(f"{name} has a value for each human; only a single number can be tuned or differentiated")


def validate(config: Config, env: "envs.Env | None" = None) -> None:
    """Check a configuration in plain Python, before anything is computed. Traced fields are checked where concrete.

    Args:
        config: the configuration.
        env: the environment, if it is not the registered one that the configuration names.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """
    for name, field in all_fields(config.algorithm).items():
        _check_range(name, get_value(config, name), field)
    if config.num_humans > config.num_robots:
        raise ValueError(
            f"num_humans = {config.num_humans} is more than num_robots = {config.num_robots}; a human helps one robot at a time"
        )
    if not config.hidden_sizes or min(config.hidden_sizes) < 1:
        raise ValueError(f"hidden_sizes = {config.hidden_sizes} must be one or more numbers, each at least 1")
    if config.backend not in BACKENDS:
        raise ValueError(unknown("backend", config.backend, BACKENDS))
    if config.allocation not in ALLOCATIONS:
        raise ValueError(unknown("allocation", config.allocation, ALLOCATIONS))
    algorithm = priority.get_algorithm(config.algorithm)
    if config.algorithm == "expert" and config.num_humans != config.num_robots:
        raise ValueError(
            f"num_humans = {config.num_humans} must equal num_robots = {config.num_robots} for algorithm = 'expert', "
            "which teleoperates every robot"
        )
    if algorithm.estimators and config.critic_capacity < config.num_robots:
        raise ValueError(f"critic_capacity = {config.critic_capacity} must be at least num_robots = {config.num_robots}")
    if algorithm.pretrains or algorithm.updates:
        _check_data(config, algorithm)
    env = env or envs.make(config.environment, config.backend)
    supervisors.check(config.supervisor or env.spec.supervisor, env)
    if config.augmented_copies > 1 and not env.spec.image_shape:
        raise ValueError(
            f"augmented_copies = {config.augmented_copies} needs images, and environment = {env.spec.name!r} has none; "
            "leave it at 1"
        )
    algorithm.check(config, env.spec)
    _check_humans(config)
    if config.allocation == "soft":
        _check_soft(config, algorithm, env)
    if "goal" in estimators_of(algorithm, env.spec) and not env.spec.has_goal:
        raise ValueError(
            f"algorithm = {config.algorithm!r} needs a goal to learn from, and environment = {env.spec.name!r} has none; "
            "choose another algorithm, or an environment with goals"
        )


def _check_humans(config: Config) -> None:
    """Check what is said of humans and links.

    Raises:
        ValueError: if a name is unknown, a tuple has not a value for each human, or a value would have no effect.
    """
    humans.HUMAN_MODELS.get(config.human_model)
    humans.LINK_MODELS.get(config.link_model)
    for name in OF_HUMANS:
        value = getattr(config, name)
        if isinstance(value, tuple) and len(value) != config.num_humans:
            raise ValueError(
                f"{name} has {len(value)} values for num_humans = {config.num_humans}; give one for each human, or one for all"
            )
        idle = config.human_model == "perfect" and name not in SHAPES_OF_HUMANS
        if idle and any(_is_concrete(x) and np.any(np.asarray(x) != 0) for x in jax.tree.leaves(value)):
            raise ValueError(f"{name} has no effect with human_model = 'perfect'; also pass human_model = 'imperfect'")
    for name in OF_LINKS:
        value = getattr(config, name)
        usual = np.float32(FIELDS[name].default)
        if config.link_model != "gilbert_elliott" and _is_concrete(value) and np.any(np.asarray(value, np.float32) != usual):
            raise ValueError(
                f"{name} has no effect with link_model = {config.link_model!r}; also pass link_model = 'gilbert_elliott'"
            )
    _check_absence(config)
    if config.allocation == "soft" and (config.human_model, config.link_model) != ("perfect", "perfect"):
        raise ValueError("allocation = 'soft' needs human_model = 'perfect' and link_model = 'perfect'")


def _check_absence(config: Config) -> None:
    """Check that humans can be away for such a share of the time, since whoever comes stays for a timestep at least.

    Raises:
        ValueError: if an absence would have to be longer.
    """
    both = (config.absence, config.absence_time)
    for i in range(config.num_humans if any(isinstance(value, tuple) for value in both) else 1):
        pair = [value[i] if isinstance(value, tuple) else value for value in both]
        if not all(map(_is_concrete, pair)):
            continue
        share, time = (np.asarray(value, np.float32) for value in pair)
        least = share / (1.0 - share)
        if np.any(time < least * (1.0 - 1e-5)):
            raise ValueError(
                f"absence_time = {time!s} is too short for absence = {share!s}, since whoever comes stays for a timestep; "
                f"make it at least {np.max(least):.3g}, or lower absence"
            )


def _check_soft(config: Config, algorithm: priority.Algorithm, env: envs.Env) -> None:
    """Check that a run can be relaxed.

    Raises:
        ValueError: if it cannot; the message says what can.
    """
    if not algorithm.differentiable:
        raise ValueError(
            f"allocation = 'soft' needs scores with derivatives, and those of algorithm = {config.algorithm!r} are ranks or "
            "chance; choose algorithm = 'weighted'"
        )
    if env.spec.discrete or (env.success_margin is None and env.spec.success_return is None):
        raise ValueError(
            f"allocation = 'soft' cannot relax environment = {env.spec.name!r}, whose actions are discrete, or whose successes "
            "have neither Env.success_margin nor EnvSpec.success_return"
        )
    if config.augmented_copies > 1:
        raise ValueError(f"augmented_copies = {config.augmented_copies} must be 1 for allocation = 'soft'")
    if not isinstance(config.temperature, Tracer) and np.any(np.asarray(config.temperature) <= 0):
        raise ValueError(f"temperature = {config.temperature} must be positive for allocation = 'soft'")


def _check_range(name: str, value: Any, field: Field) -> None:
    if field.per_human and isinstance(value, tuple):
        for one in list(value):
            _check_range(name, one, field)
        return
    if field.kind in (str, tuple, bool) or not _is_concrete(value):
        return
    values = np.asarray(value, np.float64)  # holds derived whole numbers that no integer type does
    low, high = field.low, field.high
    least = -np.inf if low is None else min(low, float(np.float32(low)))  # a bound may be stored with 32 bits
    most = np.inf if high is None else max(high, float(np.float32(high)))
    if np.all(np.isfinite(values) & (values >= least) & (values <= most)):
        return
    allowed = f"in [{low}, {high}]" if high is not None else f"at least {low}"
    shown = value if values.ndim or isinstance(value, int) else value.item()
    raise ValueError(f"{name} = {shown} must be {allowed}{' ' + field.unit if field.unit else ''}")


def _check_data(config: Config, algorithm: priority.Algorithm) -> None:
    if algorithm.pretrains and _has_concrete_offline(config):
        pairs = np.min(np.asarray(config.num_demonstrations) + np.asarray(config.extra_demonstrations))
        if config.batch_size > pairs:
            raise ValueError(
                f"batch_size = {config.batch_size} is larger than the data: num_demonstrations + extra_demonstrations = "
                f"{pairs}; lower batch_size or raise num_demonstrations"
            )
    needed = needed_human_capacity(config)
    if max(needed, config.human_capacity) > _LARGEST:
        raise ValueError(
            f"human_capacity = {needed} pairs, which this run can produce, must lie within 32 bits; lower num_steps"
        )
    if config.human_capacity < needed:
        raise ValueError(
            f"human_capacity = {config.human_capacity} is less than the {needed} pairs that this run can produce; "
            f"omit it, or pass at least {needed}"
        )
