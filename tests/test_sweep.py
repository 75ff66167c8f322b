"""Many runs with one command: which they are, what is refused, and that stops and kills lose nothing."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import contents, own_lines, refused

from fleetjax import checks, cli
from fleetjax.io import chunks, crew, files, flags, folder, group, metrics_csv, place, resumable, study, sweep
from fleetjax.io.errors import Diverged

STEPS = 2000
LONG = 5 * STEPS
TINY = [
    *("--num-robots", "2", "--num-humans", "2", "--num-steps", str(STEPS), "--hard-reset-time", "2"),
    *("--hidden-sizes", "8", "--ensemble-size", "2", "--batch-size", "8", "--critic-capacity", "300"),
    *("--num-demonstrations", "20", "--pretraining-steps", "5", "--checkpoint-every", "100"),
]
RESULTS = ("metrics.csv", "policy.msgpack")


def planned(*arguments: object, output: Path = Path("out")) -> dict[str, folder.Run]:
    """Return the runs of a sweep by the names of their folders."""
    asked = flags.parse(["sweep", *map(str, arguments), "--output", str(output)])
    runs = study.plan(study.make_study([name for names in asked.subjects for name in names], vars(asked)))
    assert {run.folder.parent for run in runs} == {output}
    return {run.folder.name: run for run in runs}


def settings(runs: dict[str, folder.Run]) -> dict[str, dict]:
    return {name: folder.identity(run.config, run.seed) | {"logged": run.logged} for name, run in runs.items()}


# Which runs there are


def test_a_sweep_is_the_product_of_its_lists_and_names_say_what_differs():
    runs = planned("navigation", "block_push", "--algorithm", "cur,uc", "--num-humans", "1,2", "--num-robots", 3, "--seeds", 2)
    assert list(runs) == [
        f"{environment}-{algorithm}-num_humans={humans}-seed{seed}"
        for environment in ("navigation", "block_push")
        for algorithm in ("cur", "uc")
        for humans in (1, 2)
        for seed in (0, 1)
    ]
    run = runs["block_push-uc-num_humans=2-seed1"]
    config = run.config
    assert (config.environment, config.algorithm, config.num_humans, run.seed) == ("block_push", "uc", 2, 1)
    assert config.num_robots == 3
    assert list(planned("navigation")) == ["navigation-cur-seed0"]
    assert list(planned("navigation", "--seed", "7,3")) == ["navigation-cur-seed7", "navigation-cur-seed3"]


def test_folders_of_many_values_have_short_names_of_their_own(tmp_path):
    for name, last in (("one", 1.5), ("other", 2.5)):
        (tmp_path / name).write_text(" ".join(["12.5"] * 59 + [str(last)]))
    lists = f"@{tmp_path / 'one'},@{tmp_path / 'other'},5"
    names = list(planned("navigation", "--num-robots", 60, "--num-humans", 60, "--takeover-time", lists))
    assert len(set(names)) == 3
    assert all(len(name) < 100 for name in names)
    assert [name.split("=")[1][:9] for name in names] == ["60_values", "60_values", "5.0-seed0"]
    (tmp_path / "two").write_text("1 2")
    names = list(planned("navigation", "--num-humans", 2, "--takeover-time", f"@{tmp_path / 'two'},5"))
    assert names == ["navigation-cur-takeover_time=1.0x2.0-seed0", "navigation-cur-takeover_time=5.0-seed0"]


def test_a_parameter_of_one_algorithm_is_given_to_it_alone():
    runs = planned("navigation", "--algorithm", "cur,random", "--random-threshold", "0.5,0.75")
    names = ["navigation-cur-seed0", "navigation-random-random_threshold=0.5-seed0"]
    assert list(runs) == [*names, "navigation-random-random_threshold=0.75-seed0"]
    assert "random_threshold" not in runs[names[0]].config.parameters
    assert runs[names[1]].config.parameters["random_threshold"] == 0.5


def test_tuples_and_switches_come_in_lists_too():
    runs = planned("navigation", "--hidden-sizes", "64", "32,16", "--normalize-observations", "on,off")
    sizes = {run.config.hidden_sizes for run in runs.values()}
    assert sizes == {(64, 32), (16,)}
    assert next(iter(runs)) == "navigation-cur-hidden_sizes=64x32-normalize_observations=on-seed0"
    assert [bool(run.config.normalize_observations) for run in runs.values()] == [True, False] * 2
    (run,) = planned("navigation", "--hidden-sizes", "64", "32", "--no-normalize-observations").values()
    assert (run.config.hidden_sizes, bool(run.config.normalize_observations)) == ((64, 32), False)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_file_is_the_same_as_flags_and_flags_override_it(tmp_path):
    file = write(
        tmp_path / "study.toml",
        """
        environment = ["navigation", "block_push"]
        algorithm = ["cur", "random"]
        seeds = 2
        num_humans = 1
        learning-rate = [1e-3, 1e-4]
        random_threshold = [0.5]
        hidden_sizes = [[8], [8, 4]]
        log_interventions = true
        """,
    )
    lists = ("--num-humans", 1, "--learning-rate", "1e-3,1e-4", "--random-threshold", 0.5, "--hidden-sizes", "8,8", 4)
    typed = ("--algorithm", "cur,random", "--seeds", 2, *lists, "--log-interventions")
    assert settings(planned(file)) == settings(planned("navigation", "block_push", *typed))
    shorter = ("--algorithm", "cur", "--seed", 5, "--learning-rate", "1e-4", "--hidden-sizes", 16, 8)
    assert settings(planned(file, "navigation", "--random-threshold", 0.5, *shorter, "--algorithm", "cur,random")) == settings(
        planned(
            "navigation",
            "--random-threshold",
            0.5,
            "--num-humans",
            1,
            "--log-interventions",
            *shorter,
            "--algorithm",
            "cur,random",
        )
    )


def test_a_file_may_have_parts_with_the_top_as_their_defaults(tmp_path):
    file = write(
        tmp_path / "study.toml",
        """
        output = "elsewhere"
        workers = 3
        environment = "navigation"
        num_robots = 20
        seeds = 2
        [[runs]]
        algorithm = ["cur", "random"]
        random_threshold = 0.5
        [[runs]]
        algorithm = "expert"
        num_robots = 4
        hidden_sizes = [8, 4]
        seed = 9
        """,
    )
    asked = study.make_study([str(file)], {})
    assert (asked.output, asked.workers, asked.checkpoint_every) == (Path("elsewhere"), 3, 1000)
    runs = planned(file)
    assert list(runs) == [
        "navigation-cur-num_robots=20-seed0",
        "navigation-cur-num_robots=20-seed1",
        "navigation-random-random_threshold=0.5-num_robots=20-seed0",
        "navigation-random-random_threshold=0.5-num_robots=20-seed1",
        "navigation-expert-num_robots=4-hidden_sizes=8x4-seed9",
    ]
    assert [run.config.num_robots for run in runs.values()] == [20, 20, 20, 20, 4]


def test_the_study_of_the_documentation_is_one(tmp_path):
    page = (Path(__file__).parents[1] / "docs" / "sweeps.md").read_text()
    runs = planned(write(tmp_path / "study.toml", page.split("```toml\n")[1].split("```")[0]))
    assert len(runs) == 2 * 5 * (2 * 2 + 1)


NAV = "navigation"
BAD = {
    "M > N": (
        (NAV, "--num-robots", "4,2", "--num-humans", 3),
        "navigation, cur, num_robots 2: num_humans = 3 is more than num_robots",
    ),
    "no goal": (
        ("humanoid", "--algorithm", "cur,thrifty_dagger"),
        "humanoid, thrifty_dagger: algorithm = 'thrifty_dagger' needs",
    ),
    "environment": (("humanoit",), "humanoit, cur: environment = 'humanoit' is unknown; the closest are humanoid"),
    "algorithm": ((NAV, "--algorithm", "cur,ensemble"), "algorithm = 'ensemble' is unknown; the closest are ensemble_dagger"),
    "flag": ((NAV, "--num-robot", "4,5"), "unknown flag --num-robot; the closest is --num-robots"),
    "nobody's": ((NAV, "--random-threshold", 0.5), "random_threshold is a parameter of algorithm = 'random'; omit it, or add"),
    "twice": ((NAV, "--num-robots", "4,4"), "num_robots lists 4 twice; omit one"),
    "environment twice": ((NAV, NAV), "environment lists 'navigation' twice; omit one"),
    "seed twice": ((NAV, "--seed", "4,4"), "seed lists 4 twice; omit one"),
    "same number": ((NAV, "--risk-threshold", "0.1,0.1000000001"), "is in the sweep twice; omit one"),
    "empty": ((NAV, "--algorithm", ""), "--algorithm: '' has an empty entry"),
    "empty entry": ((NAV, "--num-robots", "4,,5"), "--num-robots: '4,,5' has an empty entry"),
    "empty tuple": ((NAV, "--hidden-sizes", "8,"), "--hidden-sizes: '8,' has an empty entry"),
    "no number": ((NAV, "--num-robots", "4,many"), "--num-robots: 'many' must be a number"),
    "no switch": ((NAV, "--normalize-observations", "yes"), "--normalize-observations: 'yes' must be on or off"),
    "no seeds": ((NAV, "--seeds", 0), "seeds = 0 must be a whole number from 1"),
    "both seeds": ((NAV, "--seeds", 2, "--seed", 4), "seed and seeds contradict each other"),
    "workers": ((NAV, "--workers", 0), "workers = 0 must be at least 1"),
    "checkpoints": ((NAV, "--checkpoint-every", 1), "checkpoint_every = 1 must be 0 (none) or at least 2"),
    "memory": ((NAV, "--hidden-sizes", 8, "8,1000000000", 1000000000), "hidden_sizes = (1000000000, 1000000000) is too large"),
    "launcher": ((NAV, "--launcher", "condor"), "invalid choice: 'condor' (choose from"),
    "jobs without": ((NAV, "--jobs", 2), "jobs is an option of a launcher; add launcher = 'slurm', or omit it"),
    "no jobs": ((NAV, "--launcher", "local", "--jobs", 0), "jobs = 0 must be at least 1"),
    "lease": ((NAV, "--launcher", "local", "--lease", 0), "lease = 0 must be at least 1 second"),
    "GPU": ((NAV, "--launcher", "local", "--slurm-gpu"), "slurm_gpu is an option of launcher = 'slurm'; omit it"),
    "no group": ((NAV, "--seeds-per-program", 0), "seeds_per_program = 0 must be at least 1"),
    "large group": (
        (NAV, "--seeds", 2, "--seeds-per-program", 3),
        "seeds_per_program = 3 is more than the number of seeds, 2",
    ),
    "checkpoints of a group": (
        (NAV, "--seeds", 2, "--seeds-per-program", 2, "--checkpoint-every", 100),
        "checkpoint_every = 100 has no effect with seeds_per_program = 2: runs side by side write no checkpoints; omit one",
    ),
    "both": ((NAV, "--launcher", "local", "--workers", 2), "workers are processes of this machine; with a launcher, give jobs"),
    "partition": (
        (NAV, "--launcher", "local", "--slurm-partition", "gpu"),
        "slurm_partition is an option of launcher = 'slurm'",
    ),
    "time": ((NAV, "--launcher", "slurm", "--slurm-time", 5), "slurm_time = 5 must be at least 15 minutes"),
    "no cluster": ((NAV, "--launcher", "slurm"), "launcher = 'slurm' needs SLURM, and this machine has no srun"),
    "files": (("a.toml", "b.toml"), "a.toml and b.toml are two files"),
    "no file": (("nowhere.toml",), "nowhere.toml does not exist"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_sweeps_cost_one_line_and_touch_nothing(name, capsys, tmp_path):
    arguments, reason = BAD[name]
    assert reason in refused(capsys, "sweep", "--output", tmp_path / "out", *arguments)
    assert not (tmp_path / "out").exists()


BAD_FILES = {
    "syntax": ("environment = [", "cannot be used: "),
    "name": ("num_robot = 4", "parameter = 'num_robot' is unknown; the closest are num_robots"),
    "empty": ("num_robots = []", "num_robots = [] is empty; give at least one value"),
    "empty tuple": ("hidden_sizes = []", "hidden_sizes = [] is empty"),
    "kind": ("num_robots = [40, 'five']", "navigation, cur, num_robots five: num_robots = 'five' must be"),
    "table": ("num_robots = { low = 4 }", "num_robots = {'low': 4} must be"),
    "seed": ("seed = [0, -1]", "seed = [0, -1] must hold whole numbers from 0"),
    "seeds": ("seeds = [1, 2]", "seeds = [1, 2] must be a whole number"),
    "option": ("workers = '2'", "workers = '2' must be of type int"),
    "runs": ("runs = 4", "runs must be [[runs]] blocks"),
    "part": ("[[runs]]\nalgoritm = 'cur'", "parameter = 'algoritm' is unknown; the closest are algorithm"),
    "same parts": ("[[runs]]\nseeds = 2\n[[runs]]\nseed = 1", "navigation-cur-seed1 is in the sweep twice; omit one"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_cost_one_line_and_touch_nothing(name, capsys, tmp_path):
    content, reason = BAD_FILES[name]
    file = write(tmp_path / "study.toml", f"environment = 'navigation'\n{content}")
    assert reason in refused(capsys, "sweep", file, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_sweep_needs_an_environment_and_a_folder_of_its_own(capsys, tmp_path):
    assert "ENV is missing" in refused(capsys, "sweep", "--output", tmp_path / "out")
    assert "--output is missing; name a folder for the runs" in refused(capsys, "sweep", "navigation")
    (tmp_path / ".sweep.json.partial").touch()  # as a kill may leave it
    assert files.is_unused(tmp_path)
    (tmp_path / "precious").touch()
    assert "is not the folder of a sweep" in refused(capsys, "sweep", "navigation", "--output", tmp_path)
    assert f"{tmp_path / 'precious'} already exists" in refused(
        capsys, "sweep", "navigation", "--output", tmp_path / "precious"
    )
    (tmp_path / "out").mkdir()
    for damaged in ("", "{}", "[]", '{"runs": [4], "log_interventions": false}'):
        (tmp_path / "out" / sweep.FILE).write_text(damaged)
        said = refused(capsys, "sweep", "navigation", "--output", tmp_path / "out")
        assert f"{tmp_path / 'out' / sweep.FILE} cannot be used: " in said


# Who does what


def test_workers_keep_their_program_and_help_others_when_it_is_done():
    runs = planned("navigation", "--algorithm", "cur,uc,c", "--risk-threshold", "0.1,0.2", "--seeds", 2).values()
    groups = study.groups(list(runs), 1)
    assert groups == [(run,) for run in runs]
    by_algorithm = {name: [group for group in groups if group[0].config.algorithm == name] for name in ("cur", "uc", "c")}
    cur, uc, c = (study.program(by_algorithm[name][0]) for name in by_algorithm)
    assert {study.program(group) for group in by_algorithm["cur"]} == {cur}
    assert len({cur, uc, c}) == 3
    assert crew.choose(groups, None, []) == by_algorithm["cur"][0]
    assert crew.choose(groups, None, [cur]) == by_algorithm["uc"][0]
    assert crew.choose(groups, uc, [cur]) == by_algorithm["uc"][0]
    assert crew.choose(by_algorithm["cur"] + by_algorithm["c"], uc, [cur]) == by_algorithm["c"][0]
    assert crew.choose([*by_algorithm["c"][:1], *by_algorithm["cur"]], uc, [cur, c]) == by_algorithm["cur"][0]
    assert crew.choose(by_algorithm["cur"][3:], uc, [cur]) == by_algorithm["cur"][3]


def test_groups_differ_in_nothing_but_their_seed():
    runs = planned("navigation", "--risk-threshold", "0.1,0.2", "--seeds", 3)
    groups = study.groups(list(runs.values()), 2)
    name = "navigation-cur-risk_threshold={}-seed{}".format
    assert [[run.folder.name for run in group] for group in groups] == [
        [name(0.1, 0), name(0.1, 1)],
        [name(0.1, 2)],
        [name(0.2, 0), name(0.2, 1)],
        [name(0.2, 2)],
    ]
    assert study.program(groups[0]) == study.program(groups[2]) != study.program(groups[1])


def test_each_process_has_a_place(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    monkeypatch.setattr(place, "gpus", list)
    assert place.divide(9, None) == [place.Place([core], None) for core in range(4)]
    assert place.divide(9, 2) == [place.Place([0, 2], None), place.Place([1, 3], None)]
    monkeypatch.setattr(place, "gpus", lambda: ["2", "5"])
    assert place.divide(9, None) == [place.Place([0, 2], "2"), place.Place([1, 3], "5")]
    assert place.divide(1, None) == [place.Place([0, 1, 2, 3], "2")]
    assert [one.gpu for one in place.divide(9, 3)] == ["2", "5", "2"]


def test_another_process_looks_for_gpus_and_one_takes_what_it_is_given(monkeypatch):
    monkeypatch.setattr(place, "_PLUGINS", ("no_such_plugin",))
    assert place.gpus() == []
    monkeypatch.setattr(place, "_PLUGINS", ("jax",))  # looks in earnest, and finds none in tests on a CPU
    monkeypatch.setattr(place, "_COUNT", "print('JAX says something'); print(2)")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert place.gpus() == ["0", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    assert place.gpus() == ["3", "5"]
    monkeypatch.setattr(place, "_COUNT", "raise SystemExit(1)")
    assert place.gpus() == []
    place.Place(sorted(os.sched_getaffinity(0)), None).take()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "3,5"
    place.Place(sorted(os.sched_getaffinity(0)), "5").take()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "5"


# Seeds side by side

EXPERT = ("--algorithm", "expert", "--num-robots", 2, "--num-humans", 2, "--hard-reset-time", 2, "--num-demonstrations", 20)
EXPERT += ("--hidden-sizes", 8, "--batch-size", 8, "--min-teleop-time", "3,5", "--seeds", 2)


def groups_of(*arguments: object, output: Path) -> list[study.Group]:
    return study.groups(list(planned(NAV, *arguments, output=output).values()), 2)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A function of the number of timesteps, which returns Metrics[T] of plain runs of the expert by their names."""

    @cache
    def metrics_of(steps):
        runs = planned(NAV, *EXPERT, "--num-steps", steps, output=tmp_path_factory.mktemp("alone"))
        return {name: resumable.complete(run, checkpoint_every=0) for name, run in runs.items()}

    return metrics_of


