"""What the commands do, behind the command line: check all that was asked for, then compute, write and print."""

import argparse
import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fleetjax import envs, sharding
from fleetjax.checks import check_mesh, check_run
from fleetjax.config import Config, make_config
from fleetjax.console.controls import CONTROLS, check_people
from fleetjax.envs import get_defaults, list_envs
from fleetjax.field import FIELDS, every_field, owners_in_words
from fleetjax.io import (
    calibration,
    chunks,
    cluster,
    export,
    files,
    folder,
    formats,
    outcomes,
    parameters,
    resumable,
    sources,
    study,
    sweep,
    text,
)
from fleetjax.io.errors import Incomplete, Refusal
from fleetjax.io.parameters import IN_CONSOLE
from fleetjax.io.progress import progress, say
from fleetjax.metrics import Metrics
from fleetjax.priority import get_algorithm, list_algorithms

EVALUATED = ("successes", "violations", "hard_resets", "idle", "human_steps", "moving", "reward")


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Turn the ValueErrors of validation, and of reading files, into refusals."""
    try:
        yield
    except ValueError as error:
        raise Refusal(str(error)) from error


def run_fleet(arguments: argparse.Namespace) -> None:
    """Run a new fleet, or resume a run."""
    given = _parameters(arguments)
    if arguments.distributed:
        _run_together(arguments, given)
        return
    for name in ("coordinator", "num_processes", "process_id"):
        if getattr(arguments, name) is not None:
            raise Refusal(f"--{name.replace('_', '-')} needs --distributed; add --distributed, or omit it")
    with _refusing():
        resumable.check_interval(arguments.checkpoint_every)
        run = _run_to_resume(arguments, given) if arguments.resume else _new_run(arguments, given)
    if not arguments.resume:
        folder.check_folder(run.folder, overwrite=arguments.overwrite)
        run.folder.mkdir(parents=True, exist_ok=True)
    with files.lock(run.folder):
        begun = time.monotonic()
        with _refusing():
            run = folder.read_run(run.folder) if arguments.resume else run  # another process may have changed it meanwhile
            metrics = folder.read_finished(run) if arguments.resume else None
        if metrics:
            say(f"{run.folder} is already finished; there is nothing to resume")
        else:
            options = {"resume": bool(arguments.resume), "checkpoint_every": arguments.checkpoint_every}
            metrics = resumable.run_in_folder(run, **options)
        _report(run, metrics, f"{text.duration(time.monotonic() - begun)} in all")


def _run_together(arguments: argparse.Namespace, given: Mapping[str, Any]) -> None:
    """Run a fleet, or resume it, with all devices of several processes."""
    if arguments.resume or arguments.overwrite or arguments.log_interventions:
        raise Refusal(
            "--distributed resumes by itself and logs no interventions; omit --resume, --overwrite, --log-interventions"
        )
    if arguments.output is None:
        raise Refusal("--distributed needs --output DIR, on a file system that all processes share")
    from fleetjax.io import team, together  # imported on demand

    begun = time.monotonic()
    with _refusing():
        resumable.check_interval(arguments.checkpoint_every)
        team.check_step_timeout(arguments.step_timeout)
        team.join(team.Meeting(arguments.coordinator, arguments.num_processes, arguments.process_id, arguments.connect_timeout))
        run = _new_run(arguments, given)
        with sharding.over(team.mesh(), run.config.num_humans):
            check_mesh(run.config)
    options = {"checkpoint_every": arguments.checkpoint_every, "step_timeout": arguments.step_timeout}
    metrics = together.complete(run, **options)
    if metrics:
        _report(run, metrics, f"{text.duration(time.monotonic() - begun)} in all")


def _parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of a run that were given, by name."""
    return {name: value for name, value in vars(arguments).items() if name in every_field()}


