"""Interventions: what is logged comes back, is cut where it broke off, and is exported as its formats are published."""

import itertools
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import h5py
import hypothesis
import minari
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from commands import refused
from hypothesis import strategies
from hypothesis.extra import numpy as arrays
from pyarrow import parquet

import fleetjax
from fleetjax import cli, envs
from fleetjax.envs import EnvSpec
from fleetjax.fleet import Interventions
from fleetjax.io import export, folder, formats, interventions, plain
from fleetjax.version import VERSION

SPECS = {
    "continuous": EnvSpec("navigation", 5, 2, 100, 0.05),
    "discrete": EnvSpec("grid", 5, 4, 100, 0.1, discrete=True),
    "one number": EnvSpec("pole", 1, 1, 100, 0.015),
}
CONFIG = fleetjax.make_config("navigation", num_robots=6, num_humans=2, num_steps=50)
LENGTHS = (6, 1, 3)
EXTRAS = {
    "robot_action": "robot_action",
    "human_id": "human",
    "robot_id": "robot",
    "robot_episode": "episode",
    "timestep": "timestep",
    "priority": "priority",
}


def make_intervention(spec: EnvSpec, length: int, *, seed: int) -> np.ndarray:
    """Return records of random numbers; the last step violates the constraint, times out or does neither."""
    random = np.random.default_rng(seed)
    rows = np.zeros(length, interventions.record(spec))
    for name in ("priority", "obs", "robot_action", "human_action", "next_obs", "reward"):
        rows[name] = random.uniform(-1, 1, rows[name].shape)
    if spec.discrete:
        for name in ("robot_action", "human_action"):
            rows[name] = np.eye(spec.action_size)[random.integers(spec.action_size, size=length)]
    rows["next_obs"][:-1] = rows["obs"][1:]
    rows["human"], rows["robot"], rows["step"] = seed % 2, seed, 7 + np.arange(length)
    rows["timestep"] = 10 * seed + np.arange(length)
    rows["episode"] = rows["timestep"] - rows["step"]
    rows["violation"][-1], rows["timeout"][-1] = seed == 0, seed == 1
    rows["success"] = random.random(length) < 0.5
    return rows


def make_interventions(spec: EnvSpec) -> list[np.ndarray]:
    return [make_intervention(spec, length, seed=seed) for seed, length in enumerate(LENGTHS)]


@pytest.fixture(scope="module", params=SPECS)
def spec(request) -> EnvSpec:
    return SPECS[request.param]


@pytest.fixture(scope="module")
def parts(spec) -> list[np.ndarray]:
    return make_interventions(spec)


@pytest.fixture(scope="module")
def made(parts, spec, tmp_path_factory) -> dict[str, Path]:
    """A data set of each format, alone in its folder."""
    place = tmp_path_factory.mktemp("sets")
    outputs = {"lerobot": "fleet", "robomimic": "fleet.hdf5", "minari": "fleet-v3"}
    for kind, name in outputs.items():
        (place / kind).mkdir()
        export.export(parts, CONFIG, spec, place / kind / name, kind)
    return {kind: place / kind / name for kind, name in outputs.items()}