def assert_agree(path: Path, metrics) -> None:
    """Check that a run has these Metrics[T]: no robot's state rounds, only their sum of rewards."""
    run = folder.read_run(path)
    found = folder.read_finished(run)
    for name, one, other in zip(found._fields, found, metrics, strict=True):
        if name in metrics_csv.REALS:
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
        else:
            np.testing.assert_array_equal(one, other)


def test_seeds_side_by_side_are_ordinary_runs(tmp_path, alone, monkeypatch, capsys):
    first, second = groups_of(*EXPERT, "--num-steps", 40, output=tmp_path)
    assert group.complete(first, checkpoint_every=0) == group.complete(second, checkpoint_every=0) == ["", ""]
    for run in (*first, *second):
        assert set(contents(run.folder)) == {"config.json", "metrics.csv", "figure.png"}
        assert sweep.is_finished(run)
        assert_agree(run.folder, alone(40)[run.folder.name])
    before = everything(tmp_path)
    shutil.rmtree(first[1].folder)
    assert group.complete(first, checkpoint_every=0) == ["", ""]  # once more, but what was there stays as it was
    assert everything(tmp_path) == before
    monkeypatch.setattr(chunks, "start", lambda *args, **kwargs: pytest.fail("nothing is left to compute"))
    assert group.complete(first, checkpoint_every=0) == ["", ""]
    assert "beside seeds 1, on the CPU" in capsys.readouterr().err


