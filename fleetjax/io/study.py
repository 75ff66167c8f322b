"""Which runs a sweep has: every combination of lists of values, as they are typed or stand in a file.

A sweep has one or more blocks. A block holds a list of values for each of its names, and its runs are their product.
"""

import collections
import contextlib
import itertools
import tomllib
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from fleetjax.checks import check_plan
from fleetjax.config import Config, all_fields, make_config
from fleetjax.envs import list_envs
from fleetjax.field import every_field, owners
from fleetjax.io import folder, plain, text
from fleetjax.io.files import expect
from fleetjax.io.flags import LAUNCHERS
from fleetjax.io.parameters import LARGEST_SEED
from fleetjax.priority import get_algorithm
from fleetjax.registry import unknown

Block = Mapping[str, list[Any]]
Group = tuple[folder.Run, ...]  # completed together by one process
_MOST_SEEDS = 100_000
_LONGEST_LIST = 10  # values of one parameter that a folder's name spells out
_LEASE = 180  # seconds; NFS shows others' files with up to 60 s delay
_MINUTES = 24 * 60  # of a job
_SHORTEST = 15  # minutes; of which the scheduler's warning takes the last ones
_OF_LAUNCHER: Mapping[str, type] = {
    "jobs": int,
    "lease": int,
    "slurm_gpu": bool,
    "slurm_partition": str,
    "slurm_time": int,
}
_OPTIONS: Mapping[str, type] = {
    "output": str,
    "workers": int,
    "checkpoint_every": int,
    "log_interventions": bool,
    "seeds_per_program": int,
    "launcher": str,
    **_OF_LAUNCHER,
}
_SUFFIX = ".toml"


class Launcher(NamedTuple):
    """Who starts the processes of a sweep that are not its own.

    Attributes:
        kind: "local": this machine; "slurm": the cluster's scheduler.
        jobs: number of processes, each with one core and, where there are GPUs, one of them.
        lease: seconds without a sign of life after which another job takes over a job's run.
        partition: of the cluster; "" = its default.
        minutes: that a job may take before the scheduler stops and requeues it.
        gpu: whether to ask the cluster's scheduler for a GPU for each job.
    """

    kind: str
    jobs: int
    lease: int
    partition: str
    minutes: int
    gpu: bool


class Study(NamedTuple):
    """What a sweep is.

    Attributes:
        blocks: of each part the values by name; the part's runs are their product.
        output: folder for the run folders.
        workers: processes at once; None = one for each GPU, or else for each core.
        checkpoint_every: timesteps between the checkpoints of a run; 0 = none.
        logged: whether interventions are logged.
        launcher: who starts jobs; None = the sweep has processes of its own.
        seeds_per_program: runs that differ in nothing but their seed and are computed side by side, see `groups`.
    """

    blocks: tuple[Block, ...]
    output: Path
    workers: int | None
    checkpoint_every: int
    logged: bool
    launcher: Launcher | None = None
    seeds_per_program: int = 1


def make_study(subjects: Sequence[str], given: Mapping[str, Any]) -> Study:
    """Return the sweep that was asked for.

    Args:
        subjects: environments, or a file.
        given: flags by name; parameters have lists. They override the file.

    Raises:
        ValueError: if it cannot be used.
    """
    paths = [Path(subject) for subject in subjects if subject.endswith(_SUFFIX)]
    environments = [subject for subject in subjects if not subject.endswith(_SUFFIX)]
    expect(len(paths) < 2, f"{' and '.join(map(str, paths))} are two files; a sweep has one")
    options, top, parts = _read(paths[0]) if paths else ({}, {}, [{}])
    flags = _block({**given, **({"environment": environments} if environments else {})})
    blocks = tuple({**top, **part, **flags} for part in parts)
    for block in blocks:
        expect("environment" in block, f"ENV is missing; choose from {', '.join(list_envs())}, or name a {_SUFFIX} file")
    options |= {name: given[name] for name in _OPTIONS if name in given}
    expect("output" in options, "--output is missing; name a folder for the runs")
    workers = options.get("workers")
    expect(workers is None or workers >= 1, f"workers = {workers} must be at least 1")
    blocks = tuple({"algorithm": ["cur"], "seed": [0], **block} for block in blocks)
    side_by_side = options.get("seeds_per_program", 1)
    expect(side_by_side >= 1, f"seeds_per_program = {side_by_side} must be at least 1")
    for block in blocks:
        seeds = len(block["seed"])
        expect(side_by_side <= seeds, f"seeds_per_program = {side_by_side} is more than the number of seeds, {seeds}")
    if side_by_side > 1 and options.get("checkpoint_every"):
        raise ValueError(
            f"checkpoint_every = {options['checkpoint_every']} has no effect with seeds_per_program = {side_by_side}: "
            "runs side by side write no checkpoints; omit one"
        )
    return Study(
        blocks,
        Path(options["output"]),
        workers,
        options.get("checkpoint_every", 1000),
        options.get("log_interventions", False),
        _launcher(options),
        side_by_side,
    )


