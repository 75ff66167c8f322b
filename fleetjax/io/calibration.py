"""The value of a parameter at which an algorithm spends a given human time: thresholds do not carry over."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleetjax.config import Config, all_fields, check_one_for_all, get_value, validate
from fleetjax.io import files, folder, resumable, text
from fleetjax.io.progress import say
from fleetjax.search import Scale, solve

FILE = "calibration.json"


class Request(NamedTuple):
    """What is to be found.

    Attributes:
        config: configuration; the field has its first value.
        field: name of the traced field or parameter.
        human_time: human timesteps, hard resets included, that a run should spend.
        seeds: of the runs; the search takes the first, all confirm what it finds.
        tolerance: relative difference in human time that is near enough.
        most: runs that the search may take.
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
        exact = np.float32(value)
        return folder.Run(
            self.output / f"{self.field}-{exact!s}-seed{seed}", self.config.replace(**{self.field: float(exact)}), seed
        )


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


def calibrate(request: Request) -> Calibration:
    """Run until the value is found; runs that `output` holds already are not repeated."""
    field = all_fields(request.config.algorithm)[request.field]
    most = math.inf if field.high is None else field.high
    scale = Scale(field.high == 1, field.low or 0.0, most, rises=request.field.endswith(("_rate", "_time")))
    first, *others = request.seeds
    start = float(get_value(request.config, request.field))
    tried = solve(
        lambda value: _human_time(request, value, first),
        request.human_time,
        start,
        scale,
        tolerance=request.tolerance,
        most=request.most,
    )
    value, _ = min(tried, key=lambda pair: abs(pair[1] - request.human_time))
    spent = _over_seeds(request, value, others, tried)
    moved = _corrected(request, value, spent, tried, scale) if others else None
    if moved is not None:
        tried.append((moved, _human_time(request, moved, first)))
        again = _over_seeds(request, moved, others, tried)
        if abs(np.mean(again) - request.human_time) < abs(np.mean(spent) - request.human_time):
            value, spent = moved, again
    found = Calibration(value, spent, _error(value, spent, tried, scale), _is_near(request, spent), tried)
    content = found._asdict() | {"field": request.field, "wanted": request.human_time, "seeds": request.seeds}
    if math.isnan(found.error):
        content["error"] = None  # JSON has no NaN
    files.write_json(request.output / FILE, content | {"versions": folder.versions()})
    return found


def _human_time(request: Request, value: float, seed: int) -> float:
    """Return the human timesteps of a run with this value."""
    metrics = resumable.complete(request.run(value, seed), checkpoint_every=request.checkpoint_every)
    spent = float(np.sum(metrics.human_steps, dtype=float))
    say(f"{request.field} = {value:.6g}, seed {seed}: {text.count(spent)} human timesteps")
    return spent


def _over_seeds(request: Request, value: float, others: list[int], tried: list[tuple[float, float]]) -> tuple[float, ...]:
    return (dict(tried)[value], *(_human_time(request, value, seed) for seed in others))


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


def _corrected(
    request: Request, value: float, spent: tuple[float, ...], tried: list[tuple[float, float]], scale: Scale
) -> float | None:
    """Return the value at which the mean over seeds should be what is wanted; None if it is, or the slope does not tell."""
    slope = _slope(value, tried, scale)
    if _is_near(request, spent) or not abs(slope) > 1e-3:
        return None
    change = (math.log1p(request.human_time) - math.log1p(float(np.mean(spent)))) / slope
    return scale.outward(scale.inward(value) + min(max(change, -1.0), 1.0))


def _error(value: float, spent: tuple[float, ...], tried: list[tuple[float, float]], scale: Scale) -> float:
    slope = _slope(value, tried, scale)
    if len(spent) < 2 or not abs(slope) > 1e-3:
        return math.nan
    scaled = float(np.std(np.log1p(spent), ddof=1)) / math.sqrt(len(spent)) / abs(slope)
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
