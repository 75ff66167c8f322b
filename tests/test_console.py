"""Consoles without a browser: the engine, the seats, the record and its replay, and what the command line refuses."""

import contextlib
import importlib.util
import json
import logging
import os
import re
import signal
import socket
import threading
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import contents, edit_config, refused
from consoles import SMALL, claim, compile_once, flags, hear, make_config, make_session, say
from websockets.sync.client import connect

import fleetjax
from fleetjax import cli, envs
from fleetjax.console import controls, engine, guard, messages, pages, record, seats
from fleetjax.console.engine import EMPTY, PERSON, SIMULATED, Engine, Inputs, View
from fleetjax.io import files, folder, metrics_csv
from fleetjax.io import flags as command_line

NOBODY = np.zeros(2, bool)
STILL = np.zeros((2, 2), np.float32)


@pytest.fixture(autouse=True)
def quick_compilation(monkeypatch):
    monkeypatch.setattr(engine, "compile_programs", compile_once)


def make_engine(**changes) -> Engine:
    config = make_config(**changes)
    return Engine(config, jax.random.key(0), envs.make("navigation"), num_pictures=[1, 4])


def inputs(kind: int, *, given=NOBODY, action=STILL, confirmed=NOBODY) -> Inputs:
    return Inputs(np.full(2, kind, np.uint8), np.array(given), np.array(action, np.float32), np.array(confirmed))


def take(fleet: Engine, done: Inputs) -> tuple[View, fleetjax.Metrics]:
    view = fleet.plan(done.seat)
    return view, fleet.advance(done)


def crash(fleet: Engine, *robots: int) -> None:
    """Put robots into violation."""
    violation = np.array(fleet.state.env.violation)
    violation[list(robots)] = True
    fleet.state = fleet.state._replace(env=fleet.state.env._replace(violation=jnp.asarray(violation)))


# Why a robot has help


@pytest.mark.parametrize(
    ("algorithm", "limits", "why"),
    [
        ("cur", [0.01, 0.3], "uncertainty and risk above the threshold"),
        ("rc", [None, 0.3], "risk above the threshold"),
        ("ensemble_dagger", [0.01], "uncertainty above the threshold"),
        ("random", [None], "highest priority"),
    ],
)
def test_only_thresholds_that_the_rule_uses_are_named(algorithm, limits, why):
    config = make_config(algorithm=algorithm, uncertainty_threshold=0.01, risk_threshold=0.3)
    high, none = np.full(4, 0.5, np.float32), np.zeros(4, bool)
    view = View(0, np.array([2, -1]), np.zeros(2, int), none, none, high, high, high, high)
    seen = pages.operator(cast(Any, SimpleNamespace(config=config)), view, 0, seats.Seat("key", robot=2), {})
    assert seen["why"] == why
    assert [signal["threshold"] for signal in seen["signals"]] == pytest.approx(limits)


# The engine


@pytest.mark.slow
def test_simulated_seats_give_the_librarys_run():
    fleet = make_engine()
    rows = [take(fleet, inputs(SIMULATED))[1] for _ in range(SMALL["num_steps"])]
    whole = jax.jit(fleetjax.run)(make_config(), jax.random.key(0)).metrics
    assert whole.hard_resets.sum() > 0
    assert whole.successes.sum() + whole.teleop_steps.sum() > 0
    for name, stepped, expected in zip(whole._fields, zip(*rows, strict=True), whole, strict=True):
        if name not in metrics_csv.REALS:
            np.testing.assert_array_equal(stepped, expected, err_msg=name)


def test_empty_seats_help_nobody_and_a_crashed_robot_waits():
    fleet = make_engine()
    crash(fleet, 2)
    for _ in range(5):
        view, metrics = take(fleet, inputs(EMPTY))
        assert view.robot.tolist() == [-1, -1]
        assert (int(metrics.human_steps), int(metrics.hard_resets)) == (0, 0)
        assert metrics.idle >= 1
    assert fleet.state.env.violation[2]