def _new_run(arguments: argparse.Namespace, given: Mapping[str, Any]) -> folder.Run:
    """Return a new run.

    Raises:
        ValueError: if the configuration cannot be used.
    """
    config, seed = _config(arguments, given), arguments.seed or 0
    logged = arguments.command == "run" and arguments.log_interventions
    return folder.Run(arguments.output or folder.default_folder(config, seed), config, seed, logged)


def _config(arguments: argparse.Namespace, given: Mapping[str, Any]) -> Config:
    """Return the configuration that was asked for.

    Raises:
        ValueError: if it cannot be used.
    """
    if "environment" not in given:
        known = CONTROLS if arguments.command == "console" else list_envs()
        resume = ", or resume a run with --resume RUN" if arguments.command == "run" else ""
        raise ValueError(f"ENV is missing; choose one of {', '.join(known)}{resume}")
    overrides = {name: value for name, value in given.items() if name not in ("environment", "algorithm")}
    if arguments.command == "console":
        overrides = {**IN_CONSOLE, **overrides}
    config = make_config(given["environment"], given.get("algorithm", "cur"), **overrides)
    folder.check_config(config)
    check_run(config)
    return config


def _run_to_resume(arguments: argparse.Namespace, given: Mapping[str, Any]) -> folder.Run:
    """Return the run to resume.

    Raises:
        ValueError: if there is none, or other parameters were given than it has.
    """
    if arguments.output or arguments.overwrite:
        raise ValueError("--resume continues in the run's own folder; omit --output and --overwrite")
    run = folder.read_run(arguments.resume)
    if folder.RECORD in run.digests or (run.folder / folder.RECORD).exists():
        raise ValueError(f"{run.folder} was supervised by people, so it cannot be resumed; repeat it with fleetjax replay")
    if arguments.log_interventions and not run.logged:
        raise ValueError("the run does not log interventions; omit --log-interventions, or start a new run")
    seed = run.seed if arguments.seed is None else arguments.seed
    difference = folder.first_difference(run._replace(config=run.config.replace(**given), seed=seed), run)
    if difference:
        raise ValueError(f"{difference}; omit it, or start a new run")
    check_run(run.config)
    return run


def _report(run: folder.Run, metrics: Metrics, last: str) -> None:
    print(f"\n{text.headline(run.config, run.seed)}\n\n{text.run_table(metrics, run.config)}\n")
    print(f"{last}. Run folder: {run.folder}")


def run_sweep(arguments: argparse.Namespace) -> None:
    """Run every combination of several values."""
    sweep.leave_gpus_to_workers()
    with _refusing():
        subjects = [name for names in arguments.subjects for name in names]
        asked = study.make_study(subjects, vars(arguments))
        resumable.check_interval(asked.checkpoint_every)
        runs = study.plan(asked)
        sweep.check_folder(asked, runs)
        cluster.check(asked.launcher)
    sweep.run_all(asked, runs)


def calibrate_field(arguments: argparse.Namespace) -> None:
    """Find the value of a parameter at which an algorithm spends a given human time."""
    given = _parameters(arguments)
    with _refusing():
        if arguments.human_time is None:
            raise ValueError("--human-time is missing; say how many human timesteps a run should spend")
        config = _config(arguments, given)
        request = calibration.Request(
            config,
            arguments.field or calibration.default_field(config),
            arguments.human_time,
            tuple(range(arguments.first_seed, arguments.first_seed + arguments.seeds)),
            arguments.tolerance,
            arguments.most,
            arguments.output or Path("runs") / text.as_path(f"calibrate-{config.environment}-{config.algorithm}"),
            arguments.checkpoint_every,
        )
        calibration.check(request)
        if request.seeds and request.seeds[-1] > parameters.LARGEST_SEED:
            raise ValueError(
                f"--first-seed {arguments.first_seed} and --seeds {arguments.seeds} end at seed {request.seeds[-1]}, "
                f"beyond {parameters.LARGEST_SEED}; lower one"
            )
        if not calibration.has_effect(request):
            raise ValueError(
                f"field = {request.field!r} makes no difference to {config.algorithm!r}; choose another by --field"
            )
        found = calibration.calibrate(request)
    print(calibration.report(request, found))


