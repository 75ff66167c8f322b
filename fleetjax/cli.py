"""The command line: `fleetjax run`, `list`, `plot`, `evaluate`, `export`, `render`, `console` and `replay`.

What cannot be used is refused with one line on stderr and exit code 2, before anything is computed.
"""

import argparse
import contextlib
import io
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fleetjax import envs
from fleetjax.checks import check_run
from fleetjax.config import every_field, make_config
from fleetjax.console.controls import CONTROLS
from fleetjax.console.replaying import Disagreement
from fleetjax.envs import get_defaults, list_envs
from fleetjax.io import execution, export, files, flags, folder, operation, text
from fleetjax.io.flags import Refusal
from fleetjax.io.progress import progress, say
from fleetjax.metrics import Metrics
from fleetjax.priority import get_algorithm, list_algorithms

INTERRUPTED = 130  # what shells report for a process that SIGINT ended


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments; None takes the process's, which Ctrl-C then ends at once.

    Returns:
        int: exit code: 0, 1 for a run that diverged or a replay that differs, 2 for input that cannot be used, 130 after
            Ctrl-C.
    """
    commands = {
        "run": _run,
        "list": _list,
        "plot": _plot,
        "evaluate": _evaluate,
        "export": _export,
        "render": _render,
        "console": _console,
        "replay": _replay,
    }
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a name may hold characters that its encoding lacks
    try:
        arguments = flags.parse(sys.argv[1:] if argv is None else argv)
        commands[arguments.command](arguments)
    except (Refusal, operation.Unusable, OSError) as error:
        say(f"fleetjax: {files.one_line(error)}")
        return 2
    except (operation.Diverged, Disagreement) as error:
        say(f"fleetjax: {error}")
        return 1
    except KeyboardInterrupt as interrupt:
        say(" ".join(["fleetjax: interrupted", *interrupt.args]))
        if argv is None:  # a computation that still runs would hold the process until it ends
            sys.stdout.flush()
            os._exit(INTERRUPTED)
        return INTERRUPTED
    return 0


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Turn the ValueErrors of validation, and of reading files, into refusals."""
    try:
        yield
    except ValueError as error:
        raise Refusal(str(error)) from error


def _run(arguments: argparse.Namespace) -> None:
    overrides = {name: value for name, value in vars(arguments).items() if name in every_field()}
    with _refusing():
        if arguments.checkpoint_every < 0 or arguments.checkpoint_every == 1:
            raise ValueError(f"checkpoint_every = {arguments.checkpoint_every} must be 0 (none) or at least 2 timesteps")
        run = _to_resume(arguments, overrides) if arguments.resume else _to_begin(arguments, overrides)
    if not arguments.resume:
        folder.check_folder(run.folder, overwrite=arguments.overwrite)
        run.folder.mkdir(parents=True, exist_ok=True)
    with files.lock(run.folder):
        _run_in(run, resume=bool(arguments.resume), checkpoint_every=arguments.checkpoint_every)


def _to_begin(arguments: argparse.Namespace, given: Mapping[str, Any]) -> folder.Run:
    """Return a new run.

    Raises:
        ValueError: if the configuration cannot be used.
    """
    if "environment" not in given:
        known = CONTROLS if arguments.command == "console" else list_envs()
        resume = ", or resume a run with --resume RUN" if arguments.command == "run" else ""
        raise ValueError(f"ENV is missing; choose one of {', '.join(known)}{resume}")
    overrides = {name: value for name, value in given.items() if name not in ("environment", "algorithm")}
    config, seed = make_config(given["environment"], given.get("algorithm", "cur"), **overrides), arguments.seed or 0
    check_run(config)
    return folder.Run(arguments.output or folder.default_folder(config, seed), config, seed, arguments.log_interventions)


def _to_resume(arguments: argparse.Namespace, given: Mapping[str, Any]) -> folder.Run:
    """Return the run to go on with.

    Raises:
        ValueError: if there is none, or other parameters were given than it has.
    """
    if arguments.output or arguments.overwrite:
        raise ValueError("--resume goes on in the run's own folder; leave out --output and --overwrite")
    run = folder.read_run(arguments.resume)
    if folder.RECORD in run.digests or (run.folder / folder.RECORD).exists():
        raise ValueError(
            f"{run.folder} was supervised by people, who are not there any more; only `fleetjax replay` repeats it"
        )
    if arguments.log_interventions and not run.logged:
        raise ValueError("the run does not log interventions; leave out --log-interventions, or begin another run")
    has = folder.to_plain(run.config) | {"seed": run.seed}
    asked = folder.to_plain(run.config.replace(**given)) | {"seed": run.seed if arguments.seed is None else arguments.seed}
    for name, value in asked.items():
        if value != has[name]:
            raise ValueError(f"{name} = {value} is not the run's, which is {has[name]}; leave it out, or begin another run")
    return run