def test_only_given_actions_are_recorded_and_done():
    fleet = make_engine()
    before = int(fleet.state.human_data.pairs.size)
    view = fleet.plan(np.full(2, PERSON, np.uint8))
    first, second = view.robot
    seen = np.array(fleet.state.env.obs)
    planned = np.array(fleet._planned.robot_action)
    speed = np.array(fleet.state.env.physics)[:, 2:4]
    fleet.advance(inputs(PERSON, given=[True, False], action=[[0, 1], [0, 0]]))
    data = fleet.state.human_data.pairs
    assert int(data.size) == before + 1
    np.testing.assert_array_equal(data.rows.action[before], [0, 1])
    np.testing.assert_array_equal(data.rows.obs[before], seen[first])
    gained = (np.array(fleet.state.env.physics)[:, 2:4] - 0.95 * speed) / 0.025  # noise: 0.4
    assert gained[first][1] == pytest.approx(1, abs=2)
    assert second != first
    assert planned.shape == (4, 2)


def test_a_hard_reset_waits_for_its_person_and_then_takes_its_time():
    fleet = make_engine(min_teleop_time=3)
    crash(fleet, 1)
    waits = inputs(PERSON)
    view, _ = take(fleet, waits)
    seat = view.robot.tolist().index(1)
    assert view.resetting.tolist() == [False, True, False, False]
    for _ in range(6):  # longer than t_T and t_R
        view, metrics = take(fleet, waits)
        assert view.robot[seat] == 1
        assert (int(view.duration[seat]), int(metrics.hard_resets)) == (0, 0)
    assert fleet.state.env.violation[1]
    confirmed = inputs(PERSON, confirmed=np.arange(2) == seat)
    view, metrics = take(fleet, confirmed)
    assert int(metrics.hard_resets) == 0
    view, metrics = take(fleet, confirmed)
    assert (int(view.duration[seat]), int(metrics.hard_resets)) == (1, 1)
    assert not fleet.state.env.violation[1]
    assert not fleet.plan(waits.seat).resetting[1]


def test_an_action_for_a_crashed_robot_is_not_recorded():
    fleet = make_engine()
    crash(fleet, 0, 1, 2, 3)
    before = int(fleet.state.human_data.pairs.size)
    view, _ = take(fleet, inputs(PERSON, given=[True, True], action=[[1, 0], [1, 0]]))
    assert min(view.robot) >= 0
    assert int(fleet.state.human_data.pairs.size) == before


def test_nothing_is_compiled_after_the_start(tmp_path, caplog):
    session = make_session(tmp_path / "run")
    with contextlib.closing(session), jax.log_compiles(), caplog.at_level(logging.WARNING):
        for kind in (EMPTY, PERSON, SIMULATED):
            session.begin(np.full(2, kind, np.uint8))
            for number in (1, 4):
                session.engine.pictures(session.engine.state.env, np.arange(number, dtype=np.int32))
            session.finish(inputs(kind))
        assert not [line.getMessage() for line in caplog.records if "ompil" in line.getMessage()]
        jax.jit(lambda x: x + 17)(np.ones(3))
        assert [line for line in caplog.records if "ompil" in line.getMessage()]


# Seats


def view_of(robots, resetting=(), timestep=0) -> View:
    flags = np.zeros(4, bool)
    flags[list(resetting)] = True
    nothing = np.zeros(4, np.float32)
    return View(timestep, np.array(robots, np.int32), np.zeros(2, np.int32), flags, flags, *[nothing] * 4)


@pytest.fixture
def table():
    return seats.Seats(2, simulated=False, timeout=10.0)


def test_seats_are_taken_in_order_or_by_wish_and_only_once(table):
    assert table.claim("a", 0.0, seat=1)[0] == 1
    with pytest.raises(seats.Refused, match="seat 2 is taken"):
        table.claim("b", 0.0, seat=1)
    with pytest.raises(seats.Refused, match="no seat 8"):
        table.claim("b", 0.0, seat=7)
    with pytest.raises(seats.Refused, match="you already have a seat"):
        table.claim("a", 0.0)
    assert table.claim("b", 0.0)[0] == 0
    with pytest.raises(seats.Refused, match="every seat is taken"):
        table.claim("c", 0.0)
    assert table.kinds().tolist() == [PERSON, PERSON]


def test_a_key_gives_the_same_seat_again_and_no_other_key_does(table):
    number, key, _ = table.claim("a", 0.0)
    table.drop("a", 1.0)
    with pytest.raises(seats.Refused):
        table.claim("b", 1.0, key=key + "x", seat=number)
    assert table.claim("again", 2.0, key=key) == (number, key, None)
    assert table.claim("elsewhere", 2.0, key=key) == (number, key, "again")
    assert table.of("again") is None