def test_one_run_of_a_group_may_fail(tmp_path, alone, monkeypatch):
    group_of_two = groups_of(*EXPERT, "--num-steps", 40, output=tmp_path)[0]

    def check(chunk, timestep, run):
        if run.seed == 0 and timestep >= 10:
            raise Diverged("the policy is no longer finite")

    monkeypatch.setattr(resumable, "check_finite", check)
    assert group.complete(group_of_two, checkpoint_every=0) == ["the policy is no longer finite", ""]
    one, other = group_of_two
    assert rows(one.folder) == 10
    assert not sweep.is_finished(one)
    assert_agree(other.folder, alone(40)[other.folder.name])


def test_a_group_that_was_stopped_starts_again(tmp_path, alone, monkeypatch):
    group_of_two = groups_of(*EXPERT, "--num-steps", 40, output=tmp_path)[0]
    with monkeypatch.context() as patched:
        patched.setattr(resumable, "stoppable", lambda: contextlib.nullcontext(lambda: True))
        with pytest.raises(KeyboardInterrupt, match="at t = 2 of 40; runs side by side start again at t = 0"):
            group.complete(group_of_two, checkpoint_every=0)
    assert [rows(run.folder) for run in group_of_two] == [2, 2]
    with files.lock(group_of_two[1].folder), pytest.raises(BlockingIOError):
        group.complete(group_of_two, checkpoint_every=0)
    assert group.complete(group_of_two, checkpoint_every=0) == ["", ""]
    for run in group_of_two:
        assert_agree(run.folder, alone(40)[run.folder.name])


