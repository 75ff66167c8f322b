"""Configurations, settings, files and names drawn at random: accepted and sound, or refused with the reason."""

import functools
import json
import math
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import TINY, edit_config, shapes_of
from compiling import compiled
from hypothesis import strategies as st

import fleetjax
from fleetjax import cli
from fleetjax.config import ALLOCATIONS, FIELDS, Config, all_fields, needed_human_capacity
from fleetjax.humans import HUMAN_MODELS, LINK_MODELS
from fleetjax.io import checkpoint, files, folder, interventions, plain
from fleetjax.physics.base import BACKENDS

OF_A_RUN = [name for name in folder.DATA if name != folder.RECORD]  # which consoles alone have
FEW = hypothesis.settings(max_examples=200, deadline=None, suppress_health_check=list(hypothesis.HealthCheck))


def attempt(function: Callable[[], Any]) -> tuple[Any, str]:
    """Return what a function gives, or None and the reason for which it refuses."""
    try:
        return function(), ""
    except ValueError as error:
        return None, str(error)


# Configurations

odd = st.one_of(
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.booleans(),
    st.text(max_size=4),
    st.none(),
    st.lists(st.integers(-3, 9), max_size=3),
)


def values(name: str) -> st.SearchStrategy[Any]:
    """Return values of a field, most of them good."""
    field = FIELDS[name]
    low, high = field.low if field.low is not None else -2, field.high
    names = {
        "algorithm": fleetjax.list_algorithms(),
        "supervisor": ("", *fleetjax.list_supervisors()),
        "backend": BACKENDS,
        "allocation": ALLOCATIONS,
        "human_model": HUMAN_MODELS.names(),
        "link_model": LINK_MODELS.names(),
    }
    good = {
        str: st.sampled_from(names.get(name, ("navigation",))),
        bool: st.booleans(),
        tuple: st.lists(st.integers(1, 300), min_size=1, max_size=3).map(tuple),
        int: st.integers(int(low), 2_000),
        float: st.floats(float(np.float32(low)), float(np.float32(1e3 if high is None else high)), width=32),
    }[field.kind]
    return st.integers(0, 12).flatmap(lambda number: good if number else odd)


CONFIGS = st.fixed_dictionaries({}, optional={name: values(name) for name in FIELDS if name != "environment"})


@pytest.mark.slow
@hypothesis.settings(FEW, max_examples=1000)
@hypothesis.given(environment=st.sampled_from(fleetjax.list_envs()), fields=CONFIGS)
def test_a_configuration_is_valid_or_its_error_names_a_field(environment, fields):
    fields = dict(fields)
    algorithm = fields.pop("algorithm", "cur")
    config, refusal = attempt(lambda: fleetjax.make_config(environment, algorithm, **fields))
    if config is None:
        assert any(name in refusal for name in FIELDS), refusal
        return
    fleetjax.validate(config)
    for name, field in FIELDS.items():
        value = getattr(config, name)
        if field.traced:
            assert value.dtype == {int: jnp.int32, float: jnp.float32, bool: jnp.bool_}[field.kind]
            assert np.all(np.isfinite(value))
        if field.kind in (int, float):
            assert field.low is None or value >= field.low
            assert field.high is None or value <= field.high
    assert config.num_humans <= config.num_robots
    assert config.human_capacity >= needed_human_capacity(config)
    assert json.loads(json.dumps(plain.to_plain(config))) == plain.to_plain(config)


# Settings, through the whole loop

SHAPES = [
    ("cur", {"num_robots": 5, "num_humans": 2}),
    ("thrifty_dagger", {"num_robots": 6, "num_humans": 6, "critic_capacity": 6, "ensemble_size": 1}),
    ("random", {"num_robots": 8, "num_humans": 3, "gradient_steps": 2, "hidden_sizes": (3, 2)}),
    ("constraint", {"num_robots": 1, "num_humans": 1, "extra_demonstrations": 0}),
]
T, SETTINGS = 40, 64
LARGEST = {  # where a field's own limits allow what takes too long, or more data than there is room for
    "min_teleop_time": 12,
    "hard_reset_time": 12,
    "initial_period": 60,
    "uncertainty_threshold": 0.3,
    "thrifty_threshold": 4.0,
    "learning_rate": 0.1,
    "num_demonstrations": 30,
    "extra_demonstrations": 30,
    "pretraining_steps": 5,
    "critic_pretraining_steps": 5,
    "num_critic_transitions": 30,
    "critic_noise": 2.0,
}