def test_the_key_of_another_seat_gives_nobody_a_second_one(table):
    _, first, _ = table.claim("a", 0.0)
    second, key, _ = table.claim("b", 0.0)
    for gone in (False, True):
        with pytest.raises(seats.Refused, match="you already have a seat"):
            table.claim("b", 1.0, key=first)
        if not gone:
            table.drop("a", 1.0)
    assert table.claim("b", 2.0, key=key) == (second, key, None)
    assert [seat.client for seat in table.seats] == [None, "b"]
    table.claim("reloaded", 3.0, key=first)
    with pytest.raises(seats.Refused, match="every seat is taken"):
        table.claim("a", 3.0)
    table.leave("b")
    with pytest.raises(seats.Refused, match="you already have a seat"):
        table.claim("reloaded", 4.0, key=key)
    assert [seat.client for seat in table.seats] == ["reloaded", None]


def test_a_lost_seat_is_kept_until_the_timeout(table):
    table.claim("a", 0.0)
    table.drop("a", 5.0)
    assert table.expire(15.0) == []
    assert table.kinds().tolist() == [PERSON, EMPTY]
    table.expire(15.1)
    assert table.kinds().tolist() == [EMPTY, EMPTY]


def test_a_silent_client_loses_its_seat_too(table):
    table.claim("a", 0.0)
    table.hear("a", 8.0)
    assert table.expire(17.0) == []
    assert table.expire(18.1) == ["a"]
    assert table.of("a") is None


def test_free_seats_can_be_simulated():
    table = seats.Seats(2, simulated=True, timeout=1.0)
    table.claim("a", 0.0)
    assert table.kinds().tolist() == [PERSON, SIMULATED]


def test_actions_count_once_for_the_robot_they_were_meant_for(table):
    table.claim("a", 0.0)
    right = np.array([1, 0], np.float32)
    kinds = table.kinds()
    table.assign(view_of([3, -1], timestep=7), kinds)
    for robot, since in ((2, 7), (3, 6), (-1, 7)):
        with pytest.raises(seats.Refused, match="not yours"):
            table.act("a", robot, since, 0, right)
    with pytest.raises(seats.Refused, match="too late"):
        table.act("a", 3, 7, seats.LATEST + 1, right)
    with pytest.raises(seats.Refused, match="too late"):
        table.act("a", 3, 7, -1, right)
    with pytest.raises(seats.Refused, match="no seat"):
        table.act("b", 3, 7, 0, right)
    with pytest.raises(seats.Refused, match="needs no reset"):
        table.confirm("a", 3, 7)
    table.act("a", 3, 7, 0, right)
    done = table.collect(kinds, 2)
    assert done.given.tolist() == [True, False]
    np.testing.assert_array_equal(done.action, [[1, 0], [0, 0]])
    assert not table.collect(kinds, 2).given.any()


def test_an_action_stays_for_the_next_timestep_of_the_same_help_alone(table):
    table.claim("a", 0.0)
    kinds, right = table.kinds(), np.ones(2, np.float32)
    table.assign(view_of([3, -1], timestep=7), kinds)
    table.act("a", 3, 7, 0, right)
    table.assign(view_of([3, -1], timestep=8), kinds)
    assert table.collect(kinds, 2).given[0]
    table.act("a", 3, 7, 0, right)
    table.assign(view_of([1, -1], timestep=9), kinds)
    assert not table.collect(kinds, 2).given[0]


@pytest.mark.parametrize("goes", ["drop", "leave"])
def test_nothing_is_given_in_the_name_of_someone_who_is_gone(table, goes):
    _, key, _ = table.claim("a", 0.0)
    kinds = table.kinds()
    table.assign(view_of([3, -1], timestep=7), kinds)
    table.act("a", 3, 7, 0, np.ones(2, np.float32))
    table.drop("a", 1.0) if goes == "drop" else table.leave("a")
    table.claim("b", 1.0, key=key if goes == "drop" else "")
    assert not table.collect(kinds, 2).given.any()


