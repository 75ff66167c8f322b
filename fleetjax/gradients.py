"""How much more a fleet is worth if a parameter changes: gradients from shifted runs, a relaxed fleet, or forward mode.

A fleet decides by thresholds, ranks and resets, so the derivative of one run is not that of the mean over runs. `smoothed` is
unbiased for the mean over Gaussian perturbations, whatever the fleet does. `relaxed` and `forward` differentiate through the
timesteps, and do not see what stays hard.

References: Suh et al., Do differentiable simulators give better policy gradients?, 2022; Metz et al., Gradients are not all you
need, 2021; Nesterov and Spokoiny, Random gradient-free minimization of convex functions, 2017 (smoothing).
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.interpreters import partial_eval

from fleetjax import checks
from fleetjax.config import Config, all_fields, check_one_for_all, get_value
from fleetjax.envs import Env
from fleetjax.experiment import prepare, run, step_once
from fleetjax.field import OFFLINE, Field
from fleetjax.fleet import FleetState
from fleetjax.metrics import Metrics, rohe
from fleetjax.precision import in_32_bits
from fleetjax.priority.weighted import SMALLEST
from fleetjax.registry import unknown

METHODS = ("smoothed", "relaxed", "forward")
WIDTH = 0.1  # deviation of perturbations, in units of a field's value
STEPS, _NOISE = 2**32 - 2, 2**32 - 1  # folded into a run's key for tuning and for noise; `keys.key_at` folds in timesteps
Objective = Callable[[Metrics, Config], jax.Array]
Values = dict[str, jax.Array]


class Sensitivity(NamedTuple):
    """What a fleet is worth, and its derivatives; all are means over keys.

    Attributes:
        value: f32[] the objective.
        gradient: f32[] by field, its derivative.
        standard_error: f32[] by field, of the gradient; NaN for one key, except with `"smoothed"` and more than two samples
            that are not all equal.
    """

    value: jax.Array
    gradient: Values
    standard_error: Values


def final_return(metrics: Metrics, config: Config) -> jax.Array:
    """Return f32[], the return on human effort at the end of a run."""
    return rohe(metrics, config)[-1]


@in_32_bits
def sensitivity(
    config: Config,
    keys: jax.Array,
    fields: str | Sequence[str],
    *,
    objective: Objective | None = None,
    method: str = "smoothed",
    width: float | Mapping[str, float] | None = None,
    num_samples: int = 64,
    env: Env | None = None,
) -> Sensitivity:
    """Return the derivatives of what a fleet is worth by some of its parameters.

    The fleet is prepared once for each key, and this state is held fixed: derivatives are those of what happens from t = 0.

    Args:
        config: configuration.
        keys: random key, or keys [S]. Results are means over them.
        fields: names of traced fields, or of parameters of the algorithm.
        objective: `(Metrics[T], config) -> f32[]`; by default the return on human effort at the end.
        method: `"smoothed"`: differences between runs whose fields are shifted up and down by the same Gaussian noise. Works
            everywhere. `"relaxed"`: reverse mode through the run with `allocation = "soft"`. For environments in plain JAX, and
            algorithms with differentiable scores such as `weighted`. `"forward"`: forward mode through the run as configured,
            one field after the other. For environments on MJX, too.
        width: of the noise in `"smoothed"`, its standard deviation: a fraction of each field's value (0.1 if None), or a
            mapping from fields to widths themselves. Shifted values are clipped to the field's range; at a bound the
            derivative is half of the one-sided slope.
        num_samples: shifted runs for each key in `"smoothed"`, an even number.
        env: the environment, if it is not the registered one that the configuration names.

    Returns:
        Sensitivity. Its standard error is over keys; in `"smoothed"` it is at least that of the samples.

    Raises:
        ValueError: if a field is unknown, static, or of a kind that the method cannot differentiate by, the method does not
            work with this configuration, or the run does not fit the memory; the message says what would work.

    Warns:
        UserWarning: if the objective does not depend on a field, or its derivative by it is exactly 0.
    """
    request = check_request(config, keys, fields, objective or final_return, method, width, num_samples, env)
    config, env, names = request.config, request.env, request.names
    derive = make_gradient(config, env, objective or final_return, names, method, request.widths, num_samples)

    def of_key(key: jax.Array) -> tuple[jax.Array, Values, Values]:
        return derive({name: get_value(config, name) for name in names}, key, prepare(config, key, env))

    values, gradients, variances = jax.lax.map(of_key, request.keys)
    found = Sensitivity(
        jnp.mean(values),
        {name: jnp.mean(gradients[name]) for name in names},
        {name: _standard_error(gradients[name], variances[name]) for name in names},
    )
    _warn_of_zeros(found, request.unused, hard=method == "forward" and config.allocation == "hard")
    return found


class Request(NamedTuple):
    """What was asked for, checked.

    Attributes:
        config: configuration, relaxed if need be.
        keys: keys [S].
        names: of the fields.
        widths: of the noise on each; empty without noise.
        env: environment.
        unused: fields on which the objective does not depend.
    """

    config: Config
    keys: jax.Array
    names: tuple[str, ...]
    widths: Values
    env: Env
    unused: list[str]


def check_request(
    config: Config,
    keys: jax.Array,
    fields: str | Sequence[str],
    objective: Objective,
    method: str,
    width: float | Mapping[str, float] | None,
    num_samples: int,
    env: Env | None,
) -> Request:
    """Check what `sensitivity` is asked for, before anything is computed.

    Raises:
        ValueError: as `sensitivity`.

    Warns:
        UserWarning: of fields on which the objective does not depend.
    """
    names = (fields,) if isinstance(fields, str) else tuple(fields)
    keys = _as_keys(keys)
    if method not in METHODS:
        raise ValueError(unknown("method", method, METHODS))
    _check_fields(config, names, method)
    if not is_whole(num_samples) or num_samples < 2 or num_samples % 2:
        raise ValueError(f"num_samples = {num_samples!r} must be an even number, and at least 2: runs come in pairs")
    if method == "relaxed":
        config = config.replace(allocation="soft")
    env = checks.check_run(config, env)
    if method != "smoothed":
        _check_derivatives(config, env, method)
    widths = _widths(config, names, width) if method == "smoothed" else {}
    without_effect = unused(config, env, objective, names)
    for name in without_effect:
        warnings.warn(f"the objective does not depend on {name}, its derivative is 0: omit it from fields", stacklevel=4)
    return Request(config, keys, names, widths, env, without_effect)


def make_objective(config: Config, env: Env, worth: Objective) -> Callable[[Values, jax.Array, FleetState], jax.Array]:
    """Return `(values by field, key, state) -> f32[]`, what a run from a state is worth with other values."""

    def objective(values: Values, key: jax.Array, state: FleetState) -> jax.Array:
        changed = config.replace(**values)
        value = jnp.asarray(worth(run(changed, key, state, env).metrics, changed))
        if value.ndim:
            raise ValueError(f"objective returned an array of shape {value.shape}; it must return one number")
        return value.astype(jnp.float32)

    return objective


def unused(config: Config, env: Env, worth: Objective, names: Sequence[str]) -> list[str]:
    """Return the fields that have no effect on the objective, as its program tells without being run."""
    values = {name: jax.typeof(get_value(config, name)) for name in names}
    program = jax.make_jaxpr(make_objective(config, env, worth))(values, jax.random.key(0), checks.state_shapes(config, env))
    _, is_used = partial_eval.dce_jaxpr(program.jaxpr, [True])
    return [name for name, used in zip(sorted(names), is_used, strict=False) if not used]  # dicts are flattened in order


def make_gradient(
    config: Config, env: Env, worth: Objective, names: Sequence[str], method: str, widths: Values, num_samples: int
) -> Callable[[Values, jax.Array, FleetState], tuple[jax.Array, Values, Values]]:
    """Return `(values by field, key, state) -> (objective, gradient, variance of the gradient)` of runs from a state."""
    objective = make_objective(config, env, worth)

    def smoothed(values: Values, key: jax.Array, state: FleetState) -> tuple[jax.Array, Values, Values]:
        known = all_fields(config.algorithm)
        noise = jax.random.normal(jax.random.fold_in(key, _NOISE), (num_samples // 2, len(names)))

        def shifted(z: jax.Array, sign: int) -> jax.Array:
            moved = {
                n: within_range(known[n], values[n].astype(jnp.float32) + sign * widths[n] * z[i]) for i, n in enumerate(names)
            }
            return objective(moved, key, state)

        chunk = min(chunk_size(config, env), noise.shape[0])
        rises = jax.lax.map(lambda z: (shifted(z, 1) - shifted(z, -1)) / 2, noise, batch_size=chunk if chunk > 1 else None)
        slopes = {name: rises * noise[:, i] / widths[name] for i, name in enumerate(names)}
        gradient = {name: jnp.mean(slope) for name, slope in slopes.items()}
        ddof = min(1, num_samples // 2 - 1)
        variance = {name: jnp.var(slope, ddof=ddof) / (num_samples // 2) for name, slope in slopes.items()}
        return objective(values, key, state), gradient, variance

    def relaxed(values: Values, key: jax.Array, state: FleetState) -> tuple[jax.Array, Values, Values]:
        value, gradient = jax.value_and_grad(objective)(values, key, state)
        return value, gradient, jax.tree.map(jnp.zeros_like, gradient)

    def forward(values: Values, key: jax.Array, state: FleetState) -> tuple[jax.Array, Values, Values]:
        def along(direction: jax.Array) -> tuple[jax.Array, jax.Array]:
            tangent = {name: direction[i] for i, name in enumerate(names)}
            return jax.jvp(lambda values: objective(values, key, state), (values,), (tangent,))

        value, slopes = jax.lax.map(along, jnp.eye(len(names)))
        return value[0], {name: slopes[i] for i, name in enumerate(names)}, jax.tree.map(jnp.zeros_like, values)

    return {"smoothed": smoothed, "relaxed": relaxed, "forward": forward}[method]


def chunk_size(config: Config, env: Env) -> int:
    """Return how many pairs of shifted runs are computed side by side: as many as fit half of the memory.

    On a CPU it is one, since runs one after the other are faster there.
    """
    if jax.default_backend() == "cpu":
        return 1
    of_pair = 2 * 3 * checks.count_bytes(checks.state_shapes(config, env))  # at the start, at the end and in between
    return max(checks.memory() // 2 // of_pair, 1)


def within_range(field: Field, value: jax.Array) -> jax.Array:
    """Return a value as a field can hold it: within its range, and whole if need be."""
    if field.kind is int:
        return jnp.round(jnp.clip(value, field.low, field.high)).astype(jnp.int32)
    return jnp.clip(value, SMALLEST if field.low == 0 else field.low, field.high)  # some are divided by


def _standard_error(gradients: jax.Array, variances: jax.Array) -> jax.Array:
    """Return f32[], the error of the mean over keys: from their spread, but no less than what their samples tell."""
    number = gradients.shape[0]
    within = jnp.mean(variances) / number
    if number == 1:
        return jnp.sqrt(jnp.where(within > 0, within, jnp.nan))
    return jnp.sqrt(jnp.maximum(jnp.var(gradients, ddof=1) / number, within))


def _as_keys(keys: jax.Array) -> jax.Array:
    """Return keys [S]."""
    if not (checks.is_key(keys) and keys.ndim < 2 and keys.size):
        raise ValueError("keys must be a key or an array of keys: jax.random.split(jax.random.key(0), 8)")
    return keys.reshape(-1)


def _check_fields(config: Config, names: Sequence[str], method: str) -> None:
    """Check that these fields can be differentiated."""
    known = all_fields(config.algorithm)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"fields = {list(names)} must name one or more fields, each once")
    for name in names:
        config.replace(**{name: get_value(config, name)} if name in known else {name: 0})  # an unknown name is refused
        field = known[name]
        if not field.traced or field.kind is bool:
            raise ValueError(f"field {name} is {'static' if not field.traced else 'a switch'}; it has no derivative")
        check_one_for_all(config, name)
        if name in OFFLINE:
            raise ValueError(f"field {name} acts only before t = 0, and the fleet at t = 0 is held fixed; omit it")
        if field.kind is int and method != "smoothed":
            raise ValueError(f"field {name} is a whole number; use method = 'smoothed', not {method!r}")


def _widths(config: Config, names: Sequence[str], width: float | Mapping[str, float] | None) -> Values:
    """Return the standard deviation of the noise on each field."""
    given = width if isinstance(width, Mapping) else {}
    unknown_names = set(given) - set(names)
    if unknown_names:
        raise ValueError(f"width names {', '.join(sorted(unknown_names))}, which fields does not have")
    if not all(map(is_finite, given.values() if isinstance(width, Mapping) else [0 if width is None else width])):
        raise ValueError(f"width = {width!r} must be a finite number, or a mapping from fields to such numbers")
    share = WIDTH if width is None or isinstance(width, Mapping) else width
    widths = {name: given[name] if name in given else share * abs(_concrete(config, name)) for name in names}
    for name, found in widths.items():
        if not isinstance(found, Tracer) and not found > 0:
            raise ValueError(f"width of {name} = {found} must be positive; pass width={{{name!r}: ...}}")
    return {name: jnp.float32(found) for name, found in widths.items()}


def is_finite(value: Any) -> bool:
    """Return whether a value is a finite number, or may be one, since it is traced."""
    try:
        return isinstance(value, Tracer) or (not isinstance(value, str) and math.isfinite(value))
    except TypeError:
        return False


def is_whole(value: Any) -> bool:
    """Return whether a value is a whole number."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _concrete(config: Config, name: str) -> float:
    value = get_value(config, name)
    if isinstance(value, Tracer):
        raise ValueError(f"{name} is traced, so the width of its noise must be given: width={{{name!r}: ...}}")
    return float(value)