def _run_in(run: folder.Run, *, resume: bool, checkpoint_every: int) -> None:
    """Run in a folder that is locked."""
    begun = time.monotonic()
    with _refusing():
        metrics = folder.read_finished(run) if resume else None
    if metrics:
        say(f"{run.folder} is finished; there is nothing to go on with")
    else:
        metrics = operation.operate(run, resume=resume, checkpoint_every=checkpoint_every, save=_save)
    _report(run, metrics, f"{text.duration(time.monotonic() - begun)} in all")


def _report(run: folder.Run, metrics: Metrics, last: str) -> None:
    print(f"\n{text.headline(run.config, run.seed)}\n\n{text.run_table(metrics, run.config)}\n")
    print(f"{last}. Run folder: {run.folder}")


def _save(run: folder.Run, metrics: Metrics) -> None:
    from fleetjax.io import figure  # matplotlib takes a while to import

    drawn = figure.draw(figure.group([(run.config, run.seed, metrics)]), text.headline(run.config, run.seed))
    files.write(run.folder / folder.FIGURE, figure.render(drawn))
    folder.write_config(run, sealed=True)


def _list(arguments: argparse.Namespace) -> None:
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
        print(f"  {name}'s own defaults: {', '.join(f'{field} {flags.show(value)}' for field, value in changed.items())}")
    print("\nalgorithms")
    named = [name for name in list_algorithms() if not text.is_order(name) or name == "cur"]
    print(text.table([("", name, text.label(name), text.meaning(name)) for name in named]))
    for name in list_algorithms():
        for own, field in get_algorithm(name).parameters.items():
            print(f"  {name}'s own parameter: {own} {flags.show(field.default)}, {field.help}")
    print(f"  and {text.ORDERS}")


def _plot(arguments: argparse.Namespace) -> None:
    from fleetjax.io import figure

    with _refusing():
        figure.check_format(arguments.output)
        runs = [folder.read_run(path) for path in arguments.runs]
        data = [(run.config, run.seed, folder.read_metrics(run)) for run in runs]
    output = folder.check_free(arguments.output, overwrite=arguments.overwrite)
    groups = figure.group(data)
    for run, (_, _, metrics) in zip(runs, data, strict=True):
        if len(metrics.successes) < run.config.num_steps:
            say(f"{run.folder} was interrupted; the curves of its kind end at {len(metrics.successes)} timesteps")
    left_out = len(data) - sum(len(curves.values) for curves in groups)
    if left_out:
        say(f"{text.plural(left_out, 'run')} left out: same settings and seed as a later one")
    drawn = figure.draw(groups)
    files.write(output, figure.render(drawn, arguments.output.suffix))
    print(arguments.output)


def _evaluate(arguments: argparse.Namespace) -> None:
    with _refusing():
        run = folder.read_run(arguments.run)
        config = run.config.replace(num_steps=arguments.num_steps)
        check_run(config)
        if not get_algorithm(config.algorithm).pretrains:
            raise ValueError(f"algorithm = {config.algorithm!r} trains no policy that could be evaluated")
        learner = folder.read_policy(run)
    output = folder.check_free(run.folder / folder.EVALUATION, overwrite=arguments.overwrite)
    seed = (run.seed + 1) % 2**32 if arguments.seed is None else arguments.seed
    chunks: list[Metrics] = []
    say(f"{text.headline(config, seed)}, nobody teleoperates: compiling ...")
    evaluation = execution.start_evaluation(config, jax.random.key(seed), learner)
    with progress(config, with_rohe=False) as show:
        for metrics in evaluation:
            chunks.append(metrics)
            show(metrics)
    metrics = execution.join(chunks)
    total = {name: np.sum(getattr(metrics, name)).item() for name in _EVALUATED}
    content = {"num_steps": config.num_steps, "seed": seed, "totals": total, "versions": folder.versions()}
    print(text.evaluation_table(metrics, config), flush=True)  # the disk may have filled up meanwhile
    files.write_json(output, content)