def test_more_seeds_must_leave_groups_as_they_are(capsys, tmp_path):
    output = tmp_path / "out"
    asked = study.make_study([NAV], {"output": str(output), "seed": [0, 1, 2], "seeds_per_program": 2})
    output.mkdir()
    files.write_json(output / sweep.FILE, {"runs": asked.blocks, "log_interventions": False, "seeds_per_program": 2})
    more = asked._replace(blocks=tuple({**block, "seed": [0, 1, 2, 3]} for block in asked.blocks))
    with pytest.raises(ValueError, match="add whole groups of seeds_per_program = 2 seeds"):
        sweep.check_folder(more, study.plan(more))
    sweep.check_folder(asked, study.plan(asked))


def test_runs_side_by_side_must_fit_the_memory_together(monkeypatch, tmp_path):
    monkeypatch.setattr(checks, "memory", lambda: 0)
    needed = {}
    for number, who in ((1, "the run needs"), (2, "2 runs side by side need")):
        asked = study.make_study([NAV], {"output": str(tmp_path), "seed": [0, 1], "seeds_per_program": number})
        with pytest.raises(ValueError, match=rf"{who} at least \d") as error:
            study.plan(asked)
        needed[number] = float(re.findall(r"at least ([\d.]+) GiB", str(error.value))[0])
    assert needed[2] == pytest.approx(2 * needed[1], abs=0.02)