def _launcher(options: Mapping[str, Any]) -> Launcher | None:
    """Return who starts the processes.

    Raises:
        ValueError: if the options contradict each other.
    """
    kind = options.get("launcher")
    if kind is None:
        for name in _OF_LAUNCHER:
            expect(name not in options, f"{name} is an option of a launcher; add launcher = 'slurm', or omit it")
        return None
    expect(kind in LAUNCHERS, unknown("launcher", kind, LAUNCHERS))
    expect("workers" not in options, "workers are processes of this machine; with a launcher, give jobs instead")
    for name in ("slurm_gpu", "slurm_partition", "slurm_time"):
        expect(kind == "slurm" or name not in options, f"{name} is an option of launcher = 'slurm'; omit it")
    found = Launcher(
        kind,
        jobs=options.get("jobs", 1),
        lease=options.get("lease", _LEASE),
        partition=options.get("slurm_partition", ""),
        minutes=options.get("slurm_time", _MINUTES),
        gpu=options.get("slurm_gpu", False),
    )
    expect(found.jobs >= 1, f"jobs = {found.jobs} must be at least 1")
    expect(found.lease >= 1, f"lease = {found.lease} must be at least 1 second")
    expect(found.minutes >= _SHORTEST, f"slurm_time = {found.minutes} must be at least {_SHORTEST} minutes")
    return found


def to_plain(study: Study) -> dict[str, Any]:
    """Return what another process needs to know of a sweep, as plain data."""
    blocks, output = [dict(block) for block in study.blocks], str(study.output.absolute())
    return study._asdict() | {"blocks": blocks, "output": output, "launcher": None}


def from_plain(fields: Mapping[str, Any]) -> Study:
    """Return the sweep that `to_plain` described."""
    return Study(**{**fields, "output": Path(fields["output"]), "blocks": tuple(fields["blocks"])})


def _read(path: Path) -> tuple[dict[str, Any], Block, list[Block]]:
    """Return what a file holds: options, and the values at its top and in each of its `[[runs]]`.

    Raises:
        ValueError: if it cannot be used.
    """
    try:
        content = {name.replace("-", "_"): value for name, value in tomllib.loads(path.read_text()).items()}
        parts = content.pop("runs", [{}])
        expect(isinstance(parts, list) and all(isinstance(part, dict) for part in parts), "runs must be [[runs]] blocks")
        for part in (content, *parts):
            for name in _as_list("algorithm", part.get("algorithm", [])):
                if ":" in str(name):
                    get_algorithm(name)  # its parameters may be in the file, too
        options = {name: content.pop(name) for name in _OPTIONS if name in content}
        for name, value in options.items():
            expect(type(value) is _OPTIONS[name], f"{name} = {value!r} must be of type {_OPTIONS[name].__name__}")
        return options, _checked(content), [_checked(part) for part in parts]
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist") from None
    except ValueError as error:
        raise ValueError(f"{path} cannot be used: {error}") from None


def _checked(values: Mapping[str, Any]) -> Block:
    """Return a block of a file.

    Raises:
        ValueError: if a name is unknown, or as `_block` does.
    """
    values = {name.replace("-", "_"): value for name, value in values.items()}
    known = {*every_field(), "seed", "seeds"}
    for name in values:
        expect(name in known, unknown("parameter", name, known))
    return _block(values)


def _block(values: Mapping[str, Any]) -> Block:
    """Return the parameters and seeds among values, each as a list; one value stands for a list of it.

    Raises:
        ValueError: if a list is empty or has a value twice, or a seed is no seed.
    """
    lists = {name: _as_list(name, value) for name, value in values.items() if name in every_field()}
    expect(not {"seed", "seeds"} <= values.keys(), "seed and seeds contradict each other; omit one")
    if "seeds" in values:
        number = values["seeds"]
        sound = type(number) is int and 1 <= number <= _MOST_SEEDS
        expect(sound, f"seeds = {number!r} must be a whole number from 1 to {_MOST_SEEDS}")
        lists["seed"] = list(range(number))
    if "seed" in values:
        lists["seed"] = values["seed"] if isinstance(values["seed"], list) else [values["seed"]]
        sound = all(type(seed) is int and 0 <= seed <= LARGEST_SEED for seed in lists["seed"])
        expect(sound, f"seed = {values['seed']!r} must hold whole numbers from 0 to {LARGEST_SEED}")
    for name, found in lists.items():
        expect(bool(found), f"{name} = [] is empty; give at least one value")
        twice = next((value for i, value in enumerate(found) if value in found[:i]), None)
        expect(twice is None, f"{name} lists {twice!r} twice; omit one")
    return lists