def list_all(arguments: argparse.Namespace) -> None:
    """Show environments and algorithms."""
    del arguments
    print("environments")
    rows: list[tuple[str, ...]] = [("", "name", "observations", "actions", "horizon", "control step", "goals")]
    for name in list_envs():
        spec = envs.make(name).spec
        sizes = map(str, (spec.observation_size, spec.action_size, spec.horizon))
        rows.append(("", name, *sizes, f"{1000 * spec.control_step:.1f} ms", "yes" if spec.has_goal else "no"))
    print(text.table(rows, right=[2, 3, 4, 5]))
    for name in list_envs():
        changed = {field: value for field, value in get_defaults(name).items() if value != every_field()[field].default}
        print(f"  {name}'s own defaults: {', '.join(f'{field} {parameters.show(value)}' for field, value in changed.items())}")
    print("\nalgorithms")
    named = [name for name in list_algorithms() if not text.is_order(name) or name == "cur"]
    print(text.table([("", name, text.label(name), text.meaning(name)) for name in named]))
    for name, field in every_field().items():
        if name not in FIELDS:
            print(f"  own parameter of {owners_in_words(name)}: {name} {parameters.show(field.default)}, {field.help}")
    print(f"  and {text.ORDERS}")


def plot_runs(arguments: argparse.Namespace) -> None:
    """Draw runs in one figure."""
    from fleetjax.io import figure  # matplotlib takes a while to import

    with _refusing():
        files.check_ending(arguments.output, figure.FORMATS)
        found = sources.collect(arguments.runs)
    output = files.check_free(arguments.output, overwrite=arguments.overwrite)
    for run in found:
        if run.timesteps[-1] < run.config.num_steps:
            say(f"{run.name} was interrupted; curves with the same settings end at {run.timesteps[-1]} timesteps")
    _say_skipped(found)
    files.write(output, figure.render(figure.plot(found), arguments.output.suffix))
    print(arguments.output)


def _say_skipped(found: Sequence[outcomes.Outcome]) -> None:
    skipped = len(found) - sum(len(group.runs) for group in outcomes.group(found))
    if skipped:
        say(f"skipped {text.plural(skipped, 'run')} with the same settings and seed as a later one")


def compare_runs(arguments: argparse.Namespace) -> None:
    """Compare runs over their seeds: print or write tables, draw figures, store rows."""
    from fleetjax.io import comparing, figure, rows

    with _refusing():
        for path in arguments.output:
            files.check_ending(path, (".md", ".csv", *figure.FORMATS))
        if arguments.rows:
            files.check_ending(arguments.rows, (rows.SUFFIX,), flag="--rows")
        found = sources.collect(arguments.runs)
    outputs = [*arguments.output, *([arguments.rows] if arguments.rows else [])]
    if repeated := [path for i, path in enumerate(outputs) if path.resolve() in [other.resolve() for other in outputs[:i]]]:
        raise Refusal(f"{repeated[0]} is named twice; choose another path for one of the two")
    targets = [files.check_free(path, overwrite=arguments.overwrite) for path in outputs]
    with _refusing():
        metrics, different = arguments.metric or comparing.METRICS, arguments.allow_different
        compared = comparing.compare(found, arguments.against, metrics, allow_different=different)
    _say_skipped(found)
    if not arguments.output:
        print(compared.markdown(), end="")
    for path, target in zip(arguments.output, targets, strict=False):
        if path.suffix in figure.FORMATS:
            content = figure.render(figure.plot(found), path.suffix)
        else:
            content = (compared.csv() if path.suffix == ".csv" else compared.markdown()).encode()
        files.write(target, content)
        print(path)
    if arguments.rows:
        files.write(targets[-1], rows.write(found))
        say(f"{arguments.rows}: {text.plural(len(found), 'row')}")


