"""The value of a parameter at which an algorithm spends a given human time: thresholds do not carry over."""

import functools
import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import envs
from fleetjax.checks import check_run
from fleetjax.config import Config, all_fields, check_one_for_all, get_value, validate
from fleetjax.gradients import unused
from fleetjax.io import files, folder, resumable, text
from fleetjax.io.progress import say
from fleetjax.metrics import Metrics
from fleetjax.search import FIRST_STEP, Scale, solve


class Request(NamedTuple):
    """What is to be found.

    Attributes:
        config: configuration; the field has its first value.
        field: name of the traced field or parameter.
        human_time: human timesteps, hard resets included, that a run should spend.
        seeds: of the runs; the search takes the first, then all.
        tolerance: relative difference in human time that is near enough.
        most: values that each of the two searches may try.
        output: folder of the run folders.
        checkpoint_every: timesteps between checkpoints; 0 = none.
    """

    config: Config
    field: str
    human_time: float
    seeds: tuple[int, ...]
    tolerance: float
    most: int
    output: Path
    checkpoint_every: int = 0

    def run(self, value: float, seed: int) -> folder.Run:
        """Return a run with this value of the field."""
        name = f"{self.field}-{np.float32(value)!s}-seed{seed}"
        return folder.Run(self.output / name, self.config.replace(**{self.field: _stored(value)}), seed)

    @property
    def answer(self) -> Path:
        """The file of what was found."""
        return self.output / f"calibration-{self.field}-{self.human_time:.10g}.json"


class Calibration(NamedTuple):
    """What was found.

    Attributes:
        value: of the field, the nearest that was tried.
        human_time: at that value, one for each seed.
        error: standard error of the value, from the spread over seeds and the slope; NaN where it cannot be told.
        solved: whether the mean human time is within the tolerance.
        tried: value and human time of the first seed, in order.
    """

    value: float
    human_time: tuple[float, ...]
    error: float
    solved: bool
    tried: list[tuple[float, float]]


def default_field(config: Config) -> str:
    """Return the threshold, rate or time by which an algorithm asks for help: its own, if it has one."""
    endings = ("_threshold", "_rate", "_time")
    own = [name for ending in endings for name in config.parameters if name.endswith(ending)]
    return own[0] if own else "uncertainty_threshold"


def check(request: Request) -> None:
    """Check what was asked for before anything is computed.

    Raises:
        ValueError: if it cannot be found.
    """
    known = all_fields(request.config.algorithm)
    field = known.get(request.field)
    if field is None or not field.traced or field.kind is not float:
        real = ", ".join(name for name, other in known.items() if other.traced and other.kind is float)
        raise ValueError(f"field = {request.field!r} must be a real-valued traced field; choose one of {real}")
    if field.low is None or field.low < 0:
        raise ValueError(
            f"field = {request.field!r} may be negative, and only values of at least 0 are searched; choose another"
        )
    check_one_for_all(request.config, request.field)
    usual = max(field.low, min(field.high or 1.0, 1.0) / 2)
    validate(request.config.replace(**{request.field: usual}))  # such as that it has an effect
    largest = request.config.num_humans * request.config.num_steps
    if not 0 < request.human_time < largest:
        raise ValueError(
            f"human_time = {request.human_time:g} must lie between 0 and {largest}, which is num_humans * num_steps"
        )
    for name, low in {"most": 1, "tolerance": 0}.items():
        if not getattr(request, name) >= low:
            raise ValueError(f"{name} = {getattr(request, name)} must be at least {low}")
    if not request.seeds:
        raise ValueError("seeds must name one or more")


def has_effect(request: Request) -> bool:
    """Return whether the human time of a run depends on the field, as its program tells without being run."""

    def human_time(metrics: Metrics, config: Config) -> jax.Array:
        del config
        return jnp.sum(metrics.human_steps)

    return not unused(request.config, check_run(request.config), human_time, [request.field])