def test_a_folder_keeps_its_number_of_seeds_per_program(capsys, tmp_path):
    output = tmp_path / "out"
    command = ("sweep", NAV, *EXPERT, "--num-steps", 40, "--output", output)
    asked = study.make_study([NAV], vars(flags.parse([*map(str, command)])))
    output.mkdir()
    (output / sweep.FILE).write_text(json.dumps({"runs": asked.blocks, "log_interventions": False}))
    said = refused(capsys, *command, "--seeds-per-program", 2)
    assert f"seeds_per_program = 2, but the sweep in {output} has 1, and its runs would round differently" in said


@pytest.mark.slow
def test_seeds_side_by_side_learn_and_log(tmp_path):
    log = ("--num-steps", 40, "--seeds", 2, "--log-interventions")
    (runs,) = groups_of("--algorithm", "random", "--random-threshold", "0.5", *TINY[:4], *TINY[6:-2], *log, output=tmp_path)
    assert group.complete(runs, checkpoint_every=0) == ["", ""]
    for run in map(folder.read_run, [run.folder for run in runs]):
        metrics = folder.read_finished(run)
        assert np.all(metrics.moving + metrics.idle == 2)
        assert np.all(metrics.human_steps <= 2)
        assert sum(map(len, folder.read_interventions(run))) == metrics.teleop_steps.sum() > 0
        assert folder.read_policy(run) is not None
    one, other = (folder.read_policy(folder.read_run(run.folder)).params for run in runs)
    assert not any(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))


# Other processes, which can be killed

RANDOM = ("--algorithm", "random", "--random-threshold", "0.5", *TINY)


@pytest.fixture(scope="module")
def spawn(tmp_path_factory):
    """A function that starts the command line in a process; compiled programs are kept, so that starts are quick."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs")), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    cache |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0"}

    def spawn(*arguments: object) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "fleetjax", *map(str, arguments)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, env=os.environ | cache, text=True, start_new_session=True, **pipes)

    return spawn


def end(process: subprocess.Popen[str]) -> tuple[int, str, list[str]]:
    """Return the exit code of a process, and what it printed: stdout, and the lines of stderr."""
    out, err = process.communicate()
    return process.returncode, out, own_lines(err)


@pytest.fixture(scope="module")
def compiled():
    """A list of how long each program took to compile since it was cleared; compilation is as quick as `spawn`'s."""
    seconds: list[float] = []

    def count(event: str, duration: float, **_: object) -> None:
        if event.endswith("backend_compile_duration"):
            seconds.append(duration)

    jax.monitoring.register_event_duration_secs_listener(count)
    jax.config.update("jax_disable_most_optimizations", True)
    jax.clear_caches()  # another file's tests, or this file's before, may have compiled the same programs
    yield seconds
    jax.config.update("jax_disable_most_optimizations", False)
    jax.monitoring.unregister_event_duration_listener(count)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, compiled):
    """Metrics and policies of plain runs, by seed; only the first compiles."""
    return plain_runs(tmp_path_factory.mktemp("plain"), compiled, STEPS)