def test_a_confirmed_reset_lasts_until_it_is_done_and_no_longer(table):
    table.claim("a", 0.0)
    kinds = table.kinds()
    table.assign(view_of([3, -1], resetting=[3], timestep=7), kinds)
    with pytest.raises(seats.Refused, match="reset first"):
        table.act("a", 3, 7, 0, np.ones(2, np.float32))
    table.confirm("a", 3, 7)
    for t in (8, 9):
        assert table.collect(kinds, 2).confirmed.tolist() == [True, False]
        table.assign(view_of([3, -1], resetting=[3], timestep=t), kinds)
    table.assign(view_of([3, -1], timestep=10), kinds)
    assert not table.collect(kinds, 2).confirmed.any()
    table.assign(view_of([3, -1], resetting=[3], timestep=11), kinds)
    assert not table.collect(kinds, 2).confirmed.any()


def test_who_sits_down_within_a_timestep_acts_from_the_next_on(table):
    kinds = table.kinds()
    table.claim("a", 0.0)
    table.assign(view_of([3, -1], timestep=7), kinds)
    with pytest.raises(seats.Refused):
        table.act("a", 3, 7, 0, np.ones(2, np.float32))


# Messages, controls, addresses


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[" * 1000,
        "null",
        "[]",
        '{"type": "shout"}',
        '{"type": ["act"]}',
        '{"type": "seen", "more": 1}',
        '{"type": "act", "robot": 1, "since": 0, "tick": 0}',
        '{"type": "act", "robot": 1.0, "since": 0, "tick": 0, "held": ["up"]}',
        '{"type": "act", "robot": true, "since": 0, "tick": 0, "held": ["up"]}',
        '{"type": "act", "robot": 1e999, "since": 0, "tick": 0, "held": ["up"]}',
        '{"type": "act", "robot": 99999999999, "since": 0, "tick": 0, "held": ["up"]}',
        '{"type": "act", "robot": 1, "since": 0, "tick": 0, "held": "up"}',
        '{"type": "act", "robot": 1, "since": 0, "tick": 0, "held": [1]}',
        '{"type": "claim", "key": 5, "seat": 0}',
        json.dumps({"type": "claim", "key": "x" * 65, "seat": 0}),
        json.dumps({"type": "seen", "pad": "x" * messages.LONGEST}),
    ],
)
def test_malformed_messages_are_refused_without_being_repeated(text):
    with pytest.raises(ValueError, match=r"^(messages|type|fields|robot|held|key) "):
        messages.parse(text)


def test_keys_become_actions():
    drive, push = controls.CONTROLS["navigation"], controls.CONTROLS["block_push"]
    assert controls.action_of(drive, ["left", "down"]).tolist() == [-1, -1]
    assert controls.action_of(drive, ["stop"]).tolist() == [0, 0]
    assert controls.action_of(push, ["left"]).tolist() == [0, 0, 1, 0]
    for table, names in ((drive, []), (drive, ["jump"]), (drive, ["up", "up"]), (push, ["up", "left"]), (push, ["stop"])):
        with pytest.raises(ValueError, match="action"):
            controls.action_of(table, names)


@pytest.mark.parametrize("name", [name for name in controls.CONTROLS if name in envs.list_envs()])
def test_controls_fit_their_environment(name):
    env = envs.make(name)
    table = controls.controls_of(env)
    assert env.spec.discrete != table.hold
    for action in table.actions.values():
        assert len(action) == env.spec.action_size


def test_addresses_beyond_this_machine_need_a_token():
    for host in ("127.0.0.1", "localhost", "::1", "127.3.2.1"):
        guard.check_address(host, None)
    for host in ("0.0.0.0", "::", "192.168.0.4", "example.org", ""):
        with pytest.raises(ValueError, match="--token"):
            guard.check_address(host, None)
        guard.check_address(host, "long-enough")
    for token in ("", "short", "with space in it", "a" * 129, "semi;colon;token"):
        with pytest.raises(ValueError, match="8 to 128"):
            guard.check_address("127.0.0.1", token)


