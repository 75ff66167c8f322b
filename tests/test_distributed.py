"""One fleet on several processes: the same bits as on one with as many devices, and a clear end when one of them is gone."""

import contextlib
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
from commands import own_lines

from fleetjax import cli

SMALL = {
    "--num-robots": 40,
    "--num-humans": 5,
    "--num-steps": 60,
    "--initial-period": 3,
    "--num-demonstrations": 100,
    "--batch-size": 32,
    "--pretraining-steps": 20,
    "--checkpoint-every": 20,
    "--connect-timeout": 120,
}


@pytest.fixture(autouse=True)
def no_proxies(monkeypatch):
    """Processes do not see proxies, of which JAX warns."""
    for name in [name for name in os.environ if "_proxy" in name.lower()]:
        monkeypatch.delenv(name)


def free_port():
    """Return a port that is free, and that the system gives to nobody who does not ask for it."""
    for port in random.SystemRandom().sample(range(20_000, 32_000), 1000):
        with socket.socket() as found, contextlib.suppress(OSError):
            found.bind(("localhost", port))
            return port
    raise OSError("no port is free")


CRITICS = {"num_critic_transitions": 200, "critic_pretraining_steps": 10, "critic_capacity": 1003}  # which 4 do not divide


def command(
    folder,
    *,
    port,
    processes,
    process,
    devices,
    environment="navigation",
    algorithm="random",
    program=("-m", "fleetjax"),
    **others,
):
    """Return a started process of a run."""
    given = SMALL | {f"--{name.replace('_', '-')}": value for name, value in others.items()}
    given |= {"--output": folder, "--coordinator": f"localhost:{port}", "--num-processes": processes, "--process-id": process}
    words = [str(word) for pair in given.items() for word in pair]
    arguments = [sys.executable, *program, "run", environment, "--algorithm", algorithm, "--distributed", *words]
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(arguments, env=os.environ | {"XLA_FLAGS": flags, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}, **pipes)


def start(folder, processes, devices, **others):
    port = free_port()
    return [command(folder, port=port, processes=processes, process=i, devices=devices, **others) for i in range(processes)]


def finish(started, timeout=900):
    """Return exit code and stderr of each process."""
    try:
        return [(process.communicate(timeout=timeout)[1], process.returncode)[::-1] for process in started]
    finally:
        for process in started:
            process.kill()


def complete(folder, processes, devices, **others):
    for code, errors in finish(start(folder, processes, devices, **others)):
        assert code == 0, errors
    return (folder / "metrics.csv").read_bytes(), (folder / "policy.msgpack").read_bytes()


def wait_for_rows(folder, number):
    end = time.monotonic() + 900
    while not (folder / "metrics.csv").exists() or len((folder / "metrics.csv").read_bytes().splitlines()) <= number:
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.parametrize(
    "given",
    [
        pytest.param({}, marks=pytest.mark.slow, id="random"),
        pytest.param({"algorithm": "cur", **CRITICS}, marks=pytest.mark.long, id="critics"),
        pytest.param({"environment": "humanoid", "algorithm": "cur", **CRITICS}, marks=pytest.mark.long, id="physics"),
    ],
)
def test_several_processes_give_the_bits_of_one_with_as_many_devices(tmp_path, given):
    one = complete(tmp_path / "one", 1, 4, **given)
    assert complete(tmp_path / "two", 2, 2, **given) == one
    assert complete(tmp_path / "four", 4, 1, **given) == one


@pytest.mark.long
@pytest.mark.parametrize("environment", ["navigation", "humanoid"])
def test_a_stopped_run_resumes_on_other_processes_and_on_other_devices(tmp_path, environment):
    given = {"environment": environment, "algorithm": "cur", "num_steps": 150, **CRITICS}
    whole = complete(tmp_path / "whole", 1, 4, **given)
    stopped = start(tmp_path / "run", 2, 2, **given)
    wait_for_rows(tmp_path / "run", 11)
    stopped[1].send_signal(signal.SIGTERM)
    for code, errors in finish(stopped):
        assert code == 130, errors
    shutil.copytree(tmp_path / "run", tmp_path / "fewer")
    done = len((tmp_path / "run" / "metrics.csv").read_bytes().splitlines()) - 1
    assert 10 < done < 150
    assert complete(tmp_path / "run", 1, 4, **given) == whole
    metrics, _ = complete(tmp_path / "fewer", 2, 1, **given)  # two parts of a ring in place of four: the same until then
    assert metrics.splitlines()[: done + 1] == whole[0].splitlines()[: done + 1]
    assert len(metrics.splitlines()) == 151


