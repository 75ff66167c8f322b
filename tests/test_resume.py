"""A run that is stopped, killed or damaged and then resumed gives the bits of one that was not."""

import contextlib
import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from commands import STEPS, TINY, contents, edit_config, refused, shapes_of

import fleetjax
from fleetjax import cli
from fleetjax.io import checkpoint, chunks, files, folder, resumable

RUN = ("run", "navigation", *TINY, "--seed", "3", "--log-interventions")
RESULTS = ("metrics.csv", "policy.msgpack", "interventions.bin")


def run_here(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a run that nobody disturbed."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    assert run_here(*RUN, "--output", path) == 0
    return path


def assert_same(path: Path, whole: Path) -> None:
    for name in RESULTS:
        assert (path / name).read_bytes() == (whole / name).read_bytes(), name


def interrupt_after(chunks: int, *, times: int = 1, ready=lambda: True):
    """Return progress that presses Ctrl-C at the end of a chunk, once it is ready for that."""

    @contextlib.contextmanager
    def progress(config, before=None):
        shown = iter(range(chunks - 1))

        def show(metrics):
            if next(shown, None) is None:
                while not ready():
                    time.sleep(0.01)
                for _ in range(times):
                    signal.raise_signal(signal.SIGINT)

        yield show

    return progress


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A run with checkpoints at t = 30, 60 and 66, where Ctrl-C stopped it; the last two are kept."""
    path, said = tmp_path_factory.mktemp("runs") / "interrupted", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(said):
        patch.setattr(resumable, "progress", interrupt_after(33))
        assert run_here(*RUN, "--output", path, "--checkpoint-every", 30) == 130
    assert steps_of(path) == [60, 66]
    line = said.getvalue().splitlines()[-1]
    assert line == f"fleetjax: interrupted at t = 66 of {STEPS}; resume with: fleetjax run --resume {path}"
    return path


@pytest.fixture
def stopped(interrupted, tmp_path):
    """A copy of the interrupted run."""
    return Path(shutil.copytree(interrupted, tmp_path / "stopped"))


def steps_of(path: Path) -> list[int]:
    """Return the timesteps of the checkpoints that were finished; of one that failed, a part may be left."""
    return sorted(int(found.parent.name) for found in (path / checkpoint.FOLDER).glob(f"*/{checkpoint.MANIFEST}"))


@pytest.mark.slow
def test_an_undisturbed_run_is_the_librarys_bit_for_bit(whole):
    run = folder.read_run(whole)
    expected = jax.jit(fleetjax.run)(run.config, jax.random.key(3))
    jax.tree.map(np.testing.assert_array_equal, folder.read_metrics(run), jax.device_get(expected.metrics))
    jax.tree.map(np.testing.assert_array_equal, folder.read_policy(run).params, expected.state.policy.params)
    assert np.sum(expected.metrics.hard_resets) > 0


def test_interventions_are_logged_and_exported(whole, tmp_path, capsys):
    run = folder.read_run(whole)
    records = np.concatenate(folder.read_interventions(run))
    metrics = folder.read_metrics(run)
    np.testing.assert_array_equal(np.bincount(records["timestep"], minlength=STEPS), metrics.teleop_steps)
    assert np.all(np.abs(records["human_action"]) <= 1)
    assert np.any(records["human_action"] != records["robot_action"])
    episodes = {(robot, episode) for robot, episode in records[["robot", "episode"]].tolist()}
    assert len(episodes) > 4
    for name in ("lerobot", "robomimic", "minari"):
        output = tmp_path / name
        assert run_here("export", whole, "--format", name, "--output", output) == 0
        printed = capsys.readouterr()
        assert f"{records.size} timesteps of human actions" in printed.err
        assert printed.out == f"{output}\n"
        assert "already exists" in refused(capsys, "export", whole, "--format", name, "--output", output)
    with h5py.File(tmp_path / "robomimic") as file:
        assert file["data"].attrs["total"] == records.size


def test_what_was_not_logged_is_not_exported(whole, tmp_path, capsys):
    path = Path(shutil.copytree(whole, tmp_path / "copy"))
    folder.write_config(folder.read_run(path)._replace(logged=False), sealed=True)
    assert "run with --log-interventions" in refused(capsys, "export", path, "--format", "minari")
    assert "invalid choice: 'csv'" in refused(capsys, "export", path, "--format", "csv")
    assert "does not log interventions" in refused(capsys, "run", "--resume", path, "--log-interventions")


@pytest.mark.usefixtures("compiled_both_ways")
def test_ctrl_c_writes_a_checkpoint_from_which_the_run_goes_on(stopped, whole, capsys):
    assert set(contents(stopped)) == {"config.json", "metrics.csv", "figure.png", "interventions.bin"}
    assert (stopped / "metrics.csv").read_text().splitlines() == (whole / "metrics.csv").read_text().splitlines()[:67]
    assert "policy.msgpack is missing" in refused(capsys, "evaluate", stopped)
    assert run_here("plot", stopped, "--output", stopped / "figure.pdf") == 0
    assert "was interrupted; curves with the same settings end at 66 timesteps" in capsys.readouterr().err
    assert run_here("run", "--resume", stopped) == 0
    assert f"resuming from {stopped / 'checkpoints' / '0000000066'}" in capsys.readouterr().err
    assert_same(stopped, whole)
    before = contents(stopped)
    assert run_here("run", "--resume", stopped) == 0
    assert "is already finished; there is nothing to resume" in capsys.readouterr().err
    assert contents(stopped) == before


def test_a_second_ctrl_c_stops_at_once_and_the_run_goes_on_from_an_older_checkpoint(tmp_path, monkeypatch, whole, capsys):
    path = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        written = lambda: steps_of(path) == [30]  # noqa: E731
        patch.setattr(resumable, "progress", interrupt_after(20, times=2, ready=written))
        assert run_here(*RUN, "--output", path, "--checkpoint-every", 30) == 130
    assert "interrupted at once, without a checkpoint" in capsys.readouterr().err
    assert steps_of(path) == [30]
    assert run_here("run", "--resume", path, "--checkpoint-every", 0) == 0
    assert steps_of(path) == [30]
    assert_same(path, whole)


@pytest.mark.usefixtures("compiled_both_ways")
@pytest.mark.parametrize("every", [45, pytest.param(119, marks=pytest.mark.slow)])
def test_any_chunk_length_and_any_stop_give_the_same_bits(tmp_path, monkeypatch, whole, every):
    path = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(resumable, "progress", interrupt_after(1))
        assert run_here(*RUN, "--output", path, "--checkpoint-every", every) == 130
        assert run_here("run", "--resume", path, "--checkpoint-every", 5) == 130
    assert run_here("run", "navigation", "--resume", path, "--num-steps", STEPS, "--seed", 3) == 0
    assert_same(path, whole)


@pytest.mark.slow
def test_imperfect_people_and_links_are_in_the_checkpoint(tmp_path, monkeypatch):
    times = tmp_path / "times.txt"
    times.write_text("1.5 4")  # TINY has two humans
    people = (
        "--takeover-time",
        f"@{times}",
        "--absence",
        "0.3",
        "--absence-time",
        "9",
        "--fatigue",
        "2",
        "--action-delay",
        "2",
    )
    given = (*RUN, *people, "--action-noise", "0.2", "--link-model", "swapping")
    assert run_here(*given, "--output", tmp_path / "whole") == 0
    with monkeypatch.context() as patch:
        patch.setattr(resumable, "progress", interrupt_after(20))
        assert run_here(*given, "--output", tmp_path / "stopped", "--checkpoint-every", 15) == 130
    assert run_here("run", "--resume", tmp_path / "stopped") == 0
    assert_same(tmp_path / "stopped", tmp_path / "whole")


def test_metrics_behind_the_checkpoint_are_cut_off(stopped, whole, capsys):
    shutil.rmtree(stopped / checkpoint.FOLDER / "0000000066")
    folder.write_config(folder.read_run(stopped), sealed=False)  # as a kill leaves it
    with (stopped / "metrics.csv").open("a") as file:
        file.write("66,1,2")  # a row that a kill has cut
    assert f"the run is not finished; resume it with: fleetjax run --resume {stopped}" in refused(capsys, "plot", stopped)
    assert run_here("run", "--resume", stopped) == 0
    assert_same(stopped, whole)


def newest(path: Path) -> Path:
    return max((path / checkpoint.FOLDER).iterdir())


def largest(path: Path) -> Path:
    return max((file for file in path.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)


def truncate(path: Path) -> None:
    os.truncate(largest(path), largest(path).stat().st_size // 2)


def flip(path: Path) -> None:
    data = bytearray(largest(path).read_bytes())
    data[len(data) // 3] ^= 8
    largest(path).write_bytes(data)


def edit(path: Path, **fields) -> None:
    manifest = json.loads((path / checkpoint.MANIFEST).read_text())
    (path / checkpoint.MANIFEST).write_text(json.dumps(manifest | fields))


def notes(path: Path) -> dict:
    return json.loads((path / checkpoint.MANIFEST).read_text())["notes"]


DAMAGES = {
    "truncated": (truncate, "damaged"),
    "bit flipped": (flip, "damaged"),
    "another run's": (lambda path: edit(path, seed=4), "it belongs to another run"),
    "another version's": (lambda path: edit(path, config={"num_robots": 4}), "it belongs to another run"),
    "unfinished": (lambda path: (path / checkpoint.MANIFEST).unlink(), "it was never finished"),
    "manifest cut": (lambda path: os.truncate(path / checkpoint.MANIFEST, 100), "0000000066: "),
    "not fleetjax's": (lambda path: (path / checkpoint.MANIFEST).write_text("[]"), "was not written by fleetjax"),
    "other metrics": (lambda path: edit(path, notes={"metrics": {"size": 9, "sha256": ""}}), "metrics.csv has changed since"),
    "a file more": (lambda path: (path / "stray").write_text("?"), "damaged"),
    "other log": (
        lambda path: edit(path, notes=notes(path) | {"interventions": {"size": 9, "sha256": ""}}),
        "interventions.bin has changed",
    ),
    "no log": (lambda path: edit(path, notes={"metrics": notes(path)["metrics"]}), "interventions"),
    "emptied": (lambda path: shutil.rmtree(path / checkpoint.ARRAYS), "damaged"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_checkpoint_that_cannot_be_used_is_named_and_the_older_one_taken(stopped, whole, capsys, name):
    damage, reason = DAMAGES[name]
    damage(newest(stopped))
    assert run_here("run", "--resume", stopped) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith(("skipped", "resuming"))]
    assert said[0].startswith(f"skipped checkpoint {stopped / 'checkpoints' / '0000000066'}: ")
    assert reason in said[0]
    assert said[1] == f"resuming from {stopped / 'checkpoints' / '0000000060'}"
    assert_same(stopped, whole)


EMPTY = {"size": 0, "sha256": files.digest(b"")}
MANIFESTS = [
    b"",
    b"\xff\xfe",
    b"[" * 200_000,
    b'{"notes": ' * 200_000,
    b"null",
    b"7",
    {"notes": 7},
    {"notes": {}},
    {"notes": {"metrics": 7}},
    {"notes": {"metrics": {"size": "many"}}},
    {"notes": {"metrics": {"size": -1, "sha256": None}}},
    {"notes": {"metrics": {"size": 10**40, "sha256": []}}},
    {"notes": {"metrics": EMPTY, "interventions": EMPTY}},
    {"sha256": 7},
    {"sha256": {"../../metrics.csv": 7}},
    {"timestep": {}},
    {"config": 7},
]


@pytest.mark.slow
def test_every_malformed_manifest_is_passed_over_with_the_reason(stopped):
    run, path = folder.read_run(stopped), newest(stopped)
    intact = json.loads((path / checkpoint.MANIFEST).read_text())
    shown: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "say", shown.append)
        for manifest in MANIFESTS:
            data = manifest if isinstance(manifest, bytes) else json.dumps(intact | manifest).encode()
            (path / checkpoint.MANIFEST).write_bytes(data)
            start = resumable._resume(run)
            assert int(start.state.timestep) == 60, data[:50]
            reason, chosen = shown[-2:]
            assert re.fullmatch(rf"skipped checkpoint {re.escape(str(path))}: [\w ,'.-]+", reason), reason
            assert chosen.endswith("0000000060")


def test_what_others_leave_among_the_checkpoints_stays_and_does_no_harm(stopped, whole):
    (stopped / checkpoint.FOLDER / ".DS_Store").write_text("stray")
    (stopped / checkpoint.FOLDER / "9999999999").write_text("stray")
    (stopped / checkpoint.FOLDER / "mine").mkdir()
    assert run_here("run", "--resume", stopped, "--checkpoint-every", 30) == 0
    assert steps_of(stopped) == [66, 96]
    names = {path.name for path in (stopped / checkpoint.FOLDER).iterdir()}
    assert names == {".DS_Store", "9999999999", "mine", "0000000066", "0000000096"}
    assert_same(stopped, whole)


def test_other_versions_are_told_and_listed(stopped, whole, monkeypatch, capsys):
    versions = folder.versions()
    with monkeypatch.context() as patch:
        patch.setattr(jax, "__version__", "0.0.1")
        patch.setattr(resumable, "progress", interrupt_after(4))
        assert run_here("run", "--resume", stopped, "--checkpoint-every", 0) == 130
        expected = (
            f"before t = 66 this run used jax {versions['jax']}; it resumes with jax 0.0.1, so its numbers may differ from "
        )
        assert f"\n{expected}those of an uninterrupted run\n" in capsys.readouterr().err
    entries = [{"timestep": 0, **versions}, {"timestep": 66, **versions, "jax": "0.0.1"}]
    assert list(folder.read_run(stopped).versions) == entries
    assert steps_of(stopped) == [66, 74]
    assert run_here("run", "--resume", stopped) == 0
    assert "before t = 74 this run used jax 0.0.1; it resumes with jax" in capsys.readouterr().err
    assert list(folder.read_run(stopped).versions) == [*entries, {"timestep": 74, **versions}]
    assert_same(stopped, whole)


def test_a_run_that_starts_again_starts_its_list_of_versions_again(stopped, whole):
    shutil.rmtree(stopped / checkpoint.FOLDER)
    run = folder.read_run(stopped)
    folder.write_config(run._replace(versions=({**run.versions[0], "jax": "0.0.1"},)), sealed=False)
    assert run_here("run", "--resume", stopped) == 0
    assert folder.read_run(stopped).versions == run.versions
    assert_same(stopped, whole)


def test_without_an_intact_checkpoint_nothing_is_touched(stopped, capsys):
    for path in (stopped / checkpoint.FOLDER).iterdir():
        flip(path)
    before = everything(stopped)
    assert run_here("run", "--resume", stopped) == 2
    assert "has no checkpoint that can be used" in capsys.readouterr().err.splitlines()[-1]
    assert everything(stopped) == before
    assert steps_of(stopped) == [60, 66]


def test_arrays_of_other_shapes_are_refused(stopped, whole):
    """Even where all digests fit: a checkpoint that orbax could restore, of another fleet."""
    config = folder.read_run(stopped).config
    identity = folder.identity(config, 3)
    shapes = shapes_of(config.replace(num_robots=5))
    found, refused = checkpoint.restore(stopped, identity, shapes, lambda notes: None)
    assert found is None
    assert len(refused) == 2
    found, refused = checkpoint.restore(stopped, identity, shapes_of(config), lambda notes: None)
    assert found is not None
    assert not refused
    assert int(found.state.timestep) == 66


def test_random_keys_and_empty_arrays_survive(tmp_path):
    state = {"keys": jax.random.split(jax.random.key(5), 3), "none": np.zeros((3, 0), np.float32), "timestep": np.int32(8)}

    class State(dict):
        timestep = state["timestep"]

    jax.tree_util.register_pytree_node(
        State, lambda s: (tuple(s.values()), tuple(s)), lambda names, values: State(zip(names, values, strict=True))
    )
    writer = checkpoint.Writer(tmp_path, {"seed": 1})
    for unfinished in ("9999999998", "9999999999"):
        (tmp_path / checkpoint.FOLDER / unfinished).mkdir(parents=True)
    writer.write(State(state), {})  # pyright: ignore[reportArgumentType]
    writer.wait()
    assert len(list((tmp_path / checkpoint.FOLDER).iterdir())) == len(steps_of(tmp_path)) == 1
    shapes = jax.eval_shape(lambda: State(jax.tree.map(jax.numpy.asarray, state)))
    found, refused = checkpoint.restore(tmp_path, {"seed": 1}, shapes, lambda notes: None)  # pyright: ignore[reportArgumentType]
    assert not refused
    assert found is not None
    assert jax.random.key_data(found.state["keys"]).tolist() == jax.random.key_data(state["keys"]).tolist()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--seed", "4"], "seed = 4, but the run has 3"),
        (["--num-robots", "5"], "num_robots = 5, but the run has 4"),
        (["--algorithm", "cu"], "algorithm = cu, but the run has cur"),
        (["--overwrite"], "omit --output and --overwrite"),
        (["--checkpoint-every", "1"], "checkpoint_every = 1 must be 0 (none) or at least 2"),
        (["--checkpoint-every", "-3"], "checkpoint_every = -3 must be"),
    ],
)
def test_flags_that_contradict_the_run_are_refused(whole, capsys, arguments, reason):
    before = contents(whole)
    assert reason in refused(capsys, "run", "--resume", whole, *arguments)
    assert contents(whole) == before


def test_what_is_no_run_or_of_a_newer_version_is_refused(stopped, capsys, tmp_path):
    assert "is not a run folder: it does not exist" in refused(capsys, "run", "--resume", tmp_path / "nowhere")
    assert "ENV is missing" in refused(capsys, "run")
    edit_config(stopped, lambda content: content["config"].update(flux=1))
    assert "unknown fields: flux (another version of fleetjax?)" in refused(capsys, "run", "--resume", stopped)


def test_a_folder_in_use_is_refused(stopped, whole, capsys):
    with files.lock(stopped):
        for arguments in (("run", "--resume", stopped), (*RUN, "--output", stopped, "--overwrite")):
            assert f"{stopped} is in use by process {os.getpid()}" in refused(capsys, *arguments)
    assert steps_of(stopped) == [60, 66]
    assert run_here("run", "--resume", stopped) == 0
    assert not (stopped / files.LOCK).exists()
    assert_same(stopped, whole)


def test_a_finished_run_that_lacks_a_file_is_not_called_finished(whole, tmp_path, capsys):
    path = Path(shutil.copytree(whole, tmp_path / "copy"))
    remedy = f"run it from the start: fleetjax run navigation ... --output {path} --overwrite"
    for name in RESULTS:
        data = (path / name).read_bytes()
        (path / name).unlink()
        said = refused(capsys, "run", "--resume", path)
        assert f"{path / name} is missing" in said
        assert remedy in said
        (path / name).write_bytes(data[:-1] + b"?")
        said = refused(capsys, "run", "--resume", path)
        assert f"{path / name} cannot be used: its SHA-256" in said
        assert remedy in said
        (path / name).write_bytes(data)
    run = folder.read_run(path)
    for name in ("policy.msgpack", "interventions.bin"):  # as if it had not been there when the run was sealed
        data = (path / name).read_bytes()
        (path / name).unlink()
        folder.write_config(run, sealed=True)
        assert f"{path / name} is missing" in refused(capsys, "run", "--resume", path)
        (path / name).write_bytes(data)
        said = refused(capsys, "run", "--resume", path)
        assert f"{path / name} cannot be used: its SHA-256 digest is not in config.json" in said
        assert remedy in said
        folder.write_config(run, sealed=True)
    assert run_here("run", "--resume", path) == 0
    assert "is already finished" in capsys.readouterr().err


def everything(path: Path) -> dict[str, bytes]:
    """Return the files of a folder, and of its folders, by path; a lock is none of them."""
    found = [file for file in path.rglob("*") if file.is_file() and file.name != files.LOCK]
    return {str(file.relative_to(path)): file.read_bytes() for file in found}


OVERWRITE = ("run", "navigation", *TINY, "--seed", "4", "--overwrite", "--output")


def test_a_run_that_cannot_begin_overwrites_nothing(stopped):
    before = everything(stopped)
    with contextlib.suppress(TypeError):  # if validation lets it pass, its shapes do not
        assert run_here(*OVERWRITE, stopped, "--supervisor", "humanoid") == 2
    assert everything(stopped) == before


@pytest.mark.parametrize("where", ["start", "run_chunks"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_what_stops_a_run_before_its_first_chunk_overwrites_nothing(stopped, monkeypatch, capsys, where, error):
    before, seen = everything(stopped), []

    def stop(*arguments, **options):
        seen.append(everything(stopped))  # what a kill would leave
        raise error

    monkeypatch.setattr(chunks, where, stop)
    if error is RuntimeError:
        with pytest.raises(RuntimeError):
            run_here(*OVERWRITE, stopped)
    else:
        assert run_here(*OVERWRITE, stopped) == 130
        assert f"interrupted before the first timestep; {stopped} is unchanged" in capsys.readouterr().err
    assert seen == [before]
    assert everything(stopped) == before


def test_an_older_run_goes_with_the_first_chunk_and_ctrl_c_in_it_still_spares_it(stopped, monkeypatch):
    before, real = everything(stopped), chunks.run_chunks

    def run_chunks(*arguments, **options):
        for number, chunk in enumerate(real(*arguments, **options)):
            assert (everything(stopped) == before) == (number == 0)
            if interrupted:
                signal.raise_signal(signal.SIGINT)
            yield chunk

    monkeypatch.setattr(chunks, "run_chunks", run_chunks)
    for interrupted, code in ((True, 130), (False, 0)):
        assert run_here(*OVERWRITE, stopped) == code
        assert (everything(stopped) == before) == interrupted
    assert folder.read_run(stopped).seed == 4
    assert not (stopped / checkpoint.FOLDER).exists()
    assert set(contents(stopped)) == {"config.json", "metrics.csv", "figure.png", "policy.msgpack"}


def test_a_run_that_is_stopped_before_its_first_checkpoint_is_read_resumes_later(stopped, whole, monkeypatch):
    before = everything(stopped)
    with monkeypatch.context() as patch:
        patch.setattr(resumable, "state_shapes", lambda *arguments: (_ for _ in ()).throw(KeyboardInterrupt))
        assert run_here("run", "--resume", stopped) == 130
    assert everything(stopped) == before
    assert run_here("run", "--resume", stopped) == 0
    assert_same(stopped, whole)


def test_a_policy_that_diverges_ends_the_run_and_says_when(stopped, capsys):
    """One member's weights are spoilt in a checkpoint; the run ends behind the next chunk, with its metrics so far."""
    run = folder.read_run(stopped)
    identity, shapes = folder.identity(run.config, 3), shapes_of(run.config)
    found, _ = checkpoint.restore(stopped, identity, shapes, lambda notes: None)
    assert found is not None
    learner = found.state.policy
    spoilt = learner._replace(params=jax.tree.map(lambda x: x.at[1].set(np.nan), learner.params))
    writer = checkpoint.Writer(stopped, identity)
    writer.write(found.state._replace(policy=spoilt), found.notes)
    writer.wait()
    assert run_here("run", "--resume", stopped) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    told = r"fleetjax: the policy (has|and the safety critic have) NaN or infinite numbers from t = 66 on"
    assert re.match(told, line)
    assert f"The metrics so far are in {stopped}" in line
    assert len(folder.read_metrics(folder.read_run(stopped)).successes) == 68
    assert steps_of(stopped) == [60, 66]


# Other processes, which can be killed


@pytest.fixture(scope="module")
def spawn(tmp_path_factory):
    """A function that starts the command line in a process; compiled programs are kept, so that starts are quick."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs"))}
    cache |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0"}

    def spawn(*arguments: object, largest_file: int = resource.RLIM_INFINITY) -> subprocess.Popen[str]:
        limit = f"import resource, runpy; resource.setrlimit(resource.RLIMIT_FSIZE, ({largest_file},) * 2)"
        command = [sys.executable, "-c", f"{limit}; runpy.run_module('fleetjax', run_name='__main__')", *map(str, arguments)]
        return subprocess.Popen(command, env=os.environ | cache, text=True, stderr=subprocess.PIPE)

    return spawn


def wait_for(condition, process) -> bool:
    """Wait until a condition holds; return whether it did before the process ended."""
    while process.poll() is None:
        if condition():
            return True
        time.sleep(5e-4)
    return False


def rows(path: Path) -> int:
    return (path / "metrics.csv").read_bytes().count(b"\n") - 1 if (path / "metrics.csv").exists() else 0


@pytest.mark.slow
def test_kills_at_random_moments_lose_no_bit(tmp_path, whole, spawn):
    path, rng = tmp_path / "killed", np.random.default_rng(0)
    arguments, resumed = (*RUN, "--output", path, "--checkpoint-every", 10), 0
    for wanted in (int(rng.integers(11, 50)), 80):
        wanted = max(wanted, rows(path) + 1)  # by this process
        process = spawn(*arguments)
        with contextlib.ExitStack() as stack:
            stack.callback(process.kill)
            if wait_for(lambda wanted=wanted: rows(path) >= wanted, process):
                time.sleep(rng.uniform(0, 0.02))
                process.kill()
            _, said = process.communicate()
        resumed += "resuming from" in said
        arguments = ("run", "--resume", path, "--checkpoint-every", 10)
    process = spawn(*arguments)
    _, said = process.communicate()
    assert process.returncode == 0, said
    assert resumed + ("resuming from" in said) == 2
    assert_same(path, whole)


def test_a_kill_during_a_checkpoint_leaves_the_older_ones(stopped, whole, spawn, capsys):
    before = steps_of(stopped)

    def half_written() -> bool:
        return not (newest(stopped) / checkpoint.MANIFEST).exists()

    for _ in range(5):
        process = spawn("run", "--resume", stopped, "--checkpoint-every", 6)
        if wait_for(half_written, process):
            process.kill()
        process.communicate()
        if half_written():
            break
    assert half_written()
    assert before[0] in steps_of(stopped) or len(steps_of(stopped)) >= 2
    assert run_here("run", "--resume", stopped) == 0
    said = capsys.readouterr().err
    assert "it was never finished" in said
    assert "resuming from" in said
    assert_same(stopped, whole)


@pytest.mark.slow
def test_a_full_disk_during_a_checkpoint_is_told_and_the_older_ones_stay(tmp_path, monkeypatch, whole, spawn):
    """Files may grow to a size that the logs need until t = 44, and that is too small for a checkpoint."""
    path, size = tmp_path / "stopped", (whole / "interventions.bin").stat().st_size * 44 // STEPS
    with monkeypatch.context() as patch:
        patch.setattr(resumable, "progress", interrupt_after(15))
        assert run_here(*RUN, "--output", path, "--checkpoint-every", 20) == 130
    assert steps_of(path) == [20, 30]
    assert largest(newest(path)).stat().st_size > size > (whole / "metrics.csv").stat().st_size
    process = spawn("run", "--resume", path, "--checkpoint-every", 6, largest_file=size)
    _, said = process.communicate()
    assert process.returncode == 2
    assert "fleetjax: the checkpoint at t = 36 could not be written" in said.splitlines()[-1]
    assert "Traceback" not in said
    assert steps_of(path) == [20, 30]
    assert run_here("run", "--resume", path) == 0
    assert_same(path, whole)


@pytest.mark.slow
def test_a_full_disk_during_the_run_is_told_and_the_run_goes_on_later(stopped, whole, spawn):
    size = (stopped / "interventions.bin").stat().st_size + 100
    process = spawn("run", "--resume", stopped, "--checkpoint-every", 0, largest_file=size)
    _, said = process.communicate()
    assert process.returncode == 2
    assert "File too large" in said.splitlines()[-1]
    assert str(stopped) in said.splitlines()[-1]
    assert "Traceback" not in said
    assert run_here("run", "--resume", stopped) == 0
    assert_same(stopped, whole)


def test_a_block_within_another_hears_what_was_asked_before_it():
    with resumable.stoppable() as outer:
        signal.raise_signal(signal.SIGTERM)
        assert outer()
        with resumable.stoppable() as inner:
            assert inner()
            with pytest.raises(KeyboardInterrupt, match="at once"):
                signal.raise_signal(signal.SIGTERM)
    with resumable.stoppable() as later:
        assert not later()
        with resumable.stoppable() as inner:
            signal.raise_signal(signal.SIGTERM)
        assert later()
