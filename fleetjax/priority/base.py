"""What an algorithm is made of: a rule for help, an allocator, what it learns, and parameters of its own."""

import dataclasses
import importlib
import re
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax

from fleetjax.allocation import Allocator, allocate
from fleetjax.field import FIELDS, PARAMETERS, Field
from fleetjax.registry import Registry
from fleetjax.types import Signals


class Priority(NamedTuple):
    """A rule for who gets help.

    Attributes:
        init: `() -> aux`, what the rule carries from one timestep to the next.
        score: `(Signals[N], aux, key) -> (f32[N], aux)`, scores >= 0; 0 = no new help even if a human is free.
    """

    init: Callable[[], Any]
    score: Callable[[Signals, Any, jax.Array], tuple[jax.Array, Any]]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PerRobot:
    """A part of a rule's memory with a row for each robot: on a mesh of devices each device holds those of its own.

    Attributes:
        values: pytree of arrays [N, ...].
    """

    values: Any


def stateless(score: Callable[[Signals, jax.Array], jax.Array]) -> Priority:
    """Return the rule that scores by `(Signals[N], key) -> f32[N]` and remembers nothing."""
    return Priority(init=lambda: (), score=lambda signals, aux, key: (score(signals, key), aux))


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """A rule for help, an allocator, and what the fleet must do and learn for them.

    Attributes:
        make_priority: `config -> Priority`.
        estimators: registered names of the numbers to learn for each robot: `"safety"` gives `Signals.risk`, `"goal"`
            gives `Signals.goal`, all are in `Signals.estimates`.
        make_allocate: `config -> Allocator`; by default the paper's Algorithm 1.
        parameters: this algorithm's own, by name; traced. A rule reads `config.parameters["name"]`.
        optional: those of the estimators that are left out where the environment has no goals.
        defaults: `config -> fields` of `Config` whose defaults it overrides.
        check: `(config, EnvSpec) -> None` raises ValueError for a configuration that it cannot use.
        differentiable: whether scores have derivatives with respect to its parameters, as weighted sums do and ranks do not;
            the soft allocation needs it.
        sees_supervisor: whether `Signals.human_action` is filled, for upper bounds that no real fleet could reach.
        pretrains: whether demonstrations are collected and the policy is cloned before the fleet starts.
        updates: whether human data are recorded and learnt from while the fleet runs.
    """

    make_priority: Callable[[Any], Priority]
    _: dataclasses.KW_ONLY
    estimators: tuple[str, ...] = ()
    make_allocate: Callable[[Any], Allocator] = lambda config: allocate
    parameters: Mapping[str, Field] = dataclasses.field(default_factory=dict)
    optional: tuple[str, ...] = ()
    defaults: Callable[[Any], Mapping[str, Any]] = lambda config: {}
    check: Callable[[Any, Any], None] = lambda config, spec: None
    differentiable: bool = False
    sees_supervisor: bool = False
    pretrains: bool = True
    updates: bool = True


ALGORITHMS: Registry[Algorithm] = Registry("algorithm")


def register_algorithm(name: str, algorithm: Algorithm) -> None:
    """Make an algorithm available to `make_config` under `name`.

    Raises:
        ValueError: if the name is taken, or a parameter has the name of a field of `Config` or is no `Field`.
    """
    for parameter, field in algorithm.parameters.items():
        if parameter in FIELDS:
            raise ValueError(f"parameter {parameter!r} of {name!r} is a field of Config already; choose another name")
        if not isinstance(field, Field):
            raise ValueError(f"parameter {parameter!r} of {name!r} must be a fleetjax.field.Field, with its help and default")
    ALGORITHMS.register(name, algorithm)
    PARAMETERS[name] = algorithm.parameters


def register_priority(
    name: str,
    make_priority: Callable[[Any], Priority],
    *,
    estimators: tuple[str, ...] = ("safety",),
    parameters: Mapping[str, Field] | None = None,
    differentiable: bool = False,
) -> None:
    """Make a rule available as an algorithm that clones demonstrations and learns from interventions.

    Args:
        name: what `make_config` calls it.
        make_priority: `config -> Priority`.
        estimators: registered names of what it reads: `"safety"` for `Signals.risk`, `"goal"` for `Signals.goal`.
        parameters: what this algorithm alone has, by name.
        differentiable: whether its scores have derivatives with respect to its parameters; see `Algorithm`.

    Raises:
        ValueError: as `register_algorithm`, and if `estimators` is a string.
    """
    if isinstance(estimators, str):
        raise ValueError(f"estimators = {estimators!r} must be a tuple of names: ({estimators!r},)")
    own = dict(parameters or {})
    algorithm = Algorithm(make_priority, estimators=tuple(estimators), parameters=own, differentiable=differentiable)
    register_algorithm(name, algorithm)


def list_algorithms() -> tuple[str, ...]:
    """Return the registered names, orders of C, U and R included."""
    return ALGORITHMS.names()


def get_algorithm(name: str) -> Algorithm:
    """Return a registered algorithm, or of `MODULE:NAME` the `Algorithm` that a module calls NAME.

    Raises:
        ValueError: if there is none of that name; the message has the closest ones. Or if the module cannot be imported.
    """
    if isinstance(name, str) and ":" in name and name not in ALGORITHMS:
        register_algorithm(name, _import(*name.rsplit(":", 1)))
    return ALGORITHMS.get(name)


def _import(module: str, name: str) -> Algorithm:
    asked = f"algorithm = '{module}:{name}'"
    if not re.fullmatch(r"\w+(\.\w+)*", module) or not name.isidentifier():
        raise ValueError(f"{asked} must have the form MODULE:NAME, as my_rules:mine has")
    try:
        with jax.ensure_compile_time_eval():  # even during a trace, arrays of the module hold values
            found = vars(importlib.import_module(module))
    except (Exception, SystemExit) as error:  # whatever the module does
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
            raise ValueError(f"{asked}: there is no module {error.name}; add the folder that holds it to PYTHONPATH") from error
        *_, last = traceback.extract_tb(error.__traceback__)
        place = "" if isinstance(error, SyntaxError) else f" ({Path(last.filename).name}, line {last.lineno})"
        raise ValueError(f"{asked}: importing the module failed: {type(error).__name__}: {error}{place}") from error
    if not isinstance(found.get(name), Algorithm):
        others = [f"{module}:{other}" for other, value in found.items() if isinstance(value, Algorithm)]
        known = f"it has {', '.join(others)}" if others else f"define {name} = fleetjax.Algorithm(...) there"
        raise ValueError(f"{asked}: module {module} has no fleetjax.Algorithm named {name!r}; {known}")
    return found[name]


def estimators_of(algorithm: Algorithm, spec: Any) -> tuple[str, ...]:
    """Return the names of what an algorithm learns in an environment with this `EnvSpec`."""
    return tuple(name for name in algorithm.estimators if spec.has_goal or name not in algorithm.optional)