def _export(arguments: argparse.Namespace) -> None:
    with _refusing():
        export.check(arguments.format)
        run = folder.read_run(arguments.run)
        found = folder.read_interventions(run)
    name = "robomimic.hdf5" if arguments.format == "robomimic" else arguments.format
    output = arguments.output or run.folder / name
    folder.check_free(output, overwrite=arguments.overwrite, is_folder=arguments.format != "robomimic")
    with _refusing():
        export.export(found, run.config, envs.make(run.config.environment, run.config.backend).spec, output, arguments.format)
    steps = sum(map(len, found))
    say(f"{text.plural(len(found), 'intervention')}, {text.plural(steps, 'timestep')} of human actions")
    print(output)


def _render(arguments: argparse.Namespace) -> None:
    from fleetjax.io import render

    path = Path(arguments.source)
    with _refusing():
        for name, low in {"num_shown": 1, "num_steps": 1, "every": 1, "width": 1, "skip": 0}.items():
            if getattr(arguments, name) < low:
                raise ValueError(f"{name} = {getattr(arguments, name)} must be at least {low}")
        render.check_format(arguments.output)
        run = None if arguments.source in list_envs() else folder.read_run(path)
        policy = arguments.policy or ("robot" if run else "expert")
        if policy == "robot" and run is None:
            raise ValueError(f"--policy robot needs a run folder, and {arguments.source} is an environment")
        config = run.config if run else make_config(arguments.source, "cur")
        if policy == "expert":
            shown = {"num_robots": arguments.num_shown, "num_humans": arguments.num_shown}
            config = make_config(config.environment, "expert", **shown, backend=config.backend)
        learner = folder.read_policy(run) if run and policy == "robot" else None
        render.check(config)
    output = folder.check_free(arguments.output, overwrite=arguments.overwrite)
    seed = arguments.seed if arguments.seed is not None else run.seed if run else 0
    key = jax.random.key(seed)
    say(f"{text.headline(config, seed)}, policy {policy}: running ...")
    config = config.replace(num_steps=arguments.skip + arguments.num_steps)  # whose human data there is room for
    config, state = render.start(config, key, learner, skip=arguments.skip)
    film = render.shoot(config.replace(num_steps=arguments.num_steps), key, state, num_shown=arguments.num_shown)
    say("drawing ...")
    env = envs.make(config.environment, config.backend)
    pictures = render.draw(film, env.scene, width=arguments.width, every=arguments.every)
    rate = 1 / (env.spec.control_step * arguments.every)
    with _refusing():
        files.write(output, render.encode(pictures, arguments.output, rate=rate))
    print(arguments.output)


def _console(arguments: argparse.Namespace) -> None:
    from fleetjax.console import command

    given = {name: value for name, value in vars(arguments).items() if name in every_field()}
    with _refusing():
        arguments.seed = 0 if arguments.seed is None else arguments.seed
        run = _to_begin(argparse.Namespace(**vars(arguments), log_interventions=False), given)
        if arguments.interval is None:
            arguments.interval = envs.make(run.config.environment, run.config.backend).spec.control_step
        names = ("host", "port", "token", "interval", "timeout", "wait")
        command.check(run.config, **{name: getattr(arguments, name) for name in names})
    folder.check_folder(run.folder, overwrite=arguments.overwrite)

    from fleetjax.console import server

    options = server.Options(**{name: getattr(arguments, name) for name in names}, simulated=arguments.fill == "simulated")
    with contextlib.closing(server.listen(arguments.host, arguments.port)) as listener:
        run.folder.mkdir(parents=True, exist_ok=True)
        with files.lock(run.folder):
            metrics = command.supervise(run, options, listener, _save)
    _report(run, metrics, f"{text.plural(len(metrics.successes), 'timestep')} recorded")


def _replay(arguments: argparse.Namespace) -> None:
    from fleetjax.console import replaying

    with _refusing():
        run = folder.read_run(arguments.run)
        rows = replaying.read_record(run)
    metrics = replaying.replay(run, rows)
    compared = " and ".join(replaying.compared(run.config))
    print(f"{run.folder}: {text.plural(len(metrics.successes), 'timestep')} replayed; {compared} agree to the bit")


_EVALUATED = ("successes", "violations", "hard_resets", "idle", "human_steps", "moving", "reward")
