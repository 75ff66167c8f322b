"""What can be typed: commands and their flags. Nothing here loads JAX, so that help comes at once."""

import argparse
import difflib
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from fleetjax.environments import list_envs
from fleetjax.io.errors import Refusal
from fleetjax.io.formats import FORMATS
from fleetjax.io.lists import listed
from fleetjax.io.parameters import IN_CONSOLE, add_parameters, integer, number, seed
from fleetjax.registry import unknown
from fleetjax.version import VERSION

LAUNCHERS = ("local", "slurm")
_RUNS = "run folder, folder that holds run folders, or file that `fleetjax compare --rows` wrote"
PORT = 8765  # that a console serves
_ABOUT = """\
Interactive fleet learning: N robots, M humans. Who should get help, and what does the fleet gain?

  fleetjax run navigation               100 point robots, a minute or two
  fleetjax run humanoid                 the paper's main experiment, C.U.R. with 100 humanoids
  fleetjax run humanoid --help          every parameter, with its meaning, unit and default
  fleetjax sweep navigation --seeds 5 --output DIR   many runs, in parallel
  fleetjax calibrate navigation --human-time 10000   the threshold at which C.U.R. spends 10,000 human timesteps
  fleetjax plot runs/humanoid-*         runs in one figure; seeds become a mean and a band
  fleetjax compare runs --against cur   tables of runs: means, intervals, differences
  fleetjax evaluate RUN                 the trained policy on its own; nobody teleoperates
  fleetjax console navigation --humans 2   real people supervise, in their browsers"""
_RUN_ABOUT = """\
Pre-train the policy on demonstrations, then run the fleet while it learns from its humans. Prints a table at the end and writes
a run folder: config.json, metrics.csv (one row per timestep), figure.png, policy.msgpack and the last two checkpoints."""
_SWEEP_ABOUT = """\
Run every combination of several values in parallel, each in a run folder of its own below DIR. The same command resumes a sweep
that was stopped, and a larger one extends it.

Every parameter takes a list: --algorithm cur,random --num-humans 5,10 --hidden-sizes 64 64,256 256. A parameter of one
algorithm is given to that algorithm alone. A FILE holds the same names with lists, in TOML; flags override it."""
_CALIBRATE_ABOUT = """\
Find the value of a parameter at which an algorithm spends a given human time, by a few runs with the first seed. Then go on
from there with the mean over all seeds. Thresholds do not carry over between robots, policies or sizes of a run. The runs are
kept below DIR, so the same command resumes; repeated when it is finished, it prints the result at once."""
_RUN_NOTE = """\
Some algorithms change defaults: expert has as many humans as robots; constraint gets as many extra demonstrations as C.U.R.
uses human timesteps (none for environments that are not part of fleetjax); constraint_trained also takes as many gradient steps
before the start as the others take in total."""


class _Parser(argparse.ArgumentParser):
    """Refuses in one line, with the closest flag, where argparse would print its usage."""

    def __init__(self, **options: Any):
        layout = functools.partial(argparse.RawDescriptionHelpFormatter, max_help_position=30)
        super().__init__(allow_abbrev=False, formatter_class=layout, **options)

    def error(self, message: str) -> NoReturn:
        raise Refusal(message)

    def parse_known_args(self, args=None, namespace=None):  # pyright: ignore[reportIncompatibleMethodOverride]
        namespace, extra = super().parse_known_args(args, namespace)
        if extra:
            self.error(self._stray(extra))
        return namespace, extra

    def _stray(self, extra: Sequence[str]) -> str:
        flags = [word for word in extra if word.startswith("-")]
        if not flags:
            return f"unexpected argument {extra[0]!r}; see {self.prog} --help"
        flag = flags[0].split("=")[0]
        close = difflib.get_close_matches(flag, list(self._option_string_actions), n=1, cutoff=0.0)
        return f"unknown flag {flag}; the closest is {close[0]}"