@pytest.fixture(scope="module")
def whole_long(tmp_path_factory, compiled):
    """The same of runs that are too long to end before a signal arrives."""
    return plain_runs(tmp_path_factory.mktemp("long"), compiled, LONG, seeds=6)


def plain_runs(path: Path, compiled: list[float], steps: int, seeds: int = 3) -> dict[int, list[bytes]]:
    for seed in range(seeds):
        compiled.clear()
        length = ("--num-steps", str(steps), "--seed", str(seed))
        assert cli.main(["run", "navigation", *RANDOM, *length, "--output", str(path / str(seed))]) == 0
        assert (len(compiled) >= 2) == (seed == 0)
    return {seed: results(path / str(seed)) for seed in range(seeds)}


def results(path: Path) -> list[bytes]:
    return [(path / name).read_bytes() for name in RESULTS]


def the_run(output: Path, seed: int) -> Path:
    return output / f"navigation-random-seed{seed}"


def rows(path: Path) -> int:
    return (path / "metrics.csv").read_bytes().count(b"\n") - 1 if (path / "metrics.csv").exists() else 0


def under_way(output: Path) -> list[Path]:
    """Return which of three runs have begun well. Workers differ in speed: one may end a run before another begins its own."""
    return [run for run in (the_run(output, seed) for seed in range(3)) if rows(run) > 200]


def wait_until(condition, process: subprocess.Popen[str]) -> None:
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(1e-3)


def children(process: subprocess.Popen[str]) -> list[int]:
    return list(map(int, Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()))


def owner(path: Path) -> int:
    """Return the process that works in a run folder."""
    return int((path / ".lock").read_text())


def is_alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for_end(processes: list[int]) -> None:
    for _ in range(100_000):  # only not to hang: it takes a moment
        if not any(map(is_alive, processes)):
            return
        time.sleep(1e-3)
    raise AssertionError(f"{processes} still run")


@pytest.fixture(scope="module")
def swept(tmp_path_factory, spawn):
    """The folder of a finished sweep with two programs, and what was printed; whoever changes it takes a copy."""
    output = tmp_path_factory.mktemp("sweeps") / "swept"
    command = ("sweep", "navigation", *RANDOM, "--algorithm", "random,expert", "--seeds", 2, "--output", output)
    code, out, said = end(spawn(*command, "--workers", 2))
    assert code == 0, said
    return output, command, out, said


@pytest.mark.slow
def test_a_sweep_gives_the_folders_that_plain_runs_give(swept, whole, capsys):
    output, _, out, said = swept
    names = [f"navigation-{algorithm}-seed{seed}" for algorithm in ("random", "expert") for seed in (0, 1)]
    assert {path.name for path in output.iterdir()} == {*names, "sweep.json", "logs"}
    assert {path.name for path in (output / "logs").iterdir()} == {f"{name}.log" for name in names}
    assert said[0] == "4 runs, 0 of them finished already"
    assert {line.split(": ")[-1] for line in said[1:]} == {f"{name} finished" for name in names}
    assert said[-1].startswith("4 of 4 runs, 0.0 s left: ")
    assert re.fullmatch(rf"4 runs finished, .+ in all\. Folder: {re.escape(str(output))}\n", out)
    for seed in (0, 1):
        assert results(the_run(output, seed)) == whole[seed]
        assert set(contents(the_run(output, seed))) == {"config.json", "metrics.csv", "figure.png", "policy.msgpack"}
    assert "100% " in (output / "logs" / f"{names[0]}.log").read_text()
    assert cli.main(["plot", *(str(output / name) for name in names), "--output", str(output.parent / "all.svg")]) == 0
    assert cli.main(["run", "--resume", str(output / names[0])]) == 0
    assert "is already finished" in capsys.readouterr().err


@pytest.mark.slow
def test_runs_of_one_program_compile_nothing_new(whole, compiled, tmp_path):
    compiled.clear()
    runs = planned("navigation", *RANDOM, "--random-threshold", "0.5,0.6", "--learning-rate", "1e-3,1e-4", output=tmp_path)
    for run in runs.values():
        resumable.complete(run, checkpoint_every=100)
    assert compiled == []
    found = {name: results(run.folder) for name, run in runs.items()}
    assert found["navigation-random-random_threshold=0.5-learning_rate=0.001-seed0"] == whole[0]
    assert len({metrics for metrics, _ in found.values()}) == 4


@pytest.fixture
def copied(swept, tmp_path):
    """A copy of the finished sweep, and the command that made it, for the copy."""
    output, command, _, _ = swept
    copy = Path(shutil.copytree(output, tmp_path / "copy"))
    return copy, (*command[:-1], copy)


