"""Run folders, figures, tables and progress: what is written comes back, and what is damaged is refused."""

import contextlib
import functools
import json
from pathlib import Path

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import edit_config, make_metrics
from hypothesis import strategies

import fleetjax
from fleetjax.io import checkpoint, chunks, files, folder, metrics_csv, plain
from fleetjax.learning.imitation import make_learner
from fleetjax.learning.networks import Normalizer
from fleetjax.metrics import Metrics

STEPS = 40


@functools.cache
def make_policy():
    learner = make_learner(make_tiny_config(), fleetjax.envs.make("navigation").spec)
    return jax.jit(learner.init)(jax.random.key(3), Normalizer(jnp.arange(8.0), jnp.arange(1.0, 9.0), jnp.float32(10)))


@pytest.fixture
def config():
    return make_tiny_config()


def make_tiny_config():
    return fleetjax.make_config("navigation", num_steps=STEPS, hidden_sizes=(8,), uncertainty_threshold=0.07)


@pytest.fixture
def saved(tmp_path, config):
    """A finished run folder."""
    path = tmp_path / "a run"
    path.mkdir()
    run = folder.Run(path, config, 5)
    folder.create(run)
    folder.write_policy(path, make_policy())
    with contextlib.closing(metrics_csv.open_log(path)) as log:
        metrics_csv.append(log, make_metrics(), 0)
    folder.write_config(run, sealed=True)
    return path


def test_a_run_folder_comes_back_as_it_was(saved, config):
    run = folder.read_run(saved)
    assert run.seed == 5
    assert plain.to_plain(run.config) == plain.to_plain(config)
    jax.tree.map(np.testing.assert_array_equal, run.config, config)
    for read, written in zip(folder.read_metrics(run), make_metrics(), strict=True):
        assert read.dtype == written.dtype
        np.testing.assert_array_equal(read, written)
    read, written = folder.read_policy(run), make_policy()
    jax.tree.map(np.testing.assert_array_equal, (read.params, read.normalizer), (written.params, written.normalizer))


def test_pandas_opens_the_metrics(saved):
    frame = pd.read_csv(saved / "metrics.csv")
    assert list(frame.columns) == ["timestep", *Metrics._fields]
    assert frame["timestep"].tolist() == list(range(STEPS))
    assert frame["successes"].dtype == np.int64
    np.testing.assert_array_equal(frame["reward"].to_numpy(np.float32), make_metrics().reward)