_COMPARE_ABOUT = """Compare runs over their seeds. Runs that differ in nothing but their seed are one group. Prints a table for
each environment and metric: means with 95 % intervals, interquartile means and human time, and with --against how each
group differs from one. docs/comparing.md explains the numbers."""
_EXPORT_ABOUT = """Write what teleoperating humans saw and did as a data set for other tools, one episode per intervention. The
run must have been made with --log-interventions."""
_RENDER_ABOUT = """Draw robots as an animation, a grid of tiles. Teleoperated robots are tinted blue, robots in violation red.

expert: the supervisor acts on every robot. robot: the trained policy of a run acts, and nobody teleoperates. mixed: the
pre-trained fleet runs, and its humans help."""
_LEADERBOARD_ABOUT = """Compare rules for help at equal human time. The stored runs are in the repository: start this in a clone
of it, or name their folder with --results.

add: for each budget, find the threshold at which RULE spends it, run the rule, and store its runs. If add is interrupted,
repeat the command. remove: forget what is stored of a rule, as after a change of its code; then add it
again with another --output. Each of them ends as show does."""
_HUMANS_ABOUT = """Print how long people took to act on robots in a console session, how much longer if they came from another
robot, and how often they were away: a table by seat, and the flags of `fleetjax run` that fit all of them together. Noise,
mistakes and delays are not fitted."""
_EVALUATE_ABOUT = """Run the trained policy of a run without teleoperation: humans only reset robots in violation, and nothing
is learnt. Prints a table and writes RUN/evaluation.json."""
_CONSOLE_ABOUT = """Run a fleet one timestep at a time, with people as supervisors: each opens a page, gets a seat, and helps
the robot that the algorithm allocates. Ends with a table and a run folder as `fleetjax run` does, and a record of what people
did, so that `fleetjax replay` can repeat the run."""


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Return the arguments; fields of `Config` are there only if they were given.

    Raises:
        Refusal: if they cannot be used.
        SystemExit: with code 0, after help or version.
    """
    environment = next((word for word in argv[1:] if word in list_envs()), None)
    _import_algorithms(argv)
    parser, commands = make_parser(environment)
    if argv and not argv[0].startswith("-") and argv[0] not in commands:
        raise Refusal(unknown("command", argv[0], commands))
    return parser.parse_args(argv or ["--help"])


def _import_algorithms(argv: Sequence[str]) -> None:
    """Import algorithms such as `my_rules:mine`, whose parameters have flags, too.

    Raises:
        Refusal: if a module cannot be imported.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--algorithm", action="append", nargs="?", default=[])
    given = ",".join(filter(None, early.parse_known_args(argv)[0].algorithm))
    named = [name.strip() for name in given.split(",") if ":" in name]
    if not named:
        return
    from fleetjax.priority import get_algorithm  # on demand: it loads JAX

    try:
        for name in named:
            get_algorithm(name)
    except ValueError as error:
        raise Refusal(str(error)) from None