def _check_derivatives(config: Config, env: Env, method: str) -> None:
    """Check that an environment can be differentiated, and that reverse mode fits the memory.

    Raises:
        ValueError: if not; the message says which method would work.
    """
    state = jax.eval_shape(lambda: env.reset(jax.random.key(0), jnp.int32(0)))

    def works(transform: Callable[..., Any]) -> bool:
        def derive(state: Any, key: jax.Array) -> Any:
            def rewarded(action: jax.Array) -> jax.Array:
                return env.step(state, action, jnp.ones((), bool), key).reward

            return transform(rewarded, jnp.zeros(env.spec.action_size))

        try:
            jax.eval_shape(derive, state, jax.random.key(0))
        except (ValueError, NotImplementedError, TypeError):
            return False
        return True

    name, other = env.spec.name, ", or backend = 'mjx' for method = 'forward'" if config.backend in ("auto", "native") else ""
    if not works(lambda f, x: jax.jvp(f, (x,), (x,))):
        raise ValueError(
            f"method = {method!r} needs derivatives of environment = {name!r}, and with backend = {config.backend!r} there are "
            f"none; use method = 'smoothed'{other}"
        )
    if method == "relaxed" and not works(lambda f, x: jax.grad(f)(x)):
        raise ValueError(
            f"method = 'relaxed' needs reverse-mode derivatives, and environment = {name!r} has only forward ones; use "
            "method = 'forward' or 'smoothed'"
        )
    if method == "relaxed":
        needed, limit = reverse_bytes(config, env), checks.memory()
        if needed > limit:
            raise ValueError(
                f"num_steps = {config.num_steps} is too large for method = 'relaxed': it needs about {needed / 2**30:,.1f} GiB "
                f"of memory, and {limit / 2**30:,.1f} GiB are available; shorten the run, or use method = 'smoothed'"
            )


def reverse_bytes(config: Config, env: Env) -> int:
    """Return about how many bytes reverse mode through a run keeps: the state before each block, and all steps of one block."""
    size = math.isqrt(config.num_steps)
    state = checks.state_shapes(config, env)

    def residuals(state: FleetState, key: jax.Array) -> Any:
        return jax.vjp(lambda s: step_once(config, env, s, key), state)[1]

    kept = jax.eval_shape(residuals, state, jax.random.key(0))
    return checks.count_bytes(state) * (config.num_steps // size + 2) + checks.count_bytes(kept) * size


def _warn_of_zeros(found: Sensitivity, known: Sequence[str], *, hard: bool) -> None:
    """Warn of fields, other than `known`, whose derivative is exactly 0; under jit numbers are not known."""
    why = ": in a hard fleet, thresholds, ranks and counts have none; try method = 'smoothed'" if hard else ""
    for name, slope in found.gradient.items():
        if name not in known and not isinstance(slope, Tracer) and slope == 0:
            warnings.warn(f"the derivative by {name} is exactly 0{why}", stacklevel=4)