def only_line(errors):
    """Return the one line of stderr that a process ended with."""
    (line,) = own_lines(errors)
    return line


EXCHANGE = """
import sys, time
from fleetjax.io import team
port, process, timeout, silence = map(int, sys.argv[1:])
team.SILENCE = silence
team.join(team.Meeting(f"localhost:{port}", 2, process, 240))
team.tell("compiled")
with team.watched(timeout, "repeat the same command") as beat:
    for number in range(10**9):
        team.tell("here")
        beat()
        if number == 3:
            print("under way", flush=True)
"""


def exchanging(timeout, silence):
    """Return two processes that exchange something again and again."""
    port, pipes = free_port(), {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    words = [[str(word) for word in (port, process, timeout, silence)] for process in (0, 1)]
    started = [subprocess.Popen([sys.executable, "-c", EXCHANGE, *arguments], **pipes) for arguments in words]
    for process in started:
        assert any("under way" in line for line in process.stdout), finish(started)  # gloo prints lines, too
    return started


@pytest.mark.parametrize("lost", [0, 1])
def test_a_process_says_in_one_line_that_another_was_killed(lost):
    started = exchanging(timeout=600, silence=30)
    started[lost].send_signal(signal.SIGKILL)
    ((code, errors),) = finish([started[1 - lost]], timeout=60)
    finish([started[lost]])
    assert code == 1
    line = only_line(errors)
    assert line.startswith((f"fleetjax: process {lost} is gone; ", "fleetjax: another process is probably gone ("))
    assert line.endswith("; repeat the same command")


@pytest.mark.parametrize(
    ("lost", "timeout", "silence"),
    [
        (0, 10, 600),
        pytest.param(1, 10, 600, marks=pytest.mark.slow),
        pytest.param(0, 600, 10, marks=pytest.mark.long),
        pytest.param(1, 600, 10, marks=pytest.mark.long),
    ],
)
def test_a_process_says_in_one_line_that_another_hangs(lost, timeout, silence):
    started = exchanging(timeout, silence)
    started[lost].send_signal(signal.SIGSTOP)
    ((code, errors),) = finish([started[1 - lost]], timeout=60)
    reason = "no progress for 10 s: a process hangs, or --step-timeout" if timeout == 10 else f"process {lost} is gone"
    assert code == 1
    assert only_line(errors).startswith(f"fleetjax: {reason}")
    started[lost].send_signal(signal.SIGCONT)  # it finds itself alone
    ((code, errors),) = finish([started[lost]], timeout=60)
    assert code == 1
    assert re.match(r"fleetjax: (process \d is gone|another process is probably gone|no progress for)", only_line(errors))


LONG = {"num_steps": 1500, "checkpoint_every": 60}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return what a long run gives that nobody stops."""
    return complete(tmp_path_factory.mktemp("whole") / "run", 1, 4, **LONG)


@pytest.mark.parametrize(
    ("how", "lost"),
    [
        pytest.param(signal.SIGKILL, 0, marks=pytest.mark.slow),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in ((signal.SIGKILL, 1), (signal.SIGSTOP, 0), (signal.SIGSTOP, 1))
        ),
    ],
)
def test_a_run_that_lost_a_process_ends_and_resumes_on_another_number_of_processes(tmp_path, whole, how, lost):
    started = start(tmp_path / "run", 2, 2, step_timeout=600, **LONG)
    wait_for_rows(tmp_path / "run", 150)
    started[lost].send_signal(how)
    ((code, errors),) = finish([started[1 - lost]], timeout=60)
    assert code == 1
    (line,) = [line for line in errors.splitlines() if line.startswith("fleetjax:")]
    assert "is gone" in line or "is probably gone" in line
    assert "repeat the same command" in line
    assert "Check failure" not in errors  # by which JAX would end it
    started[lost].send_signal(signal.SIGCONT)
    ((code, errors),) = finish([started[lost]], timeout=60)
    assert code == (-signal.SIGKILL if how is signal.SIGKILL else 1), errors
    assert list((tmp_path / "run" / "checkpoints").iterdir())
    assert complete(tmp_path / "run", 1, 4, **LONG) == whole


@pytest.mark.slow
def test_a_run_whose_checkpoints_are_all_damaged_is_not_begun_again(tmp_path):
    folder, long = tmp_path / "run", {"num_steps": 6000, "checkpoint_every": 60}
    (process,) = start(folder, 1, 2, **long)
    wait_for_rows(folder, 150)
    process.send_signal(signal.SIGTERM)
    ((code, errors),) = finish([process])
    assert code == 130, errors
    for manifest in folder.glob("checkpoints/*/manifest.json"):
        manifest.write_text("{")
    before = (folder / "metrics.csv").read_bytes()
    ((code, errors),) = finish(start(folder, 1, 2, **long))
    assert code == 2
    assert "has no checkpoint that can be used; delete the folder, or choose another --output" in errors
    assert (folder / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize("later", [0, 1])
def test_processes_may_end_at_different_times(later):
    program = f"""
import sys, time
from fleetjax.io import team
process = int(sys.argv[1])
team.join(team.Meeting("localhost:{free_port()}", 2, process, 120))
team.meet("here")
time.sleep(3 if process == {later} else 0)
"""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    started = [subprocess.Popen([sys.executable, "-c", program, process], **pipes) for process in "01"]
    for code, errors in finish(started):
        assert code == 0, errors


@pytest.mark.slow
def test_processes_that_differ_are_refused(tmp_path):
    port = free_port()
    started = [
        command(tmp_path / "run", port=port, processes=2, process=i, devices=1, random_threshold=value)
        for i, value in enumerate((0.5, 0.6))
    ]
    for code, errors in finish(started):
        assert code == 2
        assert "random_threshold = 0.6 in process 1, but 0.5 in process 0" in errors
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_processes_with_other_folders_are_refused(tmp_path):
    port = free_port()
    started = [command(tmp_path / f"run-{i}", port=port, processes=2, process=i, devices=1) for i in range(2)]
    for code, errors in finish(started):
        assert code == 2
        assert "process 1 does not see the folder of process 0; give all processes the same --output" in errors
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.slow
def test_one_process_says_how_a_run_on_many_devices_is_resumed(tmp_path, capsys):
    (started,) = start(tmp_path / "run", 1, 2, algorithm="cur", num_steps=100_000, **CRITICS)
    while not list(tmp_path.glob("run/checkpoints/*/manifest.json")) and started.poll() is None:
        time.sleep(0.05)
    started.send_signal(signal.SIGINT)
    ((code, errors),) = finish([started])
    assert code == 130, errors
    assert cli.main(["run", "--resume", str(tmp_path / "run")]) == 2
    reason = capsys.readouterr().err.splitlines()[-1]
    assert reason == f"fleetjax: {tmp_path / 'run'} was run with --distributed on 2 devices; repeat that command to resume it"


@pytest.mark.slow
def test_processes_of_other_versions_are_refused(tmp_path):
    port = free_port()
    newer = (
        "import sys; from fleetjax.io import folder; folder.VERSION = '99.0'; from fleetjax.cli import main; sys.exit(main())"
    )
    programs = [("-m", "fleetjax"), ("-c", newer)]
    started = [
        command(tmp_path / "run", port=port, processes=2, process=i, devices=1, program=program)
        for i, program in enumerate(programs)
    ]
    for code, errors in finish(started):
        assert code == 2
        assert re.search(r"fleetjax: fleetjax = 99\.0 in process 1, but \S+ in process 0; start all processes", errors), errors
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("process", [0, 1])
def test_a_process_that_finds_no_other_says_so(tmp_path, process):
    alone = command(tmp_path / "run", port=free_port(), processes=2, process=process, devices=1, connect_timeout=2)
    ((code, errors),) = finish([alone])
    assert code == 2
    (line,) = [line for line in errors.splitlines() if line.startswith("fleetjax:")]
    assert "within 2 s" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--distributed needs --output DIR"),
        (["--output", "x", "--coordinator", "here:1"], "give --coordinator, --num-processes and --process-id together"),
        (["--output", "x", "--log-interventions"], "logs no interventions"),
        (
            ["--output", "x", "--coordinator", "here", "--num-processes", "2", "--process-id", "1"],
            "--coordinator here must be HOST:PORT",
        ),
        (
            ["--output", "x", "--coordinator", "here:1", "--num-processes", "2", "--process-id", "2"],
            "--process-id 2 must be from 0 to 1",
        ),
        (["--output", "x", "--step-timeout", "0"], "--step-timeout 0 must be at least 1 second"),
        (["--output", "x", "--step-timeout", "-5"], "--step-timeout -5 must be at least 1 second"),
        (["--output", "x", "--connect-timeout", "0"], "--connect-timeout 0 must be at least 1 second"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(arguments, message, capsys):
    from fleetjax.cli import main

    assert main(["run", "navigation", "--distributed", *arguments]) == 2
    assert message in capsys.readouterr().err