def make_parser(environment: str | None = None) -> tuple[argparse.ArgumentParser, list[str]]:
    """Return the parser and the names of the commands; defaults shown are those of `environment`, if given."""
    parser = _Parser(prog="fleetjax", description=_ABOUT)
    parser.add_argument("--version", action="version", version=f"fleetjax {VERSION}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    _add_run(commands, environment)
    _add_sweep(commands, environment)
    _add_calibrate(commands, environment)
    commands.add_parser("list", help="show environments and algorithms")

    plot = commands.add_parser("plot", help="draw runs in one figure; seeds become a mean and a band")
    plot.add_argument("runs", metavar="RUN", nargs="+", type=Path, help=_RUNS)
    plot.add_argument(
        "--output", metavar="FILE", type=Path, default=Path("fleetjax.png"), help="png, pdf or svg [default: fleetjax.png]"
    )
    plot.add_argument("--overwrite", action="store_true", help="replace an existing file")

    _add_compare(commands)
    evaluate = commands.add_parser("evaluate", help="run a trained policy without teleoperation", description=_EVALUATE_ABOUT)
    evaluate.add_argument("run", metavar="RUN", type=Path, help="run folder")
    evaluate.add_argument("--num-steps", metavar="N", type=integer, default=10_000, help="timesteps [default: 10000]")
    evaluate.add_argument("--seed", metavar="N", type=seed, help="random seed [default: the run's, plus 1]")
    evaluate.add_argument("--overwrite", action="store_true", help="replace an older evaluation.json in the run folder")

    export = commands.add_parser("export", help="write a run's interventions as a data set", description=_EXPORT_ABOUT)
    export.add_argument("run", metavar="RUN", type=Path, help="run folder")
    export.add_argument("--format", choices=FORMATS, required=True, help="format of the data set")
    export.add_argument(
        "--output",
        metavar="PATH",
        type=Path,
        help="folder, or .hdf5 file for robomimic [default: RUN/FORMAT or RUN/robomimic.hdf5]",
    )
    export.add_argument("--overwrite", action="store_true", help="replace an older export of the same format")

    render = commands.add_parser("render", help="draw robots as an animation", description=_RENDER_ABOUT)
    render.add_argument("source", metavar="RUN|ENV", help="run folder, or environment")
    policies = ("expert", "robot", "mixed")
    render.add_argument("--policy", choices=policies, help="who acts [default: robot for a run, expert for an environment]")
    render.add_argument("--num-shown", metavar="N", type=integer, default=4, help="robots in the picture [default: 4]")
    render.add_argument("--num-steps", metavar="N", type=integer, default=200, help="timesteps to draw [default: 200]")
    render.add_argument(
        "--skip", metavar="N", type=integer, default=0, help="timesteps to run before the first picture [default: 0]"
    )
    render.add_argument("--every", metavar="N", type=integer, default=2, help="timesteps per picture [default: 2]")
    render.add_argument(
        "--width", metavar="N", type=integer, default=320, help="width of a robot's tile (pixels) [default: 320]"
    )
    render.add_argument("--seed", metavar="N", type=seed, help="random seed [default: the run's, or 0]")
    render.add_argument(
        "--output", metavar="FILE", type=Path, default=Path("fleetjax.gif"), help="gif or mp4 [default: fleetjax.gif]"
    )
    render.add_argument("--overwrite", action="store_true", help="replace an existing file")
    _add_console(commands, environment)
    replay = commands.add_parser("replay", help="repeat a console session from its record, and compare every bit")
    replay.add_argument("run", metavar="RUN", type=Path, help="run folder of a console session")
    _add_humans(commands)
    _add_leaderboard(commands)
    return parser, list(commands.choices)


def _add_humans(commands: Any) -> None:
    about = "models of imperfect humans from what people did in a console session"
    humans = commands.add_parser("humans", help=about, usage="fleetjax humans fit RUN", description=_HUMANS_ABOUT)
    humans.add_argument("action", choices=("fit",), metavar="fit", help="fit a model")
    humans.add_argument("run", metavar="RUN", type=Path, help="run folder of a console session")


def _add_leaderboard(commands: Any) -> None:
    about = {"help": "compare rules for help at equal human time", "description": _LEADERBOARD_ABOUT}
    actions = commands.add_parser("leaderboard", **about).add_subparsers(dest="action", metavar="ACTION", required=True)
    add = actions.add_parser("add", help="run rules and store their runs, then show")
    remove = actions.add_parser("remove", help="forget the stored runs of rules, then show")
    for one in (add, remove):
        one.add_argument("algorithms", metavar="RULE", nargs="+", help="registered algorithm, or MODULE:NAME")
    where = "environments, separated by commas [default: navigation,block_push]"
    add.add_argument("--environments", metavar="ENV,...", type=listed(str), default=["navigation", "block_push"], help=where)
    much = "human timesteps, separated by commas [default: those of the environment]"
    add.add_argument("--budgets", metavar="H,...", type=listed(integer), default=(), help=much)
    add.add_argument("--seeds", metavar="N", type=integer, default=5, help="runs of each rule at each budget [default: 5]")
    runs = Path("runs/leaderboard")
    add.add_argument("--output", metavar="DIR", type=Path, default=runs, help=f"folder of run folders [default: {runs}]")
    show = actions.add_parser("show", help="write the table and the figure of all stored runs, and print where")
    stored = Path("experiments/results")
    for one in (add, remove, show):
        one.add_argument(
            "--results", metavar="DIR", type=Path, default=stored, help=f"folder of stored runs [default: {stored}]"
        )


def _add_compare(commands: Any) -> None:
    usage = "fleetjax compare DIR... [--against GROUP] [--metric NAME]... [--output FILE]... [--rows FILE.csv]"
    about = {"help": "compare runs in tables: means, intervals, differences", "description": _COMPARE_ABOUT}
    compare = commands.add_parser("compare", usage=usage, **about)
    compare.add_argument("runs", metavar="DIR", nargs="+", type=Path, help=_RUNS)
    compare.add_argument("--against", metavar="GROUP", help="group to compare with: an algorithm, or a name in the table")
    compare.add_argument(
        "--metric",
        metavar="NAME",
        action="append",
        help="column of metrics.csv (its total counts), rohe, or rohe_with_demonstrations, for which extra demonstrations "
        "count as human time; may be repeated [default: successes, violations, idle and rohe]",
    )
    compare.add_argument(
        "--output",
        metavar="FILE",
        action="append",
        type=Path,
        default=[],
        help="table (md, csv) or figure (png, pdf, svg); may be repeated [default: print the table]",
    )
    compare.add_argument(
        "--rows", metavar="FILE.csv", type=Path, help="also store a row for each run, from which compare can start again"
    )
    compare.add_argument(
        "--allow-different", action="store_true", help="compare runs of different length or size, and interrupted ones"
    )
    compare.add_argument("--overwrite", action="store_true", help="replace existing files")


def _add_run(commands: Any, environment: str | None) -> None:
    usage = "fleetjax run ENV [--seed N] [--output DIR] [--overwrite] [--checkpoint-every N] [parameters]\n"
    usage += "       fleetjax run --resume RUN"
    run = commands.add_parser("run", help="run a fleet", usage=usage, description=_RUN_ABOUT, epilog=_RUN_NOTE)
    environments = f"environment: {', '.join(list_envs())}"
    run.add_argument("environment", metavar="ENV", nargs="?", default=argparse.SUPPRESS, help=environments)
    run.add_argument("--resume", metavar="RUN", type=Path, help="resume a stopped run from its newest intact checkpoint")
    run.add_argument("--seed", metavar="N", type=seed, help="random seed [default: 0]")
    run.add_argument("--output", metavar="DIR", type=Path, help="run folder [default: a new one below runs/]")
    run.add_argument("--overwrite", action="store_true", help="replace the run in an existing folder")
    run.add_argument(
        "--checkpoint-every",
        metavar="N",
        type=integer,
        default=1000,
        help="timesteps between checkpoints, of which the last two are kept; 0 = none [default: 1000]",
    )
    run.add_argument(
        "--log-interventions", action="store_true", help="log what teleoperating humans see and do, for `fleetjax export`"
    )
    _add_distribution(run)
    add_parameters(run, environment)


def _add_distribution(run: Any) -> None:
    group = run.add_argument_group("one fleet over many devices", "The same command, started again, resumes.")
    every = "divide the robots among all devices of all processes; needs --output, on a file system that they share"
    group.add_argument("--distributed", action="store_true", help=every)
    place = "where process 0 listens; not needed under SLURM, nor with --num-processes 1"
    group.add_argument("--coordinator", metavar="HOST:PORT", help=place)
    group.add_argument("--num-processes", metavar="P", type=integer, help="number of processes")
    group.add_argument("--process-id", metavar="I", type=integer, help="which of them this is, from 0 to P - 1")
    wait = "seconds to wait for the other processes at the start [default: 60]"
    group.add_argument("--connect-timeout", metavar="S", type=integer, default=60, help=wait)
    hang = "end if nothing is finished for S seconds: no compilation, checkpoint or chunk of timesteps, about a hundredth of "
    hang += "the run; choose more than the longest of these takes [default: 1800]"
    group.add_argument("--step-timeout", metavar="S", type=integer, default=1800, help=hang)


def _add_sweep(commands: Any, environment: str | None) -> None:
    usage = "fleetjax sweep ENV... --output DIR [--seeds N] [--workers W] [parameters, each with a list of values]\n"
    usage += "       fleetjax sweep FILE.toml [the same]"
    sweep = commands.add_parser(
        "sweep", help="run every combination of several values, in parallel", usage=usage, description=_SWEEP_ABOUT
    )
    environments = f"environments: {', '.join(list_envs())}; or a .toml file that says what to run"
    sweep.add_argument("subjects", metavar="ENV|FILE", nargs="*", type=listed(str), help=environments)
    options: dict[str, Any] = {"default": argparse.SUPPRESS}
    sweep.add_argument("--seeds", metavar="N", type=integer, help="as many seeds: 0 to N - 1 [default: 1]", **options)
    sweep.add_argument("--seed", metavar="N,...", type=listed(seed), help="these seeds", **options)
    sweep.add_argument("--output", metavar="DIR", type=Path, help="folder for the run folders", **options)
    workers = "processes, which share the cores [default: one for each GPU; without GPUs, one for each core]"
    sweep.add_argument("--workers", metavar="W", type=integer, help=workers, **options)
    together = "compute K seeds side by side in one program, without checkpoints; they round differently [default: 1]"
    sweep.add_argument("--seeds-per-program", metavar="K", type=integer, help=together, **options)
    launcher = "complete the sweep by one-core jobs: local = on this machine, slurm = on a cluster; replaces --workers"
    sweep.add_argument("--launcher", choices=LAUNCHERS, help=launcher, **options)
    sweep.add_argument("--jobs", metavar="J", type=integer, help="number of jobs [default: 1]", **options)
    gpu = "ask for one GPU for each job"
    sweep.add_argument("--slurm-gpu", action="store_true", help=gpu, **options)
    sweep.add_argument("--slurm-partition", metavar="P", help="SLURM partition [default: the cluster's]", **options)
    term = "take over the run of a job that has shown no sign of life for S seconds [default: 180]"
    sweep.add_argument("--lease", metavar="S", type=integer, help=term, **options)
    minutes = "minutes of a job; it is requeued shortly before they are over [default: 1440]"
    sweep.add_argument("--slurm-time", metavar="MIN", type=integer, help=minutes, **options)
    every = "timesteps between the checkpoints of a run; 0 = none [default: 1000]"
    sweep.add_argument("--checkpoint-every", metavar="N", type=integer, help=every, **options)
    logged = "log what teleoperating humans see and do, for `fleetjax export`"
    sweep.add_argument("--log-interventions", action="store_true", help=logged, **options)
    add_parameters(sweep, environment, with_lists=True)


def _add_calibrate(commands: Any, environment: str | None) -> None:
    usage = "fleetjax calibrate ENV --human-time X [--field NAME] [--algorithm A] [--seeds N] [parameters]"
    calibrate = commands.add_parser(
        "calibrate", help="find the threshold that spends a given human time", usage=usage, description=_CALIBRATE_ABOUT
    )
    calibrate.add_argument("environment", metavar="ENV", nargs="?", default=argparse.SUPPRESS, help="environment")
    wanted = "human timesteps that a run should spend, hard resets included"
    calibrate.add_argument("--human-time", metavar="X", type=number, help=wanted)
    calibrate.add_argument(
        "--field", metavar="NAME", help="parameter to find [default: the algorithm's own threshold, rate or time]"
    )
    calibrate.add_argument("--first-seed", metavar="N", type=seed, default=0, help="seed of the search [default: 0]")
    calibrate.add_argument("--seeds", metavar="N", type=integer, default=3, help="seeds in all [default: 3]")
    near = "relative difference that is near enough [default: 0.05]"
    calibrate.add_argument("--tolerance", metavar="X", type=number, default=0.05, help=near)
    calibrate.add_argument(
        "--most", metavar="N", type=integer, default=10, help="values that each of the two searches may try [default: 10]"
    )
    calibrate.add_argument("--output", metavar="DIR", type=Path, help="folder of its runs [default: below runs/]")
    every = "timesteps between the checkpoints of a run; 0 = none [default: 1000]"
    calibrate.add_argument("--checkpoint-every", metavar="N", type=integer, default=1000, help=every)
    add_parameters(calibrate, environment)


def _add_console(commands: Any, environment: str | None) -> None:
    usage = "fleetjax console ENV [--humans M] [--host HOST --token TOKEN] [--port N] [--output DIR] [parameters]"
    console = commands.add_parser(
        "console", help="let people supervise a fleet in their browsers", usage=usage, description=_CONSOLE_ABOUT
    )
    console.add_argument("environment", metavar="ENV", nargs="?", default=argparse.SUPPRESS, help="environment with pictures")
    console.add_argument("--host", default="127.0.0.1", help="address to listen on; any but localhost needs --token")
    console.add_argument("--port", metavar="N", type=integer, default=PORT, help=f"port; 0 = any free one [default: {PORT}]")
    console.add_argument("--token", help="token that pages need as ?token=TOKEN: 8 to 128 letters, digits, or . _ ~ -")
    console.add_argument("--interval", metavar="X", type=number, help="seconds per timestep [default: the control step]")
    console.add_argument(
        "--timeout",
        metavar="X",
        type=number,
        default=10.0,
        help="seconds until a lost connection frees its seat [default: 10]",
    )
    console.add_argument(
        "--wait", metavar="N", type=integer, default=1, help="people to wait for before the first timestep [default: 1]"
    )
    fills = ("simulated", "empty")
    console.add_argument(
        "--fill", choices=fills, default="simulated", help="who plays the seats that nobody takes [default: simulated]"
    )
    console.add_argument("--seed", metavar="N", type=seed, help="random seed [default: 0]")
    console.add_argument("--output", metavar="DIR", type=Path, help="run folder [default: a new one below runs/]")
    console.add_argument("--overwrite", action="store_true", help="replace the run in an existing folder")
    add_parameters(console, environment, short={"num_humans": "--humans"}, defaults=IN_CONSOLE)