def test_the_configuration_is_plain_json_with_seed_and_versions(saved):
    content = json.loads((saved / "config.json").read_text())
    assert content["config"]["uncertainty_threshold"] == 0.07
    assert content["config"]["hidden_sizes"] == [8]
    assert content["config"]["normalize_observations"] is True
    assert content["seed"] == 5
    assert content["versions"] == [{"timestep": 0, **folder.versions()}]
    assert not [path.name for path in saved.iterdir() if path.name.endswith(".partial")]


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "file"
    files.write(path, b"old")
    monkeypatch.setattr(files.os, "fsync", lambda descriptor: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        files.write(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def flip(path: Path, place: int = -40) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def change(path: Path, **fields) -> None:
    edit_config(path.parent, lambda content: content["config"].update(fields))


def edit(path: Path, old: str, new: str) -> None:
    data = path.read_text()
    assert old in data
    path.write_text(data.replace(old, new))


DAMAGES = {
    "no folder": (lambda run: [path.unlink() for path in run.iterdir()] and run.rmdir(), "it does not exist"),
    "no config": (lambda run: (run / "config.json").unlink(), "config.json is missing, so this is not a run folder"),
    "no metrics": (lambda run: (run / "metrics.csv").unlink(), "metrics.csv is missing"),
    "no policy": (lambda run: (run / "policy.msgpack").unlink(), "policy.msgpack is missing, so the run did not finish"),
    "policy cut": (lambda run: (run / "policy.msgpack").write_bytes(b"\x82\xa6params"), "SHA-256"),
    "bit in policy": (lambda run: flip(run / "policy.msgpack"), "SHA-256"),
    "bit in metrics": (lambda run: flip(run / "metrics.csv"), "SHA-256"),
    "no JSON": (lambda run: (run / "config.json").write_text("{"), "config.json cannot be used"),
    "no text": (lambda run: (run / "config.json").write_bytes(b"\xff\xfe\x00"), "config.json cannot be used"),
    "deep JSON": (lambda run: (run / "config.json").write_text("[" * 200_000), "nested too deeply"),
    "a list": (lambda run: (run / "config.json").write_text("[1]"), "not written by fleetjax"),
    "a foreign file": (lambda run: (run / "config.json").write_text('{"config": {"lr": 1}}'), "no SHA-256 digest of its own"),
    "sealed by others": (lambda run: edit_config(run, lambda content: content.pop("seed")), "seed = None"),
    "other digests": (lambda run: edit_config(run, lambda content: content["sha256"].update(mine="")), "or name other files"),
    "another robot": (lambda run: edit(run / "config.json", '"navigation"', '"humanoid"'), "it was edited or is damaged"),
    "another version": (lambda run: edit(run / "config.json", '"mujoco": "', '"mujoco": "1'), "it was edited or is damaged"),
    "sealed by hand": (lambda run: edit(run / "config.json", '"sha256_config": "', '"sha256_config": "0'), "it was edited"),
    "unknown field": (lambda run: change(run / "config.json", flux=1), "unknown fields: flux"),
    "wrong type": (lambda run: change(run / "config.json", num_robots="many"), "num_robots = 'many'"),
    "wrong list": (lambda run: change(run / "config.json", hidden_sizes=7), "hidden_sizes = 7"),
    "not a number": (lambda run: change(run / "config.json", risk_threshold=float("nan")), "risk_threshold = nan"),
    "out of range": (lambda run: change(run / "config.json", num_humans=101), "num_humans = 101"),
    "unknown environment": (lambda run: change(run / "config.json", environment="mars"), "environment = 'mars' is unknown"),
    "other shapes": (lambda run: change(run / "config.json", hidden_sizes=[9]), "shapes"),
    "other layers": (lambda run: change(run / "config.json", hidden_sizes=[8, 8]), "policy.msgpack cannot be used"),
}


SINCE_0 = {"timestep": 0, "fleetjax": "1", "jax": "2", "mujoco": "3"}


@pytest.mark.parametrize(
    "versions",
    [
        None,
        folder.versions(),
        [],
        [7],
        [folder.versions()],
        [SINCE_0 | {"jax": 7}],
        [SINCE_0 | {"timestep": "0"}],
        [SINCE_0 | {"timestep": 1}],
        [SINCE_0 | {"timestep": -1}, SINCE_0],
        [SINCE_0, SINCE_0],
        [SINCE_0, SINCE_0 | {"timestep": 9}, SINCE_0 | {"timestep": 8}],
    ],
)
def test_damaged_versions_are_refused(saved, versions):
    edit_config(saved, lambda content: content.update(versions=versions))
    with pytest.raises(ValueError, match="its versions are not"):
        folder.read_run(saved)


def test_versions_are_listed_from_the_timestep_on_from_which_they_ran(saved, monkeypatch):
    run = folder.read_run(saved)
    assert folder.resumed(run, 8) == run
    entries = [{"timestep": 0, **folder.versions()}]
    for timestep, jax_version in ((8, "a"), (12, "a"), (20, "b")):
        monkeypatch.setattr(jax, "__version__", jax_version)
        run = folder.resumed(run, timestep)
        if timestep != 12:  # nothing has changed
            entries.append({"timestep": timestep, **folder.versions()})
        assert list(run.versions) == entries
    folder.write_config(run, sealed=True)
    assert folder.read_run(saved).versions == run.versions
    assert list(folder.resumed(run, 20).versions) == entries
    monkeypatch.setattr(jax, "__version__", "a")
    assert list(folder.resumed(run, 20).versions) == entries[:2]


def read_all(path: Path) -> None:
    run = folder.read_run(path)
    folder.read_metrics(run)
    folder.read_policy(run)


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_and_foreign_folders_are_refused_with_the_reason(saved, name):
    damage, reason = DAMAGES[name]
    damage(saved)
    with pytest.raises(ValueError, match=reason) as caught:
        read_all(saved)
    assert str(saved) in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("timestep,successes", "timestep,triumphs", "columns"),
        ("\n7,", "\n8,", "timesteps are missing"),
        ("\n7,", "\n7,7,", "metrics.csv cannot be used"),
        ("\n7,", "\n7,x", "metrics.csv cannot be used"),
        ("\n7,", "\n7,99999999999", "metrics.csv cannot be used"),
        ("\n7,", f"\n7,{200_000 * '1'}", "metrics.csv cannot be used: field larger than field limit"),
    ],
)
def test_metrics_that_make_no_sense_are_refused_even_where_the_digest_fits(saved, config, old, new, reason):
    path = saved / "metrics.csv"
    path.write_text(path.read_text().replace(old, new))
    folder.write_config(folder.Run(saved, config, 5), sealed=True)
    with pytest.raises(ValueError, match=reason):
        folder.read_metrics(folder.read_run(saved))