def draw_settings(config: Config, seed: int) -> Config:
    """Return SETTINGS configurations at once: every traced field at random between its limits, which are drawn now and then."""
    rng, drawn = np.random.default_rng(seed), {}
    for name, field in all_fields(config.algorithm).items():
        if field.traced:
            low, high = field.low or 0, LARGEST.get(name, field.high)
            sample = rng.uniform(low, 1 if high is None else high, SETTINGS)
            edge = rng.random(SETTINGS)
            sample = np.where(edge < 0.1, low, np.where(edge > 0.9, 1 if high is None else high, sample))
            drawn[name] = sample > 0.5 if field.kind is bool else np.round(sample) if field.kind is int else sample
    drawn["num_demonstrations"] = np.maximum(drawn["num_demonstrations"], config.batch_size)

    def replace(values: dict[str, jax.Array]) -> Config:
        return config.replace(**values)

    kinds = {int: jnp.int32, float: jnp.float32, bool: jnp.bool_}
    return jax.vmap(replace)(
        {name: jnp.asarray(value, kinds[all_fields(config.algorithm)[name].kind]) for name, value in drawn.items()}
    )


@functools.cache
def program():
    def run(configs: Config, keys: jax.Array):
        result = jax.vmap(fleetjax.run)(configs, keys)
        kept = (result.state.humans, result.state.env, result.state.human_data.pairs.added, result.state.resetting)
        return result.metrics, kept

    return compiled(run)


@pytest.mark.parametrize(
    ("algorithm", "shape"),
    [pytest.param(*entry, id=entry[0], marks=[] if entry[0] == "cur" else [pytest.mark.slow]) for entry in SHAPES],
)
def test_any_setting_keeps_the_invariants(algorithm, shape):
    small = {"hidden_sizes": (4,), "ensemble_size": 2, "batch_size": 4, "critic_capacity": 50, "human_capacity": 1000}
    config = fleetjax.make_config("navigation", algorithm, **small | {"num_steps": T} | shape)
    configs = draw_settings(config, seed=len(algorithm))
    metrics, (humans, env, added, resetting) = program()(configs, jax.random.split(jax.random.key(7), SETTINGS))
    m = jax.tree.map(np.asarray, metrics)
    n, people = config.num_robots, config.num_humans
    assert np.all(m.moving + m.idle == n)
    assert np.all((m.successes >= 0) & (m.successes <= m.moving) & (m.violations <= m.moving))
    assert np.all(m.teleop_steps <= m.human_steps)
    assert np.all(m.human_steps <= people)
    assert np.all(m.hard_resets <= m.human_steps - m.teleop_steps)
    assert np.all((m.risk_choices <= m.choices) & (m.choices <= m.switches) & (m.switches <= n))
    np.testing.assert_array_equal(m.idle[:, 1:], (m.idle + m.violations - m.hard_resets)[:, :-1])
    for values in (m.reward, m.uncertainty, m.policy_loss, env.obs, env.reward):
        assert np.all(np.isfinite(values))
    assert not m.diverged.any()
    assert np.all(m.uncertainty >= 0)
    for robots in np.asarray(humans.robot):
        helped = robots[robots >= 0]
        assert len(set(helped.tolist())) == helped.size
        assert np.all(robots < n)
    assert np.all(np.asarray(humans.duration) >= 0)
    assert np.all(np.asarray(humans.duration)[np.asarray(humans.robot) < 0] == 0)
    assert np.all(np.asarray(resetting).sum(axis=1) <= people)
    if algorithm not in ("constraint", "expert"):
        offline = np.asarray(configs.num_demonstrations) + np.asarray(configs.extra_demonstrations)
        np.testing.assert_array_equal(added, offline + m.teleop_steps.sum(axis=1))
    assert m.hard_resets.sum() > 0 or not m.violations.sum()