def everything(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.mark.slow
def test_a_finished_sweep_starts_nothing_and_a_larger_one_only_what_is_new(copied, spawn, whole, capsys):
    output, command = copied
    before = everything(output)
    assert cli.main([*map(str, command)]) == 0
    assert capsys.readouterr().err == "4 runs, 4 of them finished already\n"
    assert everything(output) == before
    larger = command[: command.index("--seeds")]
    code, _, said = end(spawn(*larger, "--algorithm", "expert,random", "--seeds", 3, "--output", output))
    assert code == 0, said
    assert said[0] == "6 runs, 4 of them finished already"
    assert results(the_run(output, 2)) == whole[2]
    after = everything(output)
    assert {name for name in before if after[name] != before[name]} == {"sweep.json"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--num-steps", 300), f"navigation-random-seed0: num_steps = 300, but the run has {STEPS} in "),
        (("--random-threshold", 0.6), "navigation-random-seed0: random_threshold = 0.6, but the run has 0.5 in "),
        (("--log-interventions",), "navigation-random-seed0: log_interventions = True, but the run has False in "),
        (
            ("--seeds", 1),
            "holds another sweep, with a run navigation-random-seed1 that this one lacks; choose another --output",
        ),
        (("--min-teleop-time", "5,6"), "holds another sweep, with a run navigation-random-seed0 that this one lacks; choose"),
    ],
)
def test_a_folder_with_another_sweep_is_refused(swept, capsys, arguments, reason):
    output, command, *_ = swept
    before = everything(output)
    said = refused(capsys, *command, *arguments)
    assert reason in said
    assert "choose another --output" in said
    assert everything(output) == before


@pytest.mark.slow
def test_a_run_that_fails_is_told_and_the_others_go_on(tmp_path, spawn, whole):
    output = tmp_path / "out"
    damaged = the_run(output, 0)
    command = ("sweep", "navigation", *RANDOM, "--seeds", 3, "--workers", 2, "--output", output)
    asked = study.make_study(["navigation"], vars(flags.parse([*map(str, command)])))
    damaged.mkdir(parents=True)
    (damaged / "config.json").write_text("{}")
    (output / sweep.FILE).write_text(json.dumps({"runs": asked.blocks, "log_interventions": False}))
    code, out, said = end(spawn(*command))
    assert (code, out) == (1, "")
    log = output / "logs" / f"{damaged.name}.log"
    (told,) = [line for line in said if " failed: " in line]
    assert f"{damaged.name} failed: {damaged / 'config.json'} cannot be used: it was not written by fleetjax" in told
    assert told.endswith(f"; its log is {log}")
    assert "ValueError" in log.read_text()
    assert said[-1].startswith("fleetjax: 1 of 3 runs failed; repeat the command to try again")
    assert [results(the_run(output, seed)) for seed in (1, 2)] == [whole[1], whole[2]]
    shutil.rmtree(damaged)
    code, _, said = end(spawn(*command))
    assert (code, said[0]) == (0, "3 runs, 2 of them finished already")
    assert results(damaged) == whole[0]


@pytest.mark.long
@pytest.mark.parametrize("options", [("--workers", 1), ("--launcher", "local", "--jobs", 2, "--lease", 3)])
def test_groups_survive_kills(tmp_path, spawn, alone, options):
    output = tmp_path / "out"
    command = ("sweep", NAV, *EXPERT, "--num-steps", LONG, "--seeds-per-program", 2, *options, "--output", output)
    one, other = (output / f"navigation-expert-min_teleop_time=3-seed{seed}" for seed in (0, 1))
    process = spawn(*command)
    with contextlib.ExitStack() as stack:
        stack.callback(process.kill)
        wait_until(lambda: rows(one) > 200 and rows(other) > 200, process)
        assert owner(one) == owner(other)
        os.kill(owner(one), signal.SIGKILL)
        code, _, said = end(process)
    if "--launcher" not in options:
        assert code == 1
        assert sum("its worker ended (SIGKILL); its log is" in line for line in said) == 2
        code, _, said = end(spawn(*command))
        assert said[0] == "4 runs, 2 of them finished already"
    assert code == 0, said
    for name, metrics in alone(LONG).items():
        assert_agree(output / name, metrics)


@pytest.mark.slow
def test_kills_of_workers_and_of_all_lose_nothing(tmp_path, spawn, whole_long):
    output = tmp_path / "out"
    command = ("sweep", "navigation", *RANDOM, "--num-steps", LONG, "--seeds", 3, "--workers", 2, "--output", output)
    process = spawn(*command)
    with contextlib.ExitStack() as stack:
        stack.callback(process.kill)
        wait_until(lambda: under_way(output), process)
        begun, workers = under_way(output), children(process)
        assert {owner(run) for run in begun} <= set(workers)
        process.kill()
        process.communicate()
        wait_for_end(workers)
        assert all(200 < rows(run) < LONG for run in begun)

        process = spawn(*command)
        stack.callback(process.kill)
        wait_until(lambda: rows(the_run(output, 2)) > 200, process)
        os.kill(owner(the_run(output, 2)), signal.SIGKILL)
        code, _, said = end(process)
    assert code == 1
    (told,) = [line for line in said if " failed: " in line]
    assert "navigation-random-seed2 failed: its worker ended (SIGKILL); its log is " in told
    assert said[-1].startswith("fleetjax: 1 of 3 runs failed")

    code, _, said = end(spawn(*command))
    assert (code, said[0]) == (0, "3 runs, 2 of them finished already")
    assert [results(the_run(output, seed)) for seed in range(3)] == [whole_long[seed] for seed in range(3)]
    for run in {*begun, the_run(output, 2)}:
        assert "resuming from" in (output / "logs" / f"{run.name}.log").read_text()


