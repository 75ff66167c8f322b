"""One fleet on several processes: the same bits as on one with as many devices, and a clear end when one of them is gone."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

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


def free_port():
    with socket.socket() as found:
        found.bind(("localhost", 0))
        return found.getsockname()[1]


def command(folder, *, port, processes, process, devices, **others):
    """Return a started process of a run."""
    given = SMALL | {f"--{name.replace('_', '-')}": value for name, value in others.items()}
    given |= {"--output": folder, "--coordinator": f"localhost:{port}", "--num-processes": processes, "--process-id": process}
    words = [str(word) for pair in given.items() for word in pair]
    arguments = [sys.executable, "-m", "fleetjax", "run", "navigation", "--algorithm", "random", "--distributed", *words]
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(arguments, env=os.environ | {"XLA_FLAGS": flags, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}, **pipes)


def start(folder, processes, devices, **others):
    port = free_port()
    return [command(folder, port=port, processes=processes, process=i, devices=devices, **others) for i in range(processes)]


def finish(started, timeout=300):
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
    end = time.monotonic() + 240
    while not (folder / "metrics.csv").exists() or len((folder / "metrics.csv").read_bytes().splitlines()) <= number:
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.slow
def test_several_processes_give_the_bits_of_one_with_as_many_devices(tmp_path):
    one = complete(tmp_path / "one", 1, 4)
    assert complete(tmp_path / "two", 2, 2) == one
    assert complete(tmp_path / "four", 4, 1) == one


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
def test_a_run_whose_process_was_killed_ends_and_resumes_on_another_number_of_processes(tmp_path, lost):
    long = {"num_steps": 1500, "checkpoint_every": 60}
    started = start(tmp_path / "run", 2, 2, **long)
    wait_for_rows(tmp_path / "run", 150)
    started[lost].send_signal(signal.SIGKILL)
    begun = time.monotonic()
    code, errors = finish([started[1 - lost]], timeout=60)[0]
    assert time.monotonic() - begun < 60
    finish([started[lost]])
    assert code != 0
    if "Terminating process" not in errors:  # by JAX itself, which can be faster where process 0 is lost
        (line,) = [line for line in errors.splitlines() if line.startswith("fleetjax:")]
        assert "is gone" in line or "is probably gone" in line
        assert "repeat the same command" in line
    assert list((tmp_path / "run" / "checkpoints").iterdir())
    resumed = complete(tmp_path / "run", 1, 4, **long)
    assert resumed == complete(tmp_path / "whole", 1, 4, **long)


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
    ],
)
def test_arguments_that_cannot_be_used_are_refused(arguments, message, capsys):
    from fleetjax.cli import main

    assert main(["run", "navigation", "--distributed", *arguments]) == 2
    assert message in capsys.readouterr().err