def evaluate_policy(arguments: argparse.Namespace) -> None:
    """Run a trained policy without teleoperation."""
    with _refusing():
        run = folder.read_run(arguments.run)
        config = run.config.replace(num_steps=arguments.num_steps)
        check_run(config)
        if not get_algorithm(config.algorithm).pretrains:
            raise ValueError(f"algorithm = {config.algorithm!r} trains no policy, so there is nothing to evaluate")
        policy = folder.read_policy(run)
    output = files.check_free(run.folder / folder.EVALUATION, overwrite=arguments.overwrite)
    seed = (run.seed + 1) % 2**32 if arguments.seed is None else arguments.seed
    parts: list[Metrics] = []
    say(f"{text.headline(config, seed)}, nobody teleoperates: compiling ...")
    evaluation = chunks.start_evaluation(config, jax.random.key(seed), policy)
    with progress(config, with_rohe=False) as show:
        for metrics in evaluation:
            parts.append(metrics)
            show(metrics)
    metrics = chunks.join(parts)
    total = {name: np.sum(getattr(metrics, name)).item() for name in EVALUATED}
    content = {"num_steps": config.num_steps, "seed": seed, "totals": total, "versions": folder.versions()}
    print(text.evaluation_table(metrics, config), flush=True)  # the disk may have filled up meanwhile
    files.write_json(output, content)


def export_interventions(arguments: argparse.Namespace) -> None:
    """Write a run's interventions as a data set."""
    with _refusing():
        formats.check(arguments.format)
        run = folder.read_run(arguments.run)
        found = folder.read_interventions(run)
    output = arguments.output or run.folder / formats.PLACES[arguments.format]
    files.check_free(output, overwrite=arguments.overwrite, is_folder=arguments.format != "robomimic")
    with _refusing():
        export.export(found, run.config, envs.make(run.config.environment, run.config.backend).spec, output, arguments.format)
    steps = sum(map(len, found))
    say(f"{text.plural(len(found), 'intervention')}, {text.plural(steps, 'timestep')} of human actions")
    print(output)


def render_robots(arguments: argparse.Namespace) -> None:
    """Draw robots as an animation."""
    from fleetjax.io import render

    path = Path(arguments.source)
    with _refusing():
        for name, low in {"num_shown": 1, "num_steps": 1, "every": 1, "width": 1, "skip": 0}.items():
            if getattr(arguments, name) < low:
                raise ValueError(f"{name} = {getattr(arguments, name)} must be at least {low}")
        render.check_format(arguments.output)
        run = None if arguments.source in list_envs() else folder.read_run(path)
        who = arguments.policy or ("robot" if run else "expert")
        if who == "robot" and run is None:
            raise ValueError(f"--policy robot needs a run folder, but {arguments.source} is an environment")
        config = run.config if run else make_config(arguments.source, "cur")
        if who == "expert":
            shown = {"num_robots": arguments.num_shown, "num_humans": arguments.num_shown}
            config = make_config(config.environment, "expert", **shown, backend=config.backend)
        policy = folder.read_policy(run) if run and who == "robot" else None
        check_run(config)
        render.check(config)
    output = files.check_free(arguments.output, overwrite=arguments.overwrite)
    seed = arguments.seed if arguments.seed is not None else run.seed if run else 0
    key = jax.random.key(seed)
    say(f"{text.headline(config, seed)}, policy {who}: running ...")
    config = config.replace(num_steps=arguments.skip + arguments.num_steps)  # whose human data there is room for
    config, state = render.start(config, key, policy, skip=arguments.skip)
    film = render.shoot(config.replace(num_steps=arguments.num_steps), key, state, num_shown=arguments.num_shown)
    say("drawing ...")
    env = envs.make(config.environment, config.backend)
    pictures = render.draw(film, env.scene, width=arguments.width, every=arguments.every)
    rate = 1 / (env.spec.control_step * arguments.every)
    with _refusing():
        files.write(output, render.encode(pictures, arguments.output, rate=rate))
    print(arguments.output)