def test_a_launcher_needs_submitit(capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    said = refused(capsys, "sweep", "navigation", "--launcher", "local", "--output", tmp_path / "out")
    assert 'needs submitit; install it: pip install ".[cluster]"' in said
    assert not (tmp_path / "out").exists()


def test_a_job_that_is_asked_to_stop_before_it_has_a_run_ends():
    """submitit ignores SIGTERM; a job that has loaded nothing yet must not."""
    program = "import signal\nsignal.signal(signal.SIGTERM, lambda *_: None)\nfrom fleetjax.io import job\n"
    program += "job.complete_all = lambda job: signal.raise_signal(signal.SIGTERM)\njob.Job({}, 'sweep', None, None, 1.0)()"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -signal.SIGTERM


@pytest.mark.long
def test_jobs_of_a_cluster_take_over_what_dead_ones_leave(tmp_path, spawn, whole_long):
    output, seed = tmp_path / "out", time.time_ns() % 2**32
    print("seed of the kills:", seed)
    random = np.random.default_rng(seed)
    runs = [the_run(output, seed) for seed in range(6)]
    jobs = ("--launcher", "local", "--jobs", 4, "--lease", 3)
    process = spawn("sweep", "navigation", *RANDOM, "--num-steps", LONG, "--seeds", 6, *jobs, "--output", output)
    with contextlib.ExitStack() as stack:
        stack.callback(process.kill)
        killed = []
        for moment in sorted(random.integers(1, 3 * LONG, 2)):  # timesteps of all runs together, which are 6 LONG in the end
            wait_until(lambda moment=moment: sum(map(rows, runs)) >= moment and working(runs), process)
            killed.append(int(random.choice(working(runs))))
            os.kill(killed[-1], signal.SIGKILL)
            wait_for_end(killed[-1:])
        code, _, said = end(process)
    assert code == 0, said
    assert len(set(killed)) == 2
    assert {seed: results(run) for seed, run in enumerate(runs)} == whole_long
    owners = set()
    for run in runs:
        leases = [json.loads(path.read_text()) for path in sorted((output / "leases" / run.name).iterdir())]
        assert [lease["end"] for lease in leases] == [""] * (len(leases) - 1) + ["finished"]
        owners |= {lease["owner"][1] for lease in leases}
        log = (output / "logs" / f"{run.name}.log").read_text()
        assert len(leases) == 1 or "resuming from" in log or "no checkpoint was written yet" in log
    assert set(killed) < owners
    assert len(owners) <= 4


def working(runs: list[Path]) -> list[int]:
    """Return the living processes that have begun runs and not finished them."""
    owners = set()
    for run in runs:
        with contextlib.suppress(ValueError):  # its next owner is about to write its number
            owners |= {owner(run)} if 0 < rows(run) < LONG else set()
    return sorted(filter(is_alive, owners))


def test_ctrl_c_while_a_process_starts_reaches_its_parent_alone():
    with resumable.stoppable() as asked_to_stop:
        with crew.deaf_to_ctrl_c():
            child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stderr=subprocess.PIPE)
            os.kill(os.getpid(), signal.SIGINT)
            child.send_signal(signal.SIGINT)
        said = child.communicate(b"\n")
        patience = time.monotonic() + 30
        while not asked_to_stop() and time.monotonic() < patience:  # another thread may take the signal and pass it on
            time.sleep(0.01)
        assert asked_to_stop()
    assert said == (None, b"")
    assert child.returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "stop"),
    [
        (["--workers", 2], os.killpg),  # as a terminal does
        (["--workers", 1], os.kill),
        (["--launcher", "local", "--jobs", 2, "--lease", 30], os.killpg),
    ],
)
def test_a_stopped_sweep_writes_checkpoints_and_resumes(tmp_path, spawn, whole_long, options, stop):
    output = tmp_path / "out"
    command = ("sweep", "navigation", *RANDOM, "--num-steps", LONG, "--seeds", 3, *options, "--checkpoint-every", 0)
    command += ("--output", output)
    process = spawn(*command)
    with contextlib.ExitStack() as stack:
        stack.callback(process.kill)
        wait_until(lambda: under_way(output), process)
        begun = under_way(output)
        working = [owner(run) for run in begun] if "--launcher" in options else children(process)
        stop(process.pid, signal.SIGINT if stop is os.killpg else signal.SIGTERM)
        code, out, said = end(process)
    assert (code, out) == (130, "")
    assert said[-1] == "fleetjax: interrupted with 0 of 3 runs finished; repeat the command to resume"
    wait_for_end(working)
    assert options != ["--workers", 1] or (begun == [the_run(output, 0)] and not the_run(output, 1).exists())
    for run in begun:
        assert 200 < rows(run) < LONG
        assert list(run.glob("checkpoints/*/manifest.json"))
        if "--launcher" in options:
            assert json.loads((output / "leases" / run.name / "0").read_text())["end"] == "stopped"
    code, _, said = end(spawn(*command))
    assert code == 0, said
    assert [results(the_run(output, seed)) for seed in range(3)] == [whole_long[seed] for seed in range(3)]
    for run in begun:
        assert "resuming from" in (output / "logs" / f"{run.name}.log").read_text()