def tree(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_nothing_but_the_data_set_is_written(made):
    assert all(list(path.parent.iterdir()) == [path] for path in made.values())
    assert set(tree(made["minari"])) == {"data/main_data.hdf5", "data/metadata.json"}
    assert set(tree(made["lerobot"])) == {
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/fleetjax.json",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    }


def test_every_data_set_names_the_run_that_made_it(made, spec):
    with h5py.File(made["robomimic"]) as file:
        sources = [json.loads(str(file["data"].attrs["fleetjax"]))]
    sources.append(json.loads((made["lerobot"] / "meta/fleetjax.json").read_text()))
    sources.append(minari.MinariDataset(made["minari"] / "data").storage.metadata["fleetjax"])
    expected = {"version": VERSION, "control_step": spec.control_step, "config": plain.to_plain(CONFIG)}
    assert all(source == expected for source in sources)


# LeRobot

MEASURES = ("min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99")


def read_lerobot(path: Path) -> tuple[dict[str, Any], pa.Table, dict[str, np.ndarray]]:
    """Return the information, the table of timesteps, and its columns [F, ...]."""
    info = json.loads((path / "meta/info.json").read_text())
    table = parquet.read_table(path / info["data_path"].format(chunk_index=0, file_index=0))
    return info, table, {name: np.array(table[name].to_pylist()) for name in table.column_names}


def test_lerobot_has_every_timestep(made, parts):
    _, _, columns = read_lerobot(made["lerobot"])
    records = np.concatenate(parts)
    names = {"observation.state": "obs", "action": "human_action", "next.observation.state": "next_obs", **EXTRAS}
    names |= {"next.reward": "reward", "next.truncated": "timeout", "next.success": "success"}
    for name, field in names.items():
        np.testing.assert_array_equal(columns[name].reshape(records[field].shape), records[field], name)
    np.testing.assert_array_equal(columns["next.done"], records["violation"] | records["timeout"])
    assert columns["intervention"].all()


def test_lerobot_has_the_published_types(made, spec):
    info, table, _ = read_lerobot(made["lerobot"])
    assert table.column_names == list(info["features"])
    for name, feature in info["features"].items():
        (size,), number = feature["shape"], pa.from_numpy_dtype(feature["dtype"])
        assert table.schema.field(name).type == (number if size == 1 else pa.list_(number, size)), name
    features = {name: (feature["dtype"], feature["shape"]) for name, feature in info["features"].items()}
    assert features["observation.state"] == ("float32", [spec.observation_size])
    assert features["action"] == ("float32", [spec.action_size])
    assert features["next.reward"] == features["timestamp"] == ("float32", [1])
    assert all(features[name] == ("bool", [1]) for name in ("next.done", "next.success", "intervention"))
    places = ("frame_index", "episode_index", "index", "task_index")
    assert all(features[name] == ("int64", [1]) for name in places)


def test_lerobot_counts_timesteps_and_episodes(made, spec):
    info, _, columns = read_lerobot(made["lerobot"])
    np.testing.assert_array_equal(columns["index"], np.arange(sum(LENGTHS)))
    np.testing.assert_array_equal(columns["episode_index"], np.repeat(range(len(LENGTHS)), LENGTHS))
    np.testing.assert_array_equal(columns["frame_index"], np.concatenate([np.arange(n) for n in LENGTHS]))
    np.testing.assert_allclose(columns["timestamp"], columns["frame_index"] / info["fps"], rtol=1e-6)
    assert info == {
        "codebase_version": "v3.0",
        "robot_type": spec.name,
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(1 / spec.control_step),
        "splits": {"train": "0:3"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": info["features"],
    }


def test_lerobot_tells_where_each_episode_is(made, spec):
    info, _, columns = read_lerobot(made["lerobot"])
    episodes = parquet.read_table(made["lerobot"] / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [episode["episode_index"] for episode in episodes] == [0, 1, 2]
    for episode, length in zip(episodes, LENGTHS, strict=True):
        rows = slice(episode["dataset_from_index"], episode["dataset_to_index"])
        assert episode["length"] == length == rows.stop - rows.start
        assert set(columns["episode_index"][rows]) == {episode["episode_index"]}
        assert episode["tasks"] == [spec.name]
        places = [f"{place}/{number}_index" for place in ("data", "meta/episodes") for number in ("chunk", "file")]
        assert all(episode[place] == 0 for place in places)
        for name in info["features"]:
            check_statistics(columns[name][rows], {measure: episode[f"stats/{name}/{measure}"] for measure in MEASURES})
    tasks = pd.read_parquet(made["lerobot"] / "meta/tasks.parquet")
    assert (list(tasks.index), tasks.index.name, list(tasks["task_index"])) == ([spec.name], "task", [0])


def test_lerobot_has_the_statistics_of_every_feature(made):
    info, _, columns = read_lerobot(made["lerobot"])
    statistics = json.loads((made["lerobot"] / "meta/stats.json").read_text())
    assert set(statistics) == set(info["features"])
    for name, measures in statistics.items():
        assert set(measures) == set(MEASURES)
        check_statistics(columns[name], measures)


def check_statistics(values: np.ndarray, measures: dict[str, list[float]]) -> None:
    """Compare measures of `values` [F] or [F, D] with numpy's."""
    values = values.reshape(len(values), -1).astype(np.float64)
    expected = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    expected |= {f"q{percent:02d}": np.percentile(values, percent, axis=0) for percent in (1, 10, 50, 90, 99)}
    for name, numbers in expected.items():
        np.testing.assert_allclose(measures[name], numbers, rtol=1e-9, atol=1e-12, err_msg=name)
    assert measures["count"] == [len(values)]


def test_lerobot_itself_reads_it(made, parts, spec, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    reader = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    dataset = reader.LeRobotDataset("a/fleet", root=made["lerobot"])
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, sum(LENGTHS), round(1 / spec.control_step))
    for item, record in zip(dataset, np.concatenate(parts), strict=True):
        np.testing.assert_array_equal(np.ravel(item["observation.state"]), record["obs"])
        np.testing.assert_array_equal(np.ravel(item["action"]), record["human_action"])
        assert item["robot_id"] == record["robot"]
        assert item["task"] == spec.name
    before = {"action": [-1 / dataset.fps, 0.0]}
    windows = reader.LeRobotDataset("a/fleet", root=made["lerobot"], delta_timestamps=before)
    assert windows[1]["action_is_pad"].tolist() == [False, False]
    assert windows[LENGTHS[0]]["action_is_pad"].tolist() == [True, False]


# robomimic


def test_robomimic_has_the_published_structure(made, parts, spec):
    with h5py.File(made["robomimic"]) as file:
        data: Any = file["data"]
        assert data.attrs["total"] == sum(LENGTHS)
        environment = json.loads(data.attrs["env_args"])
        assert environment == {"env_name": spec.name, "type": 2, "env_type": 2, "env_kwargs": {}}
        assert list(data) == ["demo_0", "demo_1", "demo_2"]
        for demo, records in zip(data.values(), parts, strict=True):
            assert demo.attrs["num_samples"] == len(records)
            shapes = {name: demo[name].shape for name in ("obs/state", "next_obs/state", "actions", "rewards", "dones")}
            assert shapes == {
                "obs/state": (len(records), spec.observation_size),
                "next_obs/state": (len(records), spec.observation_size),
                "actions": (len(records), spec.action_size),
                "rewards": (len(records),),
                "dones": (len(records),),
            }
            assert len(demo["states"]) == len(records)


def test_robomimic_has_every_timestep(made, parts):
    names = {
        "obs/state": "obs",
        "next_obs/state": "next_obs",
        "actions": "human_action",
        "rewards": "reward",
        "dones": "violation",
        "timeouts": "timeout",
        "successes": "success",
        "robot_actions": "robot_action",
        "human_id": "human",
        "robot_id": "robot",
        "episode": "episode",
        "timestep": "timestep",
        "priority": "priority",
    }
    with h5py.File(made["robomimic"]) as file:
        for i, records in enumerate(parts):
            demo: Any = file[f"data/demo_{i}"]
            for name, field in names.items():
                np.testing.assert_array_equal(demo[name][()], records[field], name)
            assert (demo["interventions"][()] == 1).all()
            assert {demo[name].dtype.kind for name in ("dones", "successes", "interventions")} == {"i"}


def test_robomimic_gets_actions_between_minus_one_and_one(tmp_path):
    records = make_intervention(SPECS["continuous"], 4, seed=0)
    records["human_action"] *= 3
    export.export([records], CONFIG, SPECS["continuous"], tmp_path / "fleet.hdf5", "robomimic")
    with h5py.File(tmp_path / "fleet.hdf5") as file:
        data: Any = file["data/demo_0"]
        np.testing.assert_array_equal(data["actions"], np.clip(records["human_action"], -1, 1))


def test_robomimic_itself_reads_it(made, parts):
    reader = pytest.importorskip("robomimic.utils.dataset")
    utils = pytest.importorskip("robomimic.utils.obs_utils")
    utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": ["state"]}})
    keys = {"obs_keys": ["state"], "dataset_keys": ["actions", "rewards", "dones", "interventions"]}
    dataset = reader.SequenceDataset(str(made["robomimic"]), **keys, hdf5_cache_mode=None, load_next_obs=True)
    assert (dataset.n_demos, len(dataset)) == (3, sum(LENGTHS))
    for item, record in zip((dataset[i] for i in range(len(dataset))), np.concatenate(parts), strict=True):
        np.testing.assert_array_equal(item["obs"]["state"][0], record["obs"])
        np.testing.assert_array_equal(item["next_obs"]["state"][0], record["next_obs"])
        np.testing.assert_array_equal(item["actions"][0], record["human_action"])


# Minari


def test_minari_itself_reads_every_timestep(made, parts, spec):
    dataset = minari.MinariDataset(made["minari"] / "data")
    assert (dataset.total_episodes, dataset.total_steps, dataset.id) == (3, sum(LENGTHS), "fleet-v3")
    for episode, records in zip(dataset, parts, strict=True):
        np.testing.assert_array_equal(episode.observations, [*records["obs"], records["next_obs"][-1]])
        actions = records["human_action"].argmax(1) if spec.discrete else records["human_action"]
        np.testing.assert_array_equal(episode.actions, actions)
        np.testing.assert_array_equal(episode.rewards, records["reward"])
        np.testing.assert_array_equal(episode.terminations, records["violation"])
        for name, field in {"next_observation": "next_obs", "success": "success", "timeout": "timeout", **EXTRAS}.items():
            np.testing.assert_array_equal(episode.infos[name], records[field], name)
        assert episode.infos["intervention"].all()


def test_minari_gets_what_its_spaces_contain(made, spec):
    dataset = minari.MinariDataset(made["minari"] / "data")
    assert dataset.observation_space.shape == (spec.observation_size,)
    for episode in dataset:
        assert all(dataset.observation_space.contains(x) for x in episode.observations)
        assert all(dataset.action_space.contains(x) for x in episode.actions)


def test_in_minari_every_intervention_ends_where_the_data_do(made):
    first, second, third = minari.MinariDataset(made["minari"] / "data")
    for episode in (first, second, third):
        assert not (episode.terminations | episode.truncations)[:-1].any()
    ends = [(bool(episode.terminations[-1]), bool(episode.truncations[-1])) for episode in (first, second, third)]
    assert ends == [(True, False), (False, True), (False, True)]


def test_minari_finds_it_by_name(made, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(made["minari"].parent))
    assert list(minari.list_local_datasets()) == ["fleet-v3"]
    spec = minari.load_dataset("fleet-v3").spec
    assert (spec.dataset_name, spec.version, spec.env_spec) == ("fleet", 3, None)


@pytest.mark.parametrize(
    ("name", "known_as"), [("fleet", "fleet-v0"), ("a run.set", "a_run_set-v0"), ("x-v12", "x-v12"), ("-v1", "-v1-v0")]
)
def test_minari_gets_a_name_that_it_allows(name, known_as, tmp_path):
    export.export(make_interventions(SPECS["continuous"]), CONFIG, SPECS["continuous"], tmp_path / name, "minari")
    assert minari.MinariDataset(tmp_path / name / "data").spec.dataset_id == known_as


# All or nothing


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_a_failed_write_leaves_nothing_behind(kind, tmp_path):
    good = make_intervention(SPECS["continuous"], 3, seed=0)
    bad = np.zeros(3, [("obs", "f4", (5,)), ("human_action", "f4", (2,))])
    (tmp_path / "neighbour").write_text("precious")
    with pytest.raises((TypeError, ValueError)):
        export.export([good, bad], CONFIG, SPECS["continuous"], tmp_path / "fleet", kind)
    assert tree(tmp_path) == {"neighbour": b"precious"}
    assert not any(path.is_dir() for path in tmp_path.iterdir())
    export.export([good], CONFIG, SPECS["continuous"], tmp_path / "fleet", kind)
    before = tree(tmp_path)
    with pytest.raises((TypeError, ValueError)):
        export.export([good, bad], CONFIG, SPECS["continuous"], tmp_path / "fleet", kind)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_a_full_disk_leaves_nothing_behind(kind, tmp_path, monkeypatch):
    def fail(*arguments):
        del arguments
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    parts = make_interventions(SPECS["continuous"])
    with pytest.raises(OSError, match="No space left"):
        export.export(parts, CONFIG, SPECS["continuous"], tmp_path / "fleet", kind)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_an_older_data_set_and_what_a_killed_export_left_are_replaced(kind, tmp_path):
    spec, output = SPECS["continuous"], tmp_path / "fleet"
    (tmp_path / ".fleet.partial" / "fleet").mkdir(parents=True)
    export.export(make_interventions(spec), CONFIG, spec, output, kind)
    first = tree(tmp_path)
    export.export(make_interventions(spec)[:1], CONFIG, spec, output, kind)
    assert list(tmp_path.iterdir()) == [output]
    assert set(tree(tmp_path)) == set(first)
    assert tree(tmp_path) != first


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_an_older_data_set_comes_back_if_the_new_one_cannot_be_put_there(kind, tmp_path, monkeypatch):
    spec, output = SPECS["continuous"], tmp_path / "fleet"
    export.export(make_interventions(spec), CONFIG, spec, output, kind)
    before, rename = tree(tmp_path), Path.replace

    def fail_for_the_new(path, target):
        if path.parent.name == ".fleet.partial":
            raise OSError(28, "No space left on device")
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", fail_for_the_new)
    with pytest.raises(OSError, match="No space left"):
        export.export(make_interventions(spec)[:1], CONFIG, spec, output, kind)
    assert tree(tmp_path) == before
    assert list(tmp_path.iterdir()) == [output]


@pytest.fixture
def run(tmp_path) -> Path:
    """A finished run whose log has interventions."""
    path = tmp_path / "runs" / "navigation"
    path.mkdir(parents=True)
    log = np.concatenate(make_interventions(envs.make("navigation").spec))
    (path / interventions.FILE).write_bytes(log.tobytes())
    folder.write_config(folder.Run(path, CONFIG, 0, logged=True), sealed=True)
    return path


def exported(run: Path, kind: str, output: Path) -> Path:
    assert cli.main(["export", str(run), "--format", kind, "--output", str(output), "--overwrite"]) == 0
    return output


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_what_no_export_of_the_format_wrote_is_not_overwritten(kind, run, tmp_path, capsys):
    thesis, link, empty = tmp_path / "thesis", tmp_path / "link", tmp_path / "empty"
    for part in ("meta", "data"):
        (thesis / part).mkdir(parents=True)
    (thesis / "meta/fleetjax.json").write_text("not JSON")
    (thesis / "data/metadata.json").write_text('{"dataset_id": "precious-v0"}')
    with h5py.File(tmp_path / "precious.hdf5", "w") as file:
        file.create_group("data").attrs["total"] = 0
    (tmp_path / "notes.txt").write_text("precious")
    others = [exported(run, other, tmp_path / other) for other in formats.FORMATS if other != kind]
    link.symlink_to(exported(run, kind, tmp_path / kind))
    empty.mkdir()
    before = tree(tmp_path)
    files = [tmp_path / "precious.hdf5", tmp_path / "notes.txt", run / folder.CONFIG]
    capsys.readouterr()
    for output in (run, run.parent, tmp_path, thesis, link, *others, *files):
        reason = refused(capsys, "export", run, "--format", kind, "--output", output, "--overwrite")
        assert f"{output} " in reason
        assert "choose another --output" in reason
        assert tree(tmp_path) == before
    assert link.is_symlink()
    exported(run, kind, tmp_path / kind)
    if kind != "robomimic":  # a file
        exported(run, kind, empty)


@pytest.mark.parametrize("kind", ["lerobot", "minari"])
def test_notes_in_an_older_data_set_are_not_lost(kind, run, tmp_path, capsys):
    output = exported(run, kind, tmp_path / "fleet")
    (output / "data" / "notes.md").write_text("precious")
    before = tree(tmp_path)
    capsys.readouterr()
    reason = refused(capsys, "export", run, "--format", kind, "--output", output, "--overwrite")
    assert f"{output} also holds data/notes.md, which would be lost; move it, or choose another --output" in reason
    assert tree(tmp_path) == before
    (output / "data" / "notes.md").unlink()
    (output / "link").symlink_to(run)
    assert "also holds link" in refused(capsys, "export", run, "--format", kind, "--output", output, "--overwrite")
    (output / "link").unlink()
    exported(run, kind, output)


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_without_interventions_nothing_is_written(kind, tmp_path):
    with pytest.raises(ValueError, match="holds no interventions; nothing was exported"):
        export.export([], CONFIG, SPECS["continuous"], tmp_path / "fleet", kind)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in formats.NEEDS.items() for name in names])
def test_a_missing_library_is_named_with_the_remedy(kind, name, monkeypatch, tmp_path):
    formats.check(kind)
    monkeypatch.setitem(sys.modules, name, None)
    reason = rf'--format {kind} needs {name}; run pip install "\.\[{kind}\]" in the source folder'
    with pytest.raises(ValueError, match=reason):
        formats.check(kind)
    with pytest.raises(ValueError, match=reason):
        export.export(make_interventions(SPECS["continuous"]), CONFIG, SPECS["continuous"], tmp_path / "fleet", kind)
    assert not list(tmp_path.iterdir())


def test_an_unknown_format_is_refused():
    with pytest.raises(ValueError, match="format = 'robomimik' is unknown; the closest are robomimic"):
        formats.check("robomimik")


# The log

STEPS, HUMANS, BEGUN = 12, 2, 3  # timesteps, humans; the first timestep
tables = arrays.arrays(np.int32, (STEPS, HUMANS), elements=strategies.integers(-1, 1))
episodes = arrays.arrays(np.int32, (STEPS, HUMANS), elements=strategies.sampled_from([0, 0, 0, BEGUN]))


def make_chunk(spec: EnvSpec, robot: np.ndarray, episode: np.ndarray) -> Interventions:
    """Return the interventions [STEPS, HUMANS] of robots whose episodes began at the given timesteps."""
    random = np.random.default_rng(0)
    kind = interventions.record(spec)
    fields = {name: random.random((*robot.shape, *kind[name].shape)).astype(kind[name].base) for name in Interventions._fields}
    clock = BEGUN + np.arange(STEPS)[:, None]
    return Interventions._make((fields | {"robot": robot, "step": clock - episode}).values())


def log(spec: EnvSpec, chunks: list[Interventions]) -> bytes:
    """Return the content of a log to which chunks are appended one after the other."""
    with tempfile.TemporaryDirectory() as place:
        file, first = interventions.open_log(Path(place)), BEGUN
        for chunk in chunks:
            interventions.append(file, chunk, first, spec)
            first += len(chunk.robot)
        file.close()
        return (Path(place) / interventions.FILE).read_bytes()


@hypothesis.given(tables, episodes, strategies.integers(0, STEPS))
def test_what_is_appended_is_parsed(robot, episode, cut):
    spec = SPECS["continuous"]
    chunk = make_chunk(spec, robot, episode)
    halves = [Interventions._make(x[rows] for x in chunk) for rows in (slice(cut), slice(cut, None))]
    data = log(spec, halves)
    assert data == log(spec, [chunk])
    records = interventions.parse(data, spec)
    time, human = np.nonzero(robot >= 0)
    np.testing.assert_array_equal(records["timestep"], BEGUN + time)
    np.testing.assert_array_equal(records["human"], human)
    np.testing.assert_array_equal(records["episode"], episode[time, human])
    for name, values in chunk._asdict().items():
        np.testing.assert_array_equal(records[name], values[time, human], name)


def test_a_log_that_is_cut_short_is_refused():
    spec = SPECS["discrete"]
    data = log(spec, [make_chunk(spec, np.zeros((STEPS, HUMANS), np.int32), np.zeros((STEPS, HUMANS), np.int32))])
    assert len(interventions.parse(data, spec)) == STEPS * HUMANS
    with pytest.raises(ValueError, match="is not a multiple of"):
        interventions.parse(data[:-1], spec)


@hypothesis.given(tables, episodes, strategies.integers(0, 2**32 - 1))
def test_interventions_are_whole_and_unbroken(robot, episode, seed):
    spec = SPECS["continuous"]
    records = interventions.parse(log(spec, [make_chunk(spec, robot, episode)]), spec)
    shuffled = records[np.random.default_rng(seed).permutation(len(records))]
    found = interventions.split(shuffled)
    assert sorted(row.tobytes() for part in found for row in part) == sorted(row.tobytes() for row in records)
    owners = [{(int(row["human"]), int(row["robot"]), int(row["episode"])) for row in part} for part in found]
    assert all(len(owner) == 1 for owner in owners)
    assert all((np.diff(part["timestep"]) == 1).all() for part in found)
    for (one, owner), (other, owner_of_other) in itertools.permutations(zip(found, owners, strict=True), 2):
        assert owner != owner_of_other or one["timestep"][-1] + 1 != other["timestep"][0]
    begun = [(part["timestep"][0], part["human"][0]) for part in found]
    assert begun == sorted(begun)


def test_no_records_are_no_interventions():
    assert interventions.split(interventions.parse(b"", SPECS["continuous"])) == []