# Files


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished run with a checkpoint and a log of interventions."""
    path = tmp_path_factory.mktemp("runs") / "finished"
    arguments = ["run", "navigation", *TINY, "--output", str(path), "--checkpoint-every", "50", "--log-interventions"]
    assert cli.main(arguments) == 0
    return path


json_values = st.recursive(
    odd, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
)


def sealed(value: Any) -> Any:
    """Return what a config.json might hold with a right digest, so that its other content is looked at."""
    return folder.with_digest({"config": {}, "sha256": value, "versions": value, "seed": 0})


def read_all(path: Path) -> None:
    run = folder.read_run(path)
    folder.read_metrics(run)
    folder.read_interventions(run)
    folder.read_policy(run)  # takes longest


@FEW
@hypothesis.given(data=st.binary(max_size=200) | (json_values | json_values.map(sealed)).map(lambda x: json.dumps(x).encode()))
def test_any_bytes_as_configuration_are_refused(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    (path / "config.json").write_bytes(data)
    with pytest.raises(ValueError, match=r"config\.json"):
        folder.read_run(path)


@FEW
@hypothesis.given(name=st.sampled_from([*FIELDS, "flux"]), value=odd)
def test_any_value_in_a_configuration_is_read_as_it_is_or_refused(finished, tmp_path_factory, name, value):
    path = tmp_path_factory.mktemp("run")
    shutil.copy(finished / "config.json", path)
    edit_config(path, lambda content: content["config"].update({name: value}))
    run, refusal = attempt(lambda: folder.read_run(path))
    if run is None:
        assert "config.json" in refusal
        return
    assert name != "flux"
    read = plain.to_plain(run.config)[name]
    if name == "human_capacity" and value == 0:  # as many as a run can produce
        value = needed_human_capacity(run.config)
    assert read == value or math.isclose(read, value, rel_tol=1e-6, abs_tol=1e-37)


@pytest.mark.slow
@FEW
@hypothesis.given(
    name=st.sampled_from([*OF_A_RUN, "config.json"]), place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7)
)
def test_no_flipped_bit_goes_unnoticed(finished, tmp_path_factory, name, place, bit):
    path = Path(shutil.copytree(finished, tmp_path_factory.mktemp("run") / "copy", ignore=lambda *_: [checkpoint.FOLDER]))
    data = bytearray((path / name).read_bytes())
    data[int(place * len(data))] ^= 1 << bit
    (path / name).write_bytes(data)
    if name != "config.json":
        with pytest.raises(ValueError, match=name):
            read_all(path)
        return
    run, refusal = attempt(lambda: folder.read_run(path))
    if run is None:
        assert str(path) in refusal
    else:  # 1E-05 in place of 1e-05, for one
        assert run.digests == folder.read_run(finished).digests
        assert folder.identity(run.config, run.seed) == folder.identity(folder.read_run(finished).config, run.seed)


class Bomb:
    """What leaves a mark when it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return (Path.touch, (self.mark,))


def test_nothing_that_is_read_is_executed(finished, tmp_path):
    mark = tmp_path / "executed"
    bomb = pickle.dumps(Bomb(mark))
    pickle.loads(bomb)
    assert mark.exists()  # the bomb works
    mark.unlink()
    run = folder.read_run(finished)
    for name in OF_A_RUN:
        path = Path(shutil.copytree(finished, tmp_path / name))
        (path / name).write_bytes(bomb)
        folder.write_config(run._replace(folder=path), sealed=True)  # so that its digest is right
        with pytest.raises(ValueError, match=name):
            read_all(path)
    shapes = shapes_of(run.config)
    for file in sorted((finished / checkpoint.FOLDER).rglob("*")):
        if file.is_dir() or file.name == "commit_success.txt":
            continue
        path = Path(shutil.copytree(finished, tmp_path / f"c{len(list(tmp_path.iterdir()))}"))
        damaged = path / file.relative_to(finished)
        damaged.write_bytes(bomb)
        where = path / checkpoint.FOLDER / file.relative_to(finished / checkpoint.FOLDER).parts[0]
        if file.name != checkpoint.MANIFEST:
            manifest = json.loads((where / checkpoint.MANIFEST).read_text())
            manifest["sha256"] = checkpoint._digests(where)
            files.write_json(where / checkpoint.MANIFEST, manifest)
        checkpoint.restore(path, folder.identity(run.config, run.seed), shapes, lambda notes: None)
    assert not mark.exists()


NAMES = ["a b", "ünïcode-机器人", "per%cent", "new\nline", "quote'\"", "dots..", "#hash;rm", "{brace}", "x" * 200, "-dash"]


@pytest.mark.parametrize("name", NAMES)
def test_run_folders_may_have_odd_names(finished, tmp_path, monkeypatch, capsys, name):
    path = Path(shutil.copytree(finished, tmp_path / name))
    monkeypatch.chdir(tmp_path)
    (path / "policy.msgpack").unlink()
    folder.write_config(folder.read_run(path), sealed=False)
    assert cli.main(["run", f"--resume={name}"]) == 0
    for file in ("metrics.csv", "policy.msgpack", interventions.FILE):
        assert (path / file).read_bytes() == (finished / file).read_bytes()
    place = name if not name.startswith("-") else f"./{name}"
    assert cli.main(["plot", place, "--output", f"{place}/figure.svg"]) == 0
    assert name in capsys.readouterr().out