def calibrate(request: Request) -> Calibration:
    """Search with the first seed; from there, search for the mean over all seeds.

    Runs that `output` holds already are not repeated.
    """
    scale, spend = _scale(request), functools.cache(functools.partial(_human_time, request))

    def mean(seeds: tuple[int, ...], value: float) -> float:
        return float(np.mean([spend(_stored(value), seed) for seed in seeds]))

    def search(seeds: tuple[int, ...], start: float, step: float = FIRST_STEP) -> list[tuple[float, float]]:
        asked = functools.partial(mean, seeds)
        found = solve(asked, request.human_time, start, scale, tolerance=request.tolerance, most=request.most, step=step)
        return [(_stored(value), spent) for value, spent in found]

    first = request.seeds[:1]
    tried = search(first, float(get_value(request.config, request.field)))
    value = _nearest(request, tried)
    if len(request.seeds) > 1:
        means = search(request.seeds, value, _step(request, value, mean(request.seeds, value), tried, scale))
        tried += [(other, spend(other, *first)) for other, _ in means if other not in dict(tried)]
        value = _nearest(request, means)
    spent = tuple(spend(value, seed) for seed in request.seeds)
    found = Calibration(value, spent, _error(value, spent, tried, scale), _is_near(request, spent), tried)
    content = found._asdict() | {"field": request.field, "wanted": request.human_time, "seeds": request.seeds}
    if math.isnan(found.error):
        content["error"] = None  # JSON has no NaN
    files.write_json(request.answer, content | {"versions": folder.versions()})
    return found


def _scale(request: Request) -> Scale:
    """Return how the field is searched, up to the largest value that makes a difference."""
    field = all_fields(request.config.algorithm)[request.field]
    spec = envs.make(request.config.environment, request.config.backend).spec
    most = math.inf if field.high is None else field.high
    if request.field == "uncertainty_threshold" and spec.discrete:
        most = math.log(spec.action_size)  # the largest entropy of so many actions
    return Scale(field.high == 1, field.low or 0.0, most, rises=request.field.endswith(("_rate", "_time")))


def _stored(value: float) -> float:
    """Return a value as a configuration stores it."""
    return float(np.float32(value))


def _human_time(request: Request, value: float, seed: int) -> float:
    """Return the human timesteps of a run with this value."""
    metrics = resumable.complete(request.run(value, seed), checkpoint_every=request.checkpoint_every)
    spent = float(np.sum(metrics.human_steps, dtype=float))
    say(f"{request.field} = {value:.6g}, seed {seed}: {text.count(spent)} human timesteps")
    return spent


def _nearest(request: Request, tried: list[tuple[float, float]]) -> float:
    """Return the value that spends nearly what is wanted."""
    return min(tried, key=lambda pair: abs(pair[1] - request.human_time))[0]


def _is_near(request: Request, spent: tuple[float, ...]) -> bool:
    """Return whether the mean over seeds is what was wanted."""
    return bool(abs(np.mean(spent) - request.human_time) <= request.tolerance * request.human_time)


def _slope(value: float, tried: list[tuple[float, float]], scale: Scale) -> float:
    """Return the change of log human time per scaled value, from it to the nearest other value; NaN if there is none."""
    here = scale.inward(value)
    rest = [(scale.inward(other), spent) for other, spent in tried if other != value]
    if not rest:
        return math.nan
    place, spent = min(rest, key=lambda pair: abs(pair[0] - here))
    return (math.log1p(dict(tried)[value]) - math.log1p(spent)) / (here - place)


def _step(request: Request, value: float, spent: float, tried: list[tuple[float, float]], scale: Scale) -> float:
    """Return how far away the mean over seeds should be what is wanted, by the slope of the first seed, if it tells."""
    slope = _slope(value, tried, scale)
    if not abs(slope) > 1e-3:
        return FIRST_STEP
    change = abs((math.log1p(request.human_time) - math.log1p(spent)) / slope)
    return min(max(change, 0.1), FIRST_STEP)


def _error(value: float, spent: tuple[float, ...], tried: list[tuple[float, float]], scale: Scale) -> float:
    slope = _slope(value, tried, scale)
    if len(spent) < 2 or not abs(slope) > 1e-3:
        return math.nan
    scaled = float(np.std(np.log1p(spent), ddof=1)) / math.sqrt(len(spent)) / abs(slope)
    if scaled > 1:  # the curve is too flat there for a straight line
        return math.nan
    here = scale.inward(value)
    return (scale.outward(here + scaled) - scale.outward(here - scaled)) / 2


def report(request: Request, found: Calibration) -> str:
    """Return what was found, in words."""
    low, high, mean = min(found.human_time), max(found.human_time), float(np.mean(found.human_time))
    error = "" if math.isnan(found.error) else f" +- {found.error:.2g}"
    seeds = text.plural(len(found.human_time), "seed")
    spread = f"{text.count(low)} to {text.count(high)} over {seeds}" if len(found.human_time) > 1 else "one seed"
    line = f"{request.field} = {found.value:.6g}{error}: {text.count(mean)} human timesteps ({spread})"
    if found.solved:
        return line
    return f"{line}\nNo value that was tried spends {text.count(request.human_time)}; this one is the nearest."