def supervise(arguments: argparse.Namespace) -> None:
    """Let people supervise a fleet."""
    from fleetjax.console import command

    with _refusing():
        run = _new_run(arguments, _parameters(arguments))
        if arguments.interval is None:
            arguments.interval = envs.make(run.config.environment, run.config.backend).spec.control_step
        names = ("host", "port", "token", "interval", "timeout", "wait")
        command.check(run.config, **{name: getattr(arguments, name) for name in names})
    folder.check_folder(run.folder, overwrite=arguments.overwrite)

    from fleetjax.console import server  # its libraries may be missing, which `check` tells

    options = server.Options(**{name: getattr(arguments, name) for name in names}, simulated=arguments.fill == "simulated")
    with contextlib.closing(server.listen(arguments.host, arguments.port)) as listener:
        run.folder.mkdir(parents=True, exist_ok=True)
        with files.lock(run.folder):
            metrics = command.supervise(run, options, listener)
    _report(run, metrics, f"{text.plural(len(metrics.successes), 'timestep')} recorded")


def replay(arguments: argparse.Namespace) -> None:
    """Run a console's session again from its record, and compare every bit."""
    from fleetjax.console import replaying

    with _refusing():
        run = folder.read_run(arguments.run)
        check_people(run.config)
        rows = replaying.read_record(run)
    metrics = replaying.replay(run, rows)
    compared = " and ".join(replaying.compared(run.config))
    print(f"{run.folder}: {text.plural(len(metrics.successes), 'timestep')} replayed; {compared} agree to the bit")


def fit_humans(arguments: argparse.Namespace) -> None:
    """Fit the model of imperfect humans to the people of a console's session."""
    from fleetjax.console import fitting, replaying

    with _refusing():
        run = folder.read_run(arguments.run)
        rows, usual = replaying.read_record(run), FIELDS["absence_time"].default
        found = fitting.fit(rows, fitting.people(rows), absence_time=usual)
    print(text.table(fitting.report(rows, absence_time=usual), right=range(1, 7)))
    given = (f"--{name.replace('_', '-')} {value:.3g}" for name, value in found._asdict().items())
    print(f"\nTimes are in timesteps. Humans like these:\nfleetjax run {run.config.environment} {' '.join(given)}")


def lead(arguments: argparse.Namespace) -> None:
    """Compare rules at equal human time: run those that are named, then write the table and the figure of all stored runs."""
    from fleetjax.io import leaderboard, standings

    with _refusing():
        may_be_empty = arguments.action == "add" and arguments.results.is_dir()
        if not (may_be_empty or leaderboard.is_stored(arguments.results)):
            raise ValueError(
                f"there are no stored runs in {arguments.results}; run this in a clone of the repository, or give --results DIR"
            )
        entries = []
        if arguments.action == "add":
            asked = (arguments.environments, arguments.budgets, arguments.seeds, arguments.output)
            entries = leaderboard.entries(arguments.algorithms, *asked)
        with files.lock(arguments.results):
            if arguments.action == "remove":
                leaderboard.remove(arguments.results, arguments.algorithms)
                say("their run folders remain: before you add a changed rule, delete them or choose another --output")
            store = leaderboard.Store(arguments.results)
            failed = leaderboard.compete(store, entries)
            page = standings.publish(store)
            print(page if store.runs else "no stored runs are left")
    if failed:
        raise Incomplete(f"{len(failed)} of {len(entries)} failed: {'; '.join(failed)}")


COMMANDS: Mapping[str, Callable[[argparse.Namespace], None]] = {
    "run": run_fleet,
    "sweep": run_sweep,
    "calibrate": calibrate_field,
    "list": list_all,
    "plot": plot_runs,
    "compare": compare_runs,
    "evaluate": evaluate_policy,
    "export": export_interventions,
    "render": render_robots,
    "console": supervise,
    "replay": replay,
    "humans": fit_humans,
    "leaderboard": lead,
}
