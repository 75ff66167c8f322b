"""The fleet against the NumPy oracle of the whole loop, step by step, on navigation and on a scripted toy."""

import ast
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from compiling import compiled
from reference import oracle, recording

import fleetjax
from fleetjax import envs

pytestmark = pytest.mark.usefixtures("toy_supervisors")

SMALL = {
    "num_robots": 8,
    "num_steps": 200,
    "hidden_sizes": (8,),
    "ensemble_size": 3,
    "batch_size": 16,
    "critic_capacity": 250,  # less than the transitions of a run: the ring overwrites
    "num_demonstrations": 16,
    "learning_rate": 3e-3,
    "uncertainty_threshold": 0.01,
    "initial_period": 0,
    "gradient_steps": 2,
}

# On navigation: algorithm, number of humans, and traced settings that share one compilation.
CASES = {
    "cur": ("cur", 3, [
        {"min_teleop_time": 5, "hard_reset_time": 5},
        {"min_teleop_time": 7, "hard_reset_time": 3, "initial_period": 60, "risk_threshold": 0.4},
        {"min_teleop_time": 2, "hard_reset_time": 6, "uncertainty_threshold": 1.0, "risk_threshold": 0.45},
        {"min_teleop_time": 1, "hard_reset_time": 1, "absence": 0.2},
    ]),
    "cu, one human": ("cu", 1, [
        {"min_teleop_time": 3, "hard_reset_time": 4},
        {"min_teleop_time": 6, "hard_reset_time": 2, "absence": 0.2},
    ]),
    "ensemble_dagger, as many humans as robots": ("ensemble_dagger", 8, [
        {"min_teleop_time": 3, "hard_reset_time": 5, "uncertainty_threshold": 0.1, "absence": 0.05},
        {"min_teleop_time": 6, "hard_reset_time": 1, "initial_period": 50, "uncertainty_threshold": 0.05},
    ]),
}  # fmt: skip

# On a scripted toy: algorithm, overrides, and whether a success brings a new goal.
TOY_CASES = {
    "cur, new goals": ("cur", {"initial_period": 15, "uncertainty_threshold": 0.2}, True),
    "thrifty_dagger": ("thrifty_dagger", {"thrifty_threshold": 0.5}, False),
    "random": ("random", {"random_threshold": 0.7}, False),
    "constraint": ("constraint", {}, False),
}


def run_both(env, configs: list[fleetjax.Config], absences: list[float], seed: int = 1):
    """Return the trace of each configuration and what the oracle saw; they differ in traced fields only."""

    def run(config, absence, key):
        key_start, key_run = jax.random.split(key)
        state = recording.start(config, env, key_start)
        return recording.record(config, env, fleetjax.make_fleet(config, env), state, key_run, absence, silence=absence)

    keys = jax.random.split(jax.random.key(seed), len(configs))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *configs)
    traces = compiled(jax.vmap(run))(stacked, jnp.array(absences), keys)
    traces = jax.tree.map(np.asarray, traces)
    each = [jax.tree.map(lambda x, k=k: x[k], traces) for k in range(len(configs))]
    return each, [recording.compare(config, env, trace) for config, trace in zip(configs, each, strict=True)]


def total(outcomes: list[oracle.Outcome], name: str) -> int:
    return sum(outcome.metrics[name] for outcome in outcomes)


@pytest.mark.parametrize("case", CASES)
def test_fleet_agrees_with_the_oracle_on_navigation(case):
    algorithm, num_humans, settings = CASES[case]
    absences = [setting.get("absence", 0.0) for setting in settings]
    traced = [{k: v for k, v in setting.items() if k != "absence"} for setting in settings]
    made = [fleetjax.make_config("navigation", algorithm, **SMALL | kw, num_humans=num_humans) for kw in traced]
    traces, outcomes = run_both(envs.make("navigation"), made, absences)
    # The comparison means something only if things happened.
    for name in ("violations", "hard_resets", "successes", "teleop_steps", "switches"):
        assert sum(total(seen, name) for seen in outcomes) > 0, name
    for trace in traces:
        assert int(trace.last.human_data.pairs.added) > 0
        for ring in trace.last.estimators.values():
            assert int(ring.negatives.added) > ring.negatives.rows.violation.shape[0]


@pytest.mark.parametrize("case", TOY_CASES)
def test_fleet_agrees_with_the_oracle_on_a_scripted_toy(case):
    algorithm, overrides, new_goals = TOY_CASES[case]
    env = toy_envs.scripted([0, 9, 14, 0, 17], [4, 12, 5, 3, 0], horizon=20, new_goals=new_goals)
    timing = {"min_teleop_time": 4, "hard_reset_time": 3, "num_steps": 80}
    config = fleetjax.make_config(env, algorithm, **SMALL | timing | overrides | {"num_robots": 5, "num_humans": 2})
    [trace], [seen] = run_both(env, [config], [0.1])
    assert total(seen, "hard_resets") > 2
    assert sum(len(outcome.soft_resets) for outcome in seen) > 5
    assert sum(len(outcome.new_goals) for outcome in seen) > 20 or not new_goals
    assert total(seen, "teleop_steps") > 5 or algorithm == "constraint"
    assert int(trace.last.policy.opt_state.count) == (0 if algorithm == "constraint" else 160)


def test_oracle_imports_neither_fleetjax_nor_jax():
    tree = ast.parse(inspect.getsource(oracle))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {getattr(node, "module", None) or node.names[0].name for node in imports}
    assert names == {"dataclasses", "typing", "numpy"}


def test_disagreement_is_named():
    with pytest.raises(AssertionError, match="allocation differs at t = 3"):
        recording.same("allocation", 3, np.array([1, 0]), [0, 1])