def test_a_policy_that_is_not_finite_is_refused(saved, config):
    policy = make_policy()
    folder.write_policy(saved, policy._replace(normalizer=policy.normalizer._replace(mean=jnp.full(8, jnp.nan))))
    folder.write_config(folder.Run(saved, config, 5), sealed=True)
    with pytest.raises(ValueError, match="not finite"):
        folder.read_policy(folder.read_run(saved))


def test_default_folders_are_new(tmp_path, monkeypatch, config):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(folder.time, "strftime", lambda form: "20300102-030405")
    first = folder.default_folder(config, 3)
    assert str(first) == "runs/navigation-cur-seed3-20300102-030405"
    first.mkdir(parents=True)
    assert folder.default_folder(config, 3).name == f"{first.name}-2"


def test_overwriting_spares_what_fleetjax_did_not_write(saved, config):
    checkpoints = saved / checkpoint.FOLDER
    (checkpoints / "0000000007").mkdir(parents=True)
    (checkpoints / "0000000007" / "data").write_text("a run's")
    for name in ("0000000008", "kept-0000000007", "00000000070"):
        path = checkpoints / name / "mine" if name != "0000000008" else checkpoints / name  # here a file
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    (saved / "notes.txt").write_text("mine")
    folder.create(folder.Run(saved, config, 6))
    assert {path.name for path in saved.iterdir()} == {"config.json", "notes.txt", "checkpoints"}
    assert {path.name for path in checkpoints.iterdir()} == {"0000000008", "kept-0000000007", "00000000070"}
    assert folder.read_run(saved).seed == 6


def test_only_a_run_is_overwritten(saved, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    (tmp_path / files.LOCK).touch()
    for path in (tmp_path / "mine", tmp_path / "mine" / "notes.txt", tmp_path / files.LOCK):
        for overwrite in (False, True):
            with pytest.raises(FileExistsError, match="already exists and is not a run folder"):
                folder.check_folder(path, overwrite=overwrite)
    with pytest.raises(FileExistsError, match="--overwrite"):
        folder.check_folder(saved, overwrite=False)
    (saved / "config.json").write_text("{")
    folder.check_folder(saved, overwrite=True)
    (saved / "lerobot").mkdir()
    with pytest.raises(FileExistsError, match="holds lerobot, exported from its run; move or delete it"):
        folder.check_folder(saved, overwrite=True)
    (saved / "lerobot").rmdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / files.LOCK).touch()  # as a kill may leave them
    (tmp_path / "empty" / ".config.json.partial").touch()
    folder.check_folder(tmp_path / "empty", overwrite=False)


@hypothesis.given(strategies.integers(1, 200_000), strategies.integers(2, 5_000) | strategies.none())
def test_chunks_add_up_and_need_at_most_two_programs(num_steps, within):
    """And none is a single timestep, which would be a program with other roundings."""
    length = chunks.chunk_length(num_steps, within)
    lengths = chunks.chunks_of(num_steps, length)
    assert sum(lengths) == num_steps
    assert len(set(lengths)) <= 2
    assert 1 not in lengths or num_steps == 1
    assert within or len(lengths) <= 3 * chunks.CHUNKS + 1
    assert max(lengths) <= max(3, within or num_steps, 3 * num_steps // chunks.CHUNKS) + 3


def test_a_paper_scale_run_is_a_hundred_equal_chunks():
    assert chunks.chunks_of(10_000, chunks.chunk_length(10_000, 1000)) == [100] * 100
    assert chunks.chunks_of(2_000, chunks.chunk_length(2_000, 1000)) == [20] * 100