def _as_list(name: str, value: Any) -> list[Any]:
    if every_field()[name].kind is tuple and isinstance(value, list) and not any(isinstance(x, (list, tuple)) for x in value):
        return [value] if value else []  # one tuple
    return value if isinstance(value, list) else [value]


class _Planned(NamedTuple):
    """A run without a folder, and the parameters that its block gives it."""

    config: Config
    seed: int
    given: frozenset[str]


def plan(study: Study) -> list[folder.Run]:
    """Return what `combine` does, after a check that all of it can run here. The check traces each program.

    Raises:
        ValueError: as `combine`, and if a combination cannot be run.
    """
    runs = combine(study)
    for run in {program((run,)): run for run in reversed(runs)}.values():
        with _naming(run.folder.name):
            folder.check_config(run.config)
            check_plan(run.config, copies=study.seeds_per_program)
    return runs


def combine(study: Study) -> list[folder.Run]:
    """Return the runs of a sweep, with their folders.

    Raises:
        ValueError: if a combination is not valid, two are the same, or a parameter belongs to no algorithm of the sweep.
    """
    _check_used(study.blocks)
    planned = [run for block in study.blocks for run in _product(block)]
    varied = _varied(study.blocks)
    runs = [folder.Run(study.output / _name(run, varied), run.config, run.seed, study.logged) for run in planned]
    identities = [folder.name_of(run) for run in runs]
    for same in (identities, [str(run.folder) for run in runs]):
        twice = collections.Counter(same).most_common(1)[0]
        expect(twice[1] == 1, f"{runs[same.index(twice[0])].folder.name} is in the sweep twice; omit one")
    return runs


def groups(runs: Sequence[folder.Run], size: int) -> list[Group]:
    """Return the runs of a sweep in groups of at most `size`, of runs that differ in nothing but their seed.

    A group depends on the sweep alone, not on what is finished: with other runs beside it, a run rounds differently.
    """
    alike: dict[str, list[folder.Run]] = {}
    for run in runs:
        alike.setdefault(repr(plain.to_plain(run.config)), []).append(run)
    return [tuple(same[i : i + size]) for same in alike.values() for i in range(0, len(same), size)]


def program(group: Group) -> Any:
    """Return what is equal for groups that share a compiled program: their size, and what is static in their configuration."""
    return len(group), jax.tree.structure(group[0].config)


def _check_used(blocks: Sequence[Block]) -> None:
    """Check that each parameter is one of an algorithm of the sweep.

    Raises:
        ValueError: if it is not, or an algorithm is unknown.
    """
    known = {"seed"}.union(*(all_fields(algorithm) for block in blocks for algorithm in block["algorithm"]))
    for name in itertools.chain(*blocks):
        have = " or ".join(map(repr, owners(name)))
        expect(name in known, f"{name} is a parameter of algorithm = {have}; omit it, or add that algorithm to the sweep")


def _product(block: Block) -> Iterator[_Planned]:
    """Yield the runs of a block. An algorithm's own parameters do not multiply the runs of others.

    Raises:
        ValueError: if a combination cannot be run; the message names it.
    """
    for environment, algorithm in itertools.product(block["environment"], block["algorithm"]):
        own = [name for name in block if name in all_fields(algorithm) and name not in ("environment", "algorithm")]
        for values in itertools.product(*(block[name] for name in own)):
            chosen = dict(zip(own, values, strict=True))
            several = [f"{name} {chosen[name]}" for name in own if len(block[name]) > 1]
            with _naming(", ".join([str(environment), algorithm, *several])):
                config = make_config(environment, algorithm, **chosen)
            for seed in block["seed"]:
                yield _Planned(config, seed, frozenset(own))


@contextlib.contextmanager
def _naming(combination: str) -> Iterator[None]:
    """Name the combination in the ValueError for one that cannot be run."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{combination}: {error}") from None


def _varied(blocks: Sequence[Block]) -> list[str]:
    """Return the parameters that tell runs apart: of which a block has several values, or another value than others."""
    names = [name for name in every_field() if name not in ("environment", "algorithm")]
    return [name for name in names if any(len(b.get(name, [])) > 1 or b.get(name) != blocks[0].get(name) for b in blocks)]


def _name(run: _Planned, varied: Sequence[str]) -> str:
    """Return the name of a run's folder: `navigation-cur-num_humans=5-seed0`."""
    values = plain.to_plain(run.config)
    parts = [f"{name}={_written(values[name])}" for name in varied if name in run.given]
    return text.as_path("-".join([run.config.environment, run.config.algorithm, *parts, f"seed{run.seed}"]))


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if not isinstance(value, list):
        return str(value)
    if len(value) > _LONGEST_LIST:  # names of folders have limits
        return f"{len(value)}_values_{zlib.crc32(repr(value).encode()):08x}"
    return "x".join(map(str, value))
