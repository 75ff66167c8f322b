"""Parameters and commands that cannot be used cost one line on stderr and exit code 2, and touch nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import contents, refused

import fleetjax
from fleetjax import checks, priority, supervisors
from fleetjax.config import Config
from fleetjax.field import Field
from fleetjax.io import files

RUN = ("run", "navigation")
BAD_RUNS = {
    "M > N": ((*RUN, "--num-robots", 4, "--num-humans", 5), "num_humans = 5 is more than num_robots = 4"),
    "T < 1": ((*RUN, "--num-steps", 0), "num_steps = 0 must be at least 1"),
    "T no integer": ((*RUN, "--num-steps", 2.5), "--num-steps: 2.5 must be a whole number"),
    "t_T no integer": ((*RUN, "--min-teleop-time", 0.5), "--min-teleop-time: 0.5 must be a whole number"),
    "t_R no integer": ((*RUN, "--hard-reset-time", "nan"), "--hard-reset-time: nan must be a whole number"),
    "t_I too large": ((*RUN, "--initial-period", 1e12), "must be a whole number, at most 2147483647"),
    "t_R < 1": ((*RUN, "--hard-reset-time", 0), "hard_reset_time = 0 must be at least 1"),
    "environment": (("run", "navigatoin"), "environment = 'navigatoin' is unknown; the closest are navigation"),
    "algorithm": ((*RUN, "--algorithm", "ensemble"), "algorithm = 'ensemble' is unknown; the closest are ensemble_dagger"),
    "backend": ((*RUN, "--backend", "cuda"), "backend = 'cuda' is unknown"),
    "supervisor": ((*RUN, "--supervisor", "humanoyd"), "the closest are humanoid"),
    "flag": ((*RUN, "--num-robot", 4), "unknown flag --num-robot; the closest is --num-robots"),
    "flag before": (("run", "--num-robot", 4, "navigation"), "unknown flag --num-robot; the closest is --num-robots"),
    "flag with =": ((*RUN, "--hard-reset=4"), "unknown flag --hard-reset; the closest is --hard-reset-time"),
    "too much": ((*RUN, "humanoid"), "unexpected argument 'humanoid'"),
    "no value": ((*RUN, "--num-robots"), "--num-robots: expected one argument"),
    "no environment": (("run",), "navigation, or resume a run with --resume RUN\n"),
    "no goal": (("run", "humanoid", "--algorithm", "thrifty_dagger"), "algorithm = 'thrifty_dagger' needs a goal"),
    "negative uncertainty": ((*RUN, "--uncertainty-threshold", -0.1), "uncertainty_threshold = -0.1"),
    "negative risk": ((*RUN, "--risk-threshold", "-.5"), "risk_threshold = -0.5 must be in [0, 1]"),
    "negative random": ((*RUN, "--algorithm", "random", "--random-threshold", -1), "random_threshold = -1.0 must be in [0, 1]"),
    "negative thrifty": ((*RUN, "--algorithm", "thrifty_dagger", "--thrifty-threshold=-1e-3"), "thrifty_threshold = -0.001"),
    "another's parameter": (
        (*RUN, "--thrifty-weight", 0.5),
        "thrifty_weight is a parameter of algorithm = 'thrifty_dagger', not of 'cur'",
    ),
    "not finite": ((*RUN, "--learning-rate", "inf"), "learning_rate = inf must be at least 0"),
    "no number": ((*RUN, "--learning-rate", "fast"), "--learning-rate: 'fast' must be a number"),
    "batch": ((*RUN, "--batch-size", 600), "batch_size = 600 is larger than the data"),
    "no number for a human": ((*RUN, "--takeover-time", "fast"), "--takeover-time: 'fast' must be a number"),
    "no file for humans": ((*RUN, "--takeover-time", "@none.txt"), "--takeover-time: none.txt cannot be read"),
    "no layers": ((*RUN, "--hidden-sizes", 0), "hidden_sizes = (0,)"),
    "seed": ((*RUN, "--seed", -1), "--seed: '-1' must be a whole number from 0 to 4294967295"),
    "large seed": ((*RUN, "--seed", 2**32), "--seed: '4294967296' must be a whole number"),
    "another's supervisor": (
        (*RUN, "--supervisor", "humanoid"),
        "supervisor = 'humanoid' does not fit environment = 'navigation': it cannot act on its states",
    ),
    "too large networks": (
        (*RUN, "--hidden-sizes", 10**9, 10**9),
        "hidden_sizes = (1000000000, 1000000000) is too large: the run needs at least",
    ),
    "few humans for expert": ((*RUN, "--algorithm", "expert", "--num-humans", 3), "must equal num_robots"),
}


@pytest.mark.parametrize("name", BAD_RUNS)
def test_bad_parameters_cost_one_line_and_touch_nothing(name, capsys, tmp_path):
    arguments, reason = BAD_RUNS[name]
    (tmp_path / "metrics.csv").write_text("precious")
    place = ("--output", tmp_path, "--overwrite")
    # The flags come first where a value or a name must stay last.
    line = refused(capsys, arguments[0], *place, *arguments[1:])
    assert reason in line
    assert line.startswith("fleetjax: ")
    assert contents(tmp_path) == {"metrics.csv": b"precious"}


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("rnu", "navigation"), "command = 'rnu' is unknown; the closest are run"),
        (("--verbose",), "unknown flag --verbose; the closest is --version"),
        (("plot",), "required: RUN"),
        (("plot", "nowhere"), "nowhere is not a run folder"),
        (("plot", "nowhere", "--output", "figure.gif"), "figure.gif must end in one of .png, .pdf, .svg"),
        (("evaluate", "nowhere", "--num-step", "3"), "unknown flag --num-step; the closest is --num-steps"),
        (("evaluate", __file__), "it is a file"),
        (("list", "all"), "unexpected argument 'all'"),
    ],
)
def test_other_commands_refuse_in_one_line(arguments, reason, capsys):
    assert reason in refused(capsys, *arguments)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("initial_period", 2**40, "initial_period = 1099511627776 must lie within 32 bits"),
        ("initial_period", 2**70, "must lie within 32 bits"),
        ("num_demonstrations", np.int64(2**32 + 500), "num_demonstrations = 4294967796 must lie within 32 bits"),
        ("num_demonstrations", np.array([500, 2**32 + 500]), "must lie within 32 bits"),
        ("num_demonstrations", 16777217.0, "num_demonstrations = 16777217.0 is a float beyond 2.24.*pass an int"),
        ("num_demonstrations", 500.5, "num_demonstrations = 500.5 must be a whole number$"),
        ("num_demonstrations", np.nan, "must be a whole number"),
        ("min_teleop_time", 0.5, "min_teleop_time = 0.5 must be a whole number of timesteps"),
        ("num_robots", 2.5, "num_robots = 2.5 must be a whole number"),
        ("hidden_sizes", 64, "hidden_sizes = 64 must be a list of whole numbers"),
        ("num_demonstrations", True, "num_demonstrations = True must be a number"),
        ("learning_rate", 1j, "learning_rate = 1j must be a number"),
        ("learning_rate", None, "learning_rate = None must be a number"),
        ("normalize_observations", 1, "normalize_observations = 1 must be True or False"),
    ],
)
def test_numbers_that_a_field_cannot_hold_are_refused(name, value, reason):
    with pytest.raises(ValueError, match=reason):
        Config().replace(**{name: value})


def test_numbers_that_a_field_can_hold_are_kept():
    config = Config().replace(num_demonstrations=np.int64(2**31 - 1), initial_period=500.0, learning_rate=np.float64(0.1))
    assert (int(config.num_demonstrations), int(config.initial_period)) == (2**31 - 1, 500)
    assert float(config.learning_rate) == np.float32(0.1)


def test_a_supervisor_whose_actions_have_another_size_is_refused(monkeypatch):
    monkeypatch.setitem(
        supervisors.SUPERVISORS.entries, "wide", lambda env: fleetjax.Supervisor(lambda state, key: jnp.zeros(3))
    )
    with pytest.raises(ValueError, match=r"'wide' does not fit .*'navigation': it gives \(3,\), and actions have \(2,\)"):
        fleetjax.make_config("navigation", supervisor="wide")


def test_a_run_that_cannot_fit_the_memory_is_refused_with_both_numbers(monkeypatch):
    config = fleetjax.make_config("navigation", "cur", critic_capacity=1_000_000)
    needed = r"critic_capacity = 1000000 is too large: .* 0\.0[1-9] GiB of memory \(0\.0[1-9] GiB for .* only 0\.00 GiB"
    monkeypatch.setattr(checks, "memory", lambda: 1000)
    with pytest.raises(ValueError, match=needed):
        jax.eval_shape(fleetjax.run, config, jax.random.key(0))
    state = checks.state_shapes(config, fleetjax.envs.make("navigation"))
    held = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    monkeypatch.setattr(checks, "memory", lambda: 2 * held)
    checks.check_run(config)


def test_a_disk_that_fails_costs_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(files.os, "fsync", lambda descriptor: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    assert refused(capsys, *RUN, "--output", tmp_path / "run") == "fleetjax: No space left on device\n"


def test_arguments_of_another_kind_are_refused():
    config = fleetjax.make_config("navigation", num_robots=4, num_humans=2, num_steps=3)
    key = jax.random.key(0)
    calls = {
        "key must be a single JAX key": (
            lambda: fleetjax.run(config, jax.random.PRNGKey(0)),
            lambda: fleetjax.run(config, 0),  # type: ignore[arg-type]
            lambda: fleetjax.prepare(config, jax.random.split(key)),
        ),
        "state must be of type FleetState, not Config; pass what prepare returns": (
            lambda: fleetjax.run(config, key, config),  # type: ignore[arg-type]
        ),
        r"env must be of type Env, not str; pass fleetjax.envs.make\(name\)": (
            lambda: fleetjax.run(config, key, env="navigation"),  # type: ignore[arg-type]
        ),
        "policy must be of type PolicyState, not Config": (lambda: fleetjax.evaluate(config, key, config),),  # type: ignore[arg-type]
    }
    for message, wrong in calls.items():
        for call in wrong:
            with pytest.raises(ValueError, match=message):
                call()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "shadow",
            {"parameters": {"temperature": Field("mine", default=2.0)}},
            "'temperature' of 'shadow' is a field of Config",
        ),
        ("bare", {"parameters": {"mine": 2.0}}, "'mine' of 'bare' must be a fleetjax.field.Field"),
        ("text", {"estimators": "safety"}, r"must be a tuple of names: \('safety',\)"),
    ],
)
def test_rules_that_could_not_be_configured_are_not_registered(name, options, message):
    with pytest.raises(ValueError, match=message):
        fleetjax.register_priority(name, lambda config: priority.stateless(lambda signals, key: signals.risk), **options)
    assert name not in priority.list_algorithms()
