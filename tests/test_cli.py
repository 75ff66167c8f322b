"""The command line: what it prints and writes, and that its chunks change nothing."""

import io
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
from commands import STEPS, TINY, contents, refused

import fleetjax
from fleetjax import cli
from fleetjax.io import chunks, export, figure, files, folder, metrics_csv, render, resumable


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished run; whoever changes it takes a copy."""
    path = tmp_path_factory.mktemp("runs") / "finished"
    assert cli.main(["run", "navigation", *TINY, "--seed", "3", "--output", str(path)]) == 0
    return path


@pytest.fixture
def copied(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def test_a_run_folder_holds_all_that_was_asked_for(finished):
    assert set(contents(finished)) == {"config.json", "metrics.csv", "figure.png", "policy.msgpack"}
    config = folder.read_run(finished).config
    assert (config.num_robots, config.num_humans, config.hidden_sizes, int(config.hard_reset_time)) == (4, 2, (8,), 2)
    assert len(pd.read_csv(finished / "metrics.csv")) == STEPS


def test_chunks_give_the_run_that_the_library_gives(finished):
    run = folder.read_run(finished)
    whole = jax.jit(fleetjax.run)(run.config, jax.random.key(3))
    assert np.sum(whole.metrics.hard_resets) > 0
    assert np.sum(whole.metrics.teleop_steps) > 0
    for name, chunked, expected in zip(fleetjax.Metrics._fields, folder.read_metrics(run), whole.metrics, strict=True):
        if name in metrics_csv.REALS:
            np.testing.assert_allclose(chunked, expected, rtol=1e-4, atol=1e-5, err_msg=name)
        else:
            np.testing.assert_array_equal(chunked, expected, err_msg=name)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5),
        folder.read_policy(run).params,
        whole.state.policy.params,
    )


def test_the_same_seed_gives_the_same_files_and_a_table(finished, copied, capsys):
    assert cli.main(["run", "navigation", *TINY, "--seed", "3", "--output", str(copied), "--overwrite"]) == 0
    printed = capsys.readouterr()
    metrics = folder.read_metrics(folder.read_run(finished))
    for name in ("successes", "violations", "hard resets", "idle time", "human time", "switches", "decided by risk", "ROHE"):
        assert f"\n{name} " in printed.out
    assert ["human", "time", str(metrics.human_steps.sum())] in [line.split()[:3] for line in printed.out.splitlines()]
    assert str(copied) in printed.out
    assert "compiling and pre-training" in printed.err.splitlines()[1]
    assert printed.err.splitlines()[-1].startswith("100% ")
    for name in ("metrics.csv", "policy.msgpack", "figure.png"):
        assert (copied / name).read_bytes() == (finished / name).read_bytes()


@pytest.mark.slow
def test_default_folders_are_made_below_runs_and_never_used_again(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(folder.time, "strftime", lambda form: "now")
    for seed in (3, 4, 4):
        assert cli.main(["run", "navigation", *TINY, "--seed", str(seed)]) == 0
    names = ["navigation-cur-seed3-now", "navigation-cur-seed4-now", "navigation-cur-seed4-now-2"]
    assert sorted(path.name for path in Path("runs").iterdir()) == names
    same, other = ((Path("runs") / name / "metrics.csv").read_bytes() for name in names[:2])
    assert same == (finished / "metrics.csv").read_bytes() != other
    capsys.readouterr()
    assert cli.main(["plot", *(f"runs/{name}" for name in names), "--output", "all.svg"]) == 0
    printed = capsys.readouterr()
    assert printed.out == "all.svg\n"
    assert printed.err == "skipped 1 run with the same settings and seed as a later one\n"
    assert "mean of 2 seeds" in Path("all.svg").read_text()


def test_ctrl_c_before_the_first_timestep_leaves_nothing(tmp_path):
    listen = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # a background shell's children ignore it
    program = f"import signal, sys; {listen}; from fleetjax.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "run", "navigation", "--output", str(tmp_path / "new" / "run")]
    process = subprocess.Popen(command, text=True, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stderr is not None
    assert "C.U.R. on navigation" in process.stderr.readline()
    assert "compiling and pre-training" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert (process.returncode, out) == (130, "")
    assert err == "fleetjax: interrupted before the first timestep; nothing was kept\n"
    assert not (tmp_path / "new" / "run").exists()


@pytest.mark.slow
def test_evaluation_is_the_librarys(copied, capsys):
    assert cli.main(["evaluate", str(copied), "--num-steps", "16", "--seed", "9"]) == 0
    printed = capsys.readouterr()
    run = folder.read_run(copied)
    config = run.config.replace(num_steps=16)
    expected = jax.jit(fleetjax.evaluate)(config, jax.random.key(9), folder.read_policy(run)).metrics
    stored = json.loads((copied / "evaluation.json").read_text())
    assert (stored["num_steps"], stored["seed"]) == (16, 9)
    for name in ("successes", "violations", "hard_resets", "idle", "human_steps", "moving"):
        assert stored["totals"][name] == np.sum(getattr(expected, name)), name
    totals = [str(np.sum(x)) for x in (expected.successes, expected.violations, expected.idle)]
    assert printed.out.splitlines()[-1].split() == ["C.U.R.", *totals]
    assert "ROHE" not in printed.err
    before = contents(copied)
    assert "evaluation.json already exists" in refused(capsys, "evaluate", copied)
    assert contents(copied) == before
    assert cli.main(["evaluate", str(copied), "--num-steps", "16", "--overwrite"]) == 0
    assert json.loads((copied / "evaluation.json").read_text())["seed"] == 4  # not the training's 3


def test_an_evaluation_is_shown_even_if_it_cannot_be_stored(copied, monkeypatch, capsys):
    full = OSError(28, "No space left on device", "evaluation.json")
    monkeypatch.setattr(files, "write_json", lambda *arguments: (_ for _ in ()).throw(full))
    assert cli.main(["evaluate", str(copied), "--num-steps", "16"]) == 2
    printed = capsys.readouterr()
    assert printed.out.splitlines()[-1].startswith("C.U.R. ")
    assert printed.err.splitlines()[-1] == "fleetjax: evaluation.json: No space left on device"


def test_an_output_that_is_a_link_counts_and_its_target_is_written(copied, tmp_path, capsys):
    link, target = tmp_path / "link.svg", tmp_path / "elsewhere" / "figure.svg"
    target.parent.mkdir()
    link.symlink_to(target)
    for _ in range(2):  # a dangling link, then one that leads to a file
        assert f"{link} already exists" in refused(capsys, "plot", copied, "--output", link)
        assert cli.main(["plot", str(copied), "--output", str(link), "--overwrite"]) == 0
        assert capsys.readouterr().out == f"{link}\n"
        assert link.readlink() == target
        assert target.read_bytes().startswith(b"<?xml")


def fail(*arguments, **options):
    raise AssertionError("something was computed")


def test_outputs_that_cannot_be_written_are_refused_before_anything_is_computed(copied, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(render, "start", fail)
    monkeypatch.setattr(figure, "draw", fail)
    monkeypatch.setattr(chunks, "start_evaluation", fail)
    monkeypatch.setattr(folder, "read_interventions", lambda run: [])
    monkeypatch.setattr(export, "export", fail)
    file = tmp_path / "file"
    file.touch()
    commands = {"png": ("plot", copied), "gif": ("render", "navigation"), "hdf5": ("export", copied, "--format", "robomimic")}
    for suffix, command in commands.items():
        taken = tmp_path / f"taken.{suffix}"
        taken.mkdir()
        places = {
            tmp_path / "nowhere" / f"x.{suffix}": f"{tmp_path / 'nowhere'} does not exist",
            file / f"x.{suffix}": f"{file} is not a folder",
            Path(f"/proc/x.{suffix}"): f"/proc/x.{suffix} cannot be written: No such file or directory",
            taken: f"{taken} is a folder",
        }
        for output, reason in places.items():
            assert reason in refused(capsys, *command, "--output", output, "--overwrite")
    assert f"{file} is a file" in refused(capsys, "export", copied, "--format", "minari", "--output", file, "--overwrite")
    before = contents(copied)
    read_only = OSError(30, "Read-only file system")
    monkeypatch.setattr(files.tempfile, "NamedTemporaryFile", lambda **options: (_ for _ in ()).throw(read_only))
    said = refused(capsys, "evaluate", copied)
    assert f"{copied / 'evaluation.json'} cannot be written: Read-only file system" in said
    assert contents(copied) == before


def test_characters_that_an_encoding_lacks_are_replaced(copied, tmp_path, monkeypatch):
    path = copied.rename(tmp_path / "rün")
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), "ascii", write_through=True))
    assert cli.main(["plot", str(path), "--output", str(path / "all.svg")]) == 0
    assert cli.main(["plot", str(path), "--output", str(path / "all.svg")]) == 2
    for stream, end in ((sys.stdout, b"r?n/all.svg"), (sys.stderr, b"replace it")):
        shown = stream.buffer.getvalue()
        assert b"r?n" in shown
        assert shown.strip().endswith(end)


RUN = ("run", "navigation")


def test_existing_folders_and_files_are_not_overwritten(copied, tmp_path, capsys):
    before = contents(copied)
    assert "already exists" in refused(capsys, *RUN, *TINY, "--output", copied)
    file = tmp_path / "figure.png"
    file.write_text("precious")
    assert "already exists" in refused(capsys, *RUN, "--output", file)
    assert "already exists" in refused(capsys, "plot", copied, "--output", file)
    assert "is not a run folder" in refused(capsys, *RUN, "--output", file, "--overwrite")
    assert file.read_text() == "precious"
    assert contents(copied) == before


def test_damaged_runs_and_impossible_evaluations_are_refused(copied, capsys, tmp_path):
    assert "num_steps = 0 must be at least 1" in refused(capsys, "evaluate", copied, "--num-steps", 0)
    policy = copied / "policy.msgpack"
    data = bytearray(policy.read_bytes())
    data[len(data) // 2] ^= 4
    policy.write_bytes(data)
    assert "SHA-256" in refused(capsys, "evaluate", copied)
    assert "evaluation.json" not in contents(copied)
    config = fleetjax.make_config("navigation", "expert", num_robots=2)
    (tmp_path / "expert").mkdir()
    folder.create(folder.Run(tmp_path / "expert", config, 0))
    assert "trains no policy" in refused(capsys, "evaluate", tmp_path / "expert")
    (copied / "config.json").write_text("{}")
    for command in ("plot", "evaluate"):
        assert f"{copied / 'config.json'} cannot be used" in refused(capsys, command, copied)


def help_of(capsys, *arguments: str) -> str:
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 0
    return " ".join(capsys.readouterr().out.split())


def test_help_tells_every_parameter_with_meaning_unit_and_default(capsys):
    shown = help_of(capsys, "run", "--help")
    for name, field in fleetjax.config.FIELDS.items():
        if name != "environment":
            assert f"--{name.replace('_', '-')}" in shown
            assert f"{field.help}{f' ({field.unit})' if field.unit else ''} [default: " in shown
    assert "operation time T (timesteps) [default: 10000; block_push 250; navigation 2000]" in shown
    assert "units of the hidden layers of policy and critics [default: 256 256; block_push 128; navigation 64 64]" in shown
    assert "--no-normalize-observations" in shown


def test_help_of_an_environment_tells_its_defaults(capsys):
    shown = help_of(capsys, "run", "navigation", "--help")
    assert "parameters (defaults of navigation)" in shown
    assert "operation time T (timesteps) [default: 2000]" in shown


def test_help_and_version_greet(capsys):
    assert "fleetjax run humanoid" in help_of(capsys)
    for command in ("run", "list", "plot", "evaluate"):
        assert f" {command} " in help_of(capsys, "--help")
    assert help_of(capsys, "--version") == f"fleetjax {fleetjax.__version__}"


def test_list_shows_environments_and_algorithms(capsys):
    assert cli.main(["list"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["humanoid", "108", "21", "999", "no"] in [line[:4] + line[6:] for line in lines]
    assert ["navigation", "8", "2", "250", "100.0", "ms", "yes"] in lines
    for name in ("constraint", "random", "ensemble_dagger", "thrifty_dagger", "expert", "cur"):
        assert any(line[:1] == [name] for line in lines)
    assert lines[-1][:4] == ["and", "any", "order", "of"]


def test_parameters_arrive_as_they_are_typed(monkeypatch, tmp_path):
    made = []
    monkeypatch.chdir(tmp_path)

    def operate(run, **options):
        made.append((run.config, run.seed))
        raise OSError("stop here")

    monkeypatch.setattr(resumable, "run_in_folder", operate)
    flags = ["--hidden-sizes", "16", "8", "--no-normalize-observations", "--num-steps", "1e3", "--risk-threshold", ".25"]
    fleet = ["--algorithm", "expert", "--num-robots", "7", "--backend", "native"]
    assert cli.main(["run", "navigation", *fleet, "--seed", "4294967295", *flags]) == 2
    (config, seed), *_ = made
    assert (config.hidden_sizes, config.num_steps, config.backend) == ((16, 8), 1000, "native")
    assert (config.num_robots, config.num_humans, seed) == (7, 7, 2**32 - 1)
    assert not config.normalize_observations
    assert config.risk_threshold == 0.25