def test_beyond_this_machine_addresses_and_its_own_name_are_let_in_and_other_names_are_not():
    async def app(scope, receive, send):
        raise AssertionError("not called")

    open_guard = guard.Guard(app, "0.0.0.0", "long-enough")
    for name in ("192.168.0.4:8765", "[fe80::1]:8765", "localhost", socket.gethostname()):
        assert open_guard._is_here([name]), name
    for names in (["evil.example"], ["192.168.0.4.evil.example:8765"], [], ["localhost", "localhost"], [""], ["[", "x"]):
        assert not open_guard._is_here(names), names
    assert not guard.Guard(app, "127.0.0.1", None)._is_here(["192.168.0.4:8765"])


# The command line


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["humanoid", "--humans", "2"], "no picture"),
        (["navigation", "--humans", "2", "--host", "0.0.0.0"], "--token"),
        (["navigation", "--humans", "2", "--token", "short"], "8 to 128"),
        (["navigation", "--humans", "2", "--port", "70000"], "port = 70000"),
        (["navigation", "--humans", "2", "--wait", "3"], "wait = 3"),
        (["navigation", "--humans", "2", "--interval", "-1"], "interval = -1"),
        (["navigation", "--humans", "2", "--interval", "nan"], "interval = nan"),
        (["navigation", "--humans", "2", "--timeout", "0"], "timeout = 0"),
        (["navigation", "--humans", "200"], "num_humans = 200"),
        (["navigation", "--fill", "robots"], "--fill"),
        (["navigation", "--takeover-time", "20", "--fatigue", "1"], "takeover_time, fatigue cannot be used in a console"),
        (["navigation", "--human-model", "imperfect"], "human_model = 'imperfect' cannot be used in a console"),
        (["navigation", "--link-model", "unequal"], "link_model = 'unequal' cannot be used in a console"),
        (["navigation", "--checkpoint-every", "5"], "--checkpoint-every"),
        ([], "ENV is missing; choose one of navigation, block_push\n"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(arguments, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert reason in refused(capsys, "console", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_an_engine_takes_no_models_of_people():
    config = fleetjax.make_config("navigation", takeover_time=20.0)
    with pytest.raises(ValueError, match="takeover_time cannot be used in a console, where people have their own times"):
        Engine(config, jax.random.key(0), envs.make("navigation"))


def test_environments_without_controls_are_refused(capsys, monkeypatch):
    monkeypatch.delitem(controls.CONTROLS, "navigation")
    assert "no controls" in refused(capsys, "console", "navigation")


@pytest.mark.parametrize("missing", ["starlette", "uvicorn", "websockets"])
def test_a_missing_web_server_is_named(missing, capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == missing else find(name, *rest))
    assert 'run pip install ".[console]" in the source folder' in refused(capsys, "console", "navigation", "--humans", "2")


def test_a_port_in_use_and_a_folder_in_use_are_refused(capsys, tmp_path):
    from fleetjax.console import server

    with contextlib.closing(server.listen("127.0.0.1", 0)) as listener:
        listener.listen()
        port = listener.getsockname()[1]
        assert f"port {port}" in refused(capsys, "console", "navigation", "--port", port, "--output", tmp_path / "run")
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine").write_text("precious")
    console = ("console", "navigation", "--port", "0", "--output", tmp_path / "run")
    assert "is not a run folder" in refused(capsys, *console, "--overwrite")
    (tmp_path / "run" / "config.json").touch()
    assert "already exists" in refused(capsys, *console)
    with files.lock(tmp_path / "run"):
        said = refused(capsys, *console, "--overwrite")
    assert "is in use by process" in said


# A session from the command line, and its replay


def play(port_of, *, ticks: int, then=lambda: None) -> threading.Thread:
    """Be a person who drives and resets whatever comes, in a thread."""

    def person() -> None:
        port = port_of()
        with (
            contextlib.suppress(Exception),
            connect(f"ws://127.0.0.1:{port}/ws/operator", origin=f"http://127.0.0.1:{port}", proxy=None) as page,  # type: ignore[arg-type]
        ):
            claim(page)
            while True:
                state = hear(page, "state", "over")
                if state["type"] == "over":
                    return
                if state["tick"] == ticks:
                    then()
                if state["mode"] == "reset":
                    say(page, type="reset", robot=state["robot"], since=state["since"])
                elif state["mode"] == "drive":
                    say(page, type="act", robot=state["robot"], since=state["since"], tick=state["tick"], held=["up", "left"])
                say(page, type="seen")

    thread = threading.Thread(target=person, daemon=True)
    thread.start()
    return thread


@pytest.fixture
def port_of(monkeypatch):
    """Return a function that waits for the console to be there, and tells its port."""
    from fleetjax.console import server

    there, ports, usual = threading.Event(), [], server.address_of

    def spy(listener, options):
        ports.append(listener.getsockname()[1])
        there.set()
        return usual(listener, options)

    monkeypatch.setattr(server, "address_of", spy)

    def port() -> int:
        there.wait()
        return ports[0]

    return port


def run_console(path, port_of, **person) -> int:
    thread = play(port_of, **{"ticks": -1} | person)
    given = ["--interval", "0.05", "--port", "0", "--output", str(path)]
    code = cli.main(["console", "navigation", *flags(), *given])
    if code == 0:
        thread.join()
    return code


def test_a_session_replays_to_the_bit_and_damage_is_refused(tmp_path, port_of, capsys):
    path = tmp_path / "run"
    assert run_console(path, port_of) == 0
    printed = capsys.readouterr()
    assert "60 timesteps recorded" in printed.out
    assert "Ctrl-C ends the session. Open http://127.0.0.1:" in printed.err
    assert set(contents(path)) == {"config.json", "metrics.csv", "figure.png", "policy.msgpack", "console.bin"}
    run = folder.read_run(path)
    rows = record.parse((path / "console.bin").read_bytes(), run.config, envs.make("navigation").spec)
    assert rows["given"].sum() > 0
    assert set(rows["seat"].ravel()) == {PERSON, SIMULATED}
    given = rows["action"][rows["given"] == 1]
    np.testing.assert_array_equal(given, np.broadcast_to(np.float32([-1, 1]), given.shape))

    assert cli.main(["replay", str(path)]) == 0
    assert "60 timesteps replayed; metrics.csv and policy.msgpack agree to the bit" in capsys.readouterr().out
    assert cli.main(["humans", "fit", str(path)]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"^seat 1 +\d+ +", printed, re.MULTILINE)
    command = printed.splitlines()[-1]
    assert command.startswith("fleetjax run navigation --takeover-time ")
    assert 0 <= command_line.parse(command.split()[1:]).takeover_time < 60
    assert cli.main(["plot", str(path), "--output", str(tmp_path / "all.png")]) == 0
    capsys.readouterr()
    assert "supervised by people" in refused(capsys, "run", "--resume", path)

    original = contents(path)
    damage = bytearray(original["console.bin"])
    damage[-1] ^= 1
    (path / "console.bin").write_bytes(damage)
    assert "damaged" in refused(capsys, "replay", path)
    (path / "console.bin").write_bytes(original["console.bin"])

    forged = rows.copy()
    forged["action"][forged["given"] == 1] = (1, -1)
    reseal(path, "console.bin", forged.tobytes())
    assert cli.main(["replay", str(path)]) == 1
    said = capsys.readouterr().err
    assert "the replay gives another" in said or "the replay helps other robots" in said
    for name in ("metrics.csv", "policy.msgpack"):
        restore(path, original)
        (path / name).write_bytes(original[name][:-1] + b"0")
        assert "damaged" in refused(capsys, "replay", path), name
    restore(path, original)
    reseal(path, "console.bin", original["console.bin"][:-1])
    assert "rows of" in refused(capsys, "replay", path)
    reseal(path, "console.bin", original["console.bin"][: len(original["console.bin"]) // 60 * 59])
    assert "59 timesteps" in refused(capsys, "replay", path)
    (path / "console.bin").unlink()
    assert "only runs of `fleetjax console`" in refused(capsys, "replay", path)


def reseal(path, name: str, data: bytes) -> None:
    """Write a file with its digest, as a forger would."""
    (path / name).write_bytes(data)
    edit_config(path, lambda content: content["sha256"].update({name: files.digest(data)}))


def restore(path, original: dict[str, bytes]) -> None:
    for name, data in original.items():
        (path / name).write_bytes(data)


def test_ctrl_c_ends_a_session_cleanly_and_seals_its_folder(tmp_path, port_of, capsys):
    path = tmp_path / "run"
    assert run_console(path, port_of, ticks=10, then=lambda: os.kill(os.getpid(), signal.SIGINT)) == 0
    run = folder.read_run(path)
    done = len(folder.read_metrics(run).successes)
    assert 0 < done < 60
    assert f"{done} timesteps recorded" in capsys.readouterr().out
    assert cli.main(["replay", str(path)]) == 0
    assert f"{done} timesteps replayed" in capsys.readouterr().out
    assert not (path / files.LOCK).exists()


def test_ctrl_c_before_the_first_timestep_leaves_nothing(tmp_path, port_of, capsys):
    path = tmp_path / "run"
    stopper = threading.Thread(target=lambda: (port_of(), knock(port_of()), os.kill(os.getpid(), signal.SIGINT)))
    stopper.start()
    assert cli.main(["console", "navigation", *flags(), "--port", "0", "--output", str(path)]) == 130
    stopper.join()
    assert "nothing was kept" in capsys.readouterr().err
    assert not path.exists()


@pytest.mark.slow
def test_an_older_run_stays_until_the_first_timestep(tmp_path, monkeypatch, port_of, capsys):
    path = tmp_path / "run"
    path.mkdir()
    older = {"config.json": b"{}", "metrics.csv": b"precious", "mine": b"mine"}
    restore(path, older)
    given = ["--interval", "0.005", "--port", "0", "--output", str(path), "--overwrite"]
    console = ["console", "navigation", *flags(), *given]
    stopper = threading.Thread(target=lambda: (port_of(), knock(port_of()), os.kill(os.getpid(), signal.SIGINT)))
    stopper.start()
    assert cli.main(console) == 130
    stopper.join()
    assert f"before the first timestep; {path} is unchanged" in capsys.readouterr().err
    assert contents(path) == older
    assert cli.main([*console, "--wait", "0"]) == 0
    assert set(contents(path)) == {"config.json", "metrics.csv", "figure.png", "policy.msgpack", "console.bin", "mine"}
    assert cli.main(["replay", str(path)]) == 0


def knock(port: int) -> None:
    """Wait until the console answers."""
    with connect(f"ws://127.0.0.1:{port}/ws/fleet", origin=f"http://127.0.0.1:{port}", proxy=None) as page:  # type: ignore[arg-type]
        hear(page, "waiting")


def test_the_fleets_page_says_when_resets_begin():
    config = fleetjax.make_config("navigation", "cur", initial_period=50)
    assert [pages._resets_begin(config, t) for t in (0, 49, 50)] == [50, 50, -1]
    uncertain_first = fleetjax.make_config("navigation", "ensemble_dagger", initial_period=50)
    assert pages._resets_begin(uncertain_first, 0) == -1


@pytest.mark.parametrize(("timestep", "stuck", "begins"), [(49, True, 50), (50, True, -1), (49, False, -1)])
def test_people_who_are_free_are_told_when_resets_begin(timestep, stuck, begins):
    config = make_config(algorithm="cur", initial_period=50)
    session, none, high = (
        cast(Any, SimpleNamespace(config=config, curves=[[0.0] * 4])),
        np.zeros(4, bool),
        np.zeros(4, np.float32),
    )
    violation = np.array([stuck, False, False, False])
    view = View(timestep, np.array([-1, -1]), np.zeros(2, int), none, violation, high, high, high, high)
    assert pages.operator(session, view, 0, seats.Seat("key"), {})["resets_begin"] == begins
    fleet = pages.fleet(session, view, np.zeros(2, int), [False, False], {})
    assert fleet["resets_begin"] == (50 if timestep < 50 else -1)


@pytest.mark.parametrize(("given", "period"), [([], 0), (["--initial-period", "7"], 7)])
def test_a_console_has_no_initial_period_unless_asked_for(given, period):
    from fleetjax.io import commands
    from fleetjax.io import flags as command_line

    arguments = command_line.parse(["console", "navigation", *given])
    assert int(commands._config(arguments, commands._parameters(arguments)).initial_period) == period
    arguments = command_line.parse(["run", "navigation"])
    assert int(commands._config(arguments, commands._parameters(arguments)).initial_period) == 500


def test_the_consoles_help_shows_its_own_initial_period(capsys):
    for command, default in (("console", "0"), ("run", "500")):
        with pytest.raises(SystemExit):
            cli.main([command, "navigation", "--help"])
        shown = " ".join(capsys.readouterr().out.split())
        assert f"[default: {default}]" in shown.split("--initial-period")[1].split("--")[0]
