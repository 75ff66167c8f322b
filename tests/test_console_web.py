"""Consoles as clients meet them: pages and WebSockets, what is refused, what goes wrong; and real browsers."""

import asyncio
import contextlib
import json
import shutil
import socket

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from consoles import claim, compile_once, hear, make_session, say, serving
from websockets.exceptions import ConnectionClosed, InvalidStatus

from fleetjax import envs
from fleetjax.console import engine, messages, record, server
from fleetjax.envs import base
from fleetjax.io import folder

LONG = 100_000  # timesteps: sessions end when they are stopped
TOKEN = "correct-horse-battery"


@pytest.fixture(autouse=True)
def quick_compilation(monkeypatch):
    monkeypatch.setattr(engine, "compile_programs", compile_once)


@pytest.fixture
def session(tmp_path):
    made = make_session(tmp_path / "run", num_steps=LONG)
    with contextlib.closing(made):
        yield made


@pytest.fixture
def served(session):
    with serving(session) as made:
        yield made


def records(session) -> np.ndarray:
    """Return what was recorded so far."""
    data = (session.run.folder / folder.RECORD).read_bytes()
    return record.parse(data, session.config, envs.make("navigation").spec)


def next_tick(page) -> dict:
    """Return the state of a timestep that begins after now."""
    first = hear(page, "state", "fleet")["tick"]
    while (state := hear(page, "state", "fleet"))["tick"] <= first + 1:
        say(page, type="seen")
    return state


def closing_code(page) -> int:
    """Wait until the console closes a page, and return its code."""
    with pytest.raises(ConnectionClosed) as closed:
        hear(page, "nothing")
    return closed.value.rcvd.code


def act(page, state, **changes) -> None:
    known = {name: state.get(name, -1) for name in ("robot", "since", "tick")}
    say(page, type="act", **known | {"held": ["up"]} | changes)


def placed(position: list[float], goal: list[float], *, violation: bool = False) -> base.EnvState:
    """Return a robot that stands still at a place."""
    physics = jnp.array([*position, 0.0, 0.0, *goal])
    state = base.begin(physics, jnp.array([*position, 0.0, 0.0, *goal, goal[0] - position[0], goal[1] - position[1]]))
    return state._replace(violation=jnp.asarray(violation))


def place(session, *robots: base.EnvState) -> None:
    """Put robots where they are wanted, under a policy that hardly moves them."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *robots)
    policy = session.engine.state.policy
    policy = policy._replace(params=jax.tree.map(lambda x: 0.01 * x, policy.params))
    session.engine.state = session.engine.state._replace(env=stacked, policy=policy)


# Who may come in


def test_pages_are_served_safely(served):
    for path, words in (("/", b"Take a seat"), ("/operator", b"Hard reset"), ("/fleet", b"Who helps whom")):
        answer = served.get(path)
        assert answer.status == 200
        assert words in answer.body
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "server" not in answer.headers
    for name in ("style.css", "operator.js", "fleet.js", "common.js", "index.js"):
        assert served.get(f"/static/{name}").status == 200
    for path in ("/static/../server.py", "/static/%2e%2e/server.py", "/static/", "/metrics.csv", "/ws/operator"):
        assert served.get(path).status == 404


def test_pages_need_nothing_from_elsewhere():
    for page in server.STATIC.iterdir():
        text = page.read_text()
        assert "http:" not in text.replace("http://www.w3.org/2000/svg", "")
        assert "https://" not in text
        assert "innerHTML" not in text


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "192.168.0.9", "", "[", "a b"])
def test_other_host_names_are_refused(served, host):
    assert served.get("/", Host=host).status in (400, 421)
    with pytest.raises(InvalidStatus) as refusal:
        served.page(additional_headers={"Host": host, "Origin": f"http://{host}"})
    assert refusal.value.response.status_code in (400, 403)


MALFORMED_HOSTS = (
    *("127.0.0.1:abc", "127.0.0.1:99999", "127.0.0.1:-1", "127.0.0.1:1:2", "127.0.0.1:8 0", "127.0.0.1:\xb2", "localhost:0x50"),
    *("[::1", "[::1]:abc", "[]", "[", "]", "::1", ":80", ":", "127.0.0.1/", "127.0.0.1?a", "127.0.0.1#a", "me@127.0.0.1"),
    *("127.0.0.1\\", "127.0.0.1\t80", "\xff", "\xc2\xbd", "%00", "127.0.0.1, 127.0.0.1", "x" * 5000, "127.0.0.1:" + "9" * 5000),
)
MALFORMED_ORIGINS = (
    "http://",
    "://",
    "http://[",
    "http://[::1",
    "http://127.0.0.1:abc",
    "\xff",
    "x" * 5000,
    "http://127.0.0.1:99999",
)
MALFORMED_COOKIES = (
    "=",
    ";",
    "a=\xff",
    'fleetjax-="\\777',
    "\x7f",
    "[]=1",
    "$Version=1; =",
    'a="' + "\\" * 2000,
    "a=b; " * 1000,
)


@pytest.mark.parametrize("token", [None, TOKEN])
def test_malformed_headers_are_refused(session, token):
    with serving(session, token=token) as served:
        for host in MALFORMED_HOSTS:
            for path in ("/", "/ws/operator", f"/?token={TOKEN}"):
                assert served.get(path, Host=host).status in (400, 421), host
            with pytest.raises(InvalidStatus) as refusal:
                served.page(additional_headers={"Host": host, "Origin": f"http://{host}"})
            assert refusal.value.response.status_code in (400, 403), host
        for origin in MALFORMED_ORIGINS:
            with pytest.raises(InvalidStatus) as refusal:
                served.page(additional_headers={"Origin": origin})
            assert refusal.value.response.status_code in (400, 403), origin
        for cookie in MALFORMED_COOKIES:
            assert served.get("/", Cookie=cookie).status in (400, 403 if token else 200), cookie


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "LOCALHOST", "[::1]", "127.0.0.1:9999"])
def test_names_of_this_machine_are_let_in(served, name):
    assert served.get("/", Host=name).status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "", "http://127.0.0.1", "http://127.0.0.1:1", "file://"])
def test_websockets_of_other_origins_are_refused(served, origin):
    with pytest.raises(InvalidStatus) as refusal:
        served.page(additional_headers={"Origin": origin})
    assert refusal.value.response.status_code == 403


def test_a_token_is_needed_everywhere_once_it_is_set(session):
    with serving(session, token=TOKEN) as served:
        name = f"fleetjax-{served.port}"
        for headers in (
            {},
            {"Cookie": f"{name}=wrong-horse-battery"},
            {"Cookie": ";;=,=x"},
            {"Cookie": f"{name}={'x' * 2000}"},
        ):
            for path in ("/", "/operator", "/fleet", "/static/operator.js", "/nothing"):
                answer = served.get(path, **headers)
                assert answer.status == 403
                assert TOKEN.encode() not in answer.body
            with pytest.raises(InvalidStatus):
                served.page(additional_headers=headers)
        assert served.get("/?token=wrong-horse-battery").status == 403
        assert served.get("/?token=").status == 403
        answer = served.get(f"//evil.example/?token={TOKEN}&seat=2")
        assert answer.headers["location"].startswith("/evil.example")
        answer = served.get(f"/operator?token={TOKEN}&seat=2")
        assert (answer.status, answer.headers["location"]) == (303, "/operator?seat=2")
        cookie = answer.headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "samesite=lax" in cookie.lower()
        right = {"Cookie": cookie.split(";")[0]}
        assert served.get("/operator", **right).status == 200
        with served.page(additional_headers=right) as page:
            assert claim(page)["seat"] == 0


# What clients do wrong


def test_malformed_messages_are_answered_and_at_last_the_client_is_closed(served):
    with served.page() as page, served.page() as other:
        flying = '{"type": "act", "robot": 0, "since": 0, "tick": 0, "held": ["fly"]}'
        for text in ("{", "[" * 900, b"\x00\x01", '{"type": "act"}', flying):
            page.send(text)
            assert hear(page, "error")["reason"]
        for _ in range(server.MOST_ERRORS - 5):
            page.send("nonsense")
        assert closing_code(page) == 1008
        assert claim(other)["type"] == "seat"
        next_tick(other)


def test_oversized_messages_close_the_client_alone(served):
    with served.page() as page, served.page() as other:
        page.send("x" * (messages.LONGEST + 1))
        assert closing_code(page) == 1009
        assert claim(other)["type"] == "seat"
        next_tick(other)


def test_a_flood_closes_the_client_alone(session):
    with serving(session, interval=30.0, wait=1) as served, served.page() as page, served.page() as other:
        claim(page)
        hear(page, "state")  # messages are counted from here
        for _ in range(server.MOST_MESSAGES + 1):
            say(page, type="seen")
        assert closing_code(page) == 1008
        assert claim(other)["type"] == "seat"


def test_watchers_cannot_act(served):
    with served.page("fleet") as page:
        say(page, type="claim", key="", seat=0)
        assert "only watches" in hear(page, "error")["reason"]


def test_two_people_cannot_have_one_seat(served):
    with served.page() as first, served.page() as second:
        assert claim(first, seat=1)["seat"] == 1
        answer = claim(second, seat=1)
        assert (answer["type"], answer["reason"], answer["free"]) == ("taken", "seat 2 is taken", [0])
        assert claim(second, key="x" * 22, seat=1)["type"] == "taken"
        assert claim(second)["seat"] == 0


def test_actions_for_robots_of_others_are_refused_and_leave_no_trace(session):
    with serving(session) as served, served.page() as mine, served.page() as theirs:
        claim(mine)
        claim(theirs)
        state = next_tick(mine)
        other = next_tick(theirs)
        assert state["robot"] != other["robot"]
        act(mine, other)
        assert "not yours" in hear(mine, "refused")["reason"]
        act(mine, state, since=state["since"] + 1)
        assert "not yours" in hear(mine, "refused")["reason"]
        act(mine, state, tick=LONG)
        assert hear(mine, "refused")["reason"]
        say(mine, type="reset", robot=other["robot"], since=other["since"])
        assert hear(mine, "refused")["reason"]
        next_tick(mine)
    assert not records(session)["given"].any()


def test_who_has_no_seat_cannot_act(served):
    with served.page() as page:
        act(page, {"robot": 0, "since": 0, "tick": 0})
        assert "no seat" in hear(page, "refused")["reason"]


# Connections that are lost


def wait_until_free(served) -> None:
    """Wait until nobody sits in the first seat."""
    with served.page("fleet") as watch:
        while hear(watch, "fleet")["seats"][0]["who"] != "empty":
            pass


def test_a_lost_connection_frees_the_seat_and_gives_nothing_more(session):
    session.config = session.engine.config = session.config.replace(min_teleop_time=10_000)  # help stays with its robot
    with serving(session, timeout=2.0) as served:
        with served.page() as page:
            claim(page)
            state = next_tick(page)
            act(page, state)
            next_tick(page)
        last = len(session.metrics)
        wait_until_free(served)
    rows = records(session)
    assert rows["given"].sum() == 1
    assert not rows["given"][last:].any()
    assert (rows["seat"][last:, 0] == engine.PERSON).any()  # kept for a while
    assert rows["seat"][-1, 0] == engine.EMPTY
    assert rows["robot"][-1, 0] == -1


def test_what_was_not_used_when_a_connection_is_lost_is_forgotten(session):
    with serving(session, interval=3.0, wait=1) as served:
        with served.page() as page:
            claim(page)
            act(page, hear(page, "state"))
            act(page, {})
            hear(page, "refused")  # so the first was taken
            assert served.console.seats.seats[0].action is not None
        while served.console.clients:
            pass
        assert served.console.seats.seats[0].key
        served.console.options = served.console.options._replace(interval=0.02)
    assert not records(session)["given"].any()


@pytest.mark.slow
def test_a_crashed_robot_of_a_lost_person_waits(session):
    place(session, *[placed([-0.8, 0.0], [-0.5, 0.0], violation=True)] * 4)
    with serving(session, timeout=2.0) as served:
        with served.page() as page:
            claim(page)
            state = next_tick(page)
            assert state["mode"] == "reset"
        wait_until_free(served)
    assert sum(m.hard_resets[0] for m in session.metrics) == 0
    assert sum(m.moving[0] for m in session.metrics) == 0


def test_a_silent_client_is_told_that_its_seat_is_free(session):
    with serving(session, timeout=0.5) as served, served.page() as page:
        claim(page)
        hear(page, "expired")
        assert claim(page)["type"] == "seat"


def test_coming_back_with_the_key_gives_the_same_seat_and_robot(session):
    with serving(session, timeout=60.0) as served, served.page() as other:
        claim(other)
        with served.page() as page:
            given = claim(page)
            robot = next_tick(page)["robot"]
        with served.page() as page:
            assert claim(page, key=given["key"]) == given
            assert hear(page, "state")["robot"] >= 0
            with served.page() as elsewhere:
                assert claim(elsewhere, key=given["key"]) == given
                hear(page, "replaced")
                assert closing_code(page) == 1000
        assert robot >= 0


def test_a_page_with_a_seat_gets_no_other_by_its_key(served):
    with served.page() as page, served.page() as other:
        key, mine = claim(page)["key"], claim(other)
        answer = claim(other, key=key)
        assert (answer["type"], answer["reason"], answer["free"]) == ("taken", "you already have a seat", [])
        assert claim(other, key=mine["key"], seat=0) == mine
        assert claim(page, key=key, seat=1)["seat"] == 0


def test_a_page_that_is_replaced_gets_no_other_seat_before_it_is_closed(session):
    async def seats_in_the_end() -> list[int | None]:
        console = server.Console(session, server.Options("127.0.0.1", 0, None, 0.02, 60.0, 0, simulated=False))
        page, other = server.Client("operator"), server.Client("operator")
        ask = {"type": "claim", "key": "", "seat": -1}
        console._hear(page, json.dumps(ask))
        key = json.loads(page.notices[-1])["key"]
        console._hear(other, json.dumps(ask | {"key": key}))
        console._hear(page, json.dumps(ask))
        return [None if seat.client is None else (page, other).index(seat.client) for seat in console.seats.seats]

    assert asyncio.run(seats_in_the_end()) == [1, None]


def test_leaving_frees_the_seat_at_once(served):
    with served.page() as page, served.page() as other:
        claim(page, seat=0)
        say(page, type="leave")
        hear(page, "left")
        assert claim(other, seat=0)["type"] == "seat"


# Many, and slow ones


def test_fifty_pages_watch(served):
    with contextlib.ExitStack() as stack:
        watchers = [stack.enter_context(served.page("fleet")) for _ in range(50)]
        for page in watchers:
            state = hear(page, "fleet")
            assert len(state["robots"]) == 4
            assert len(state["pictures"]) == 4
            assert len(state["curves"]) == 4
        operator = stack.enter_context(served.page())
        claim(operator)
        before = hear(operator, "state")["tick"]
        assert next_tick(operator)["tick"] > before


def test_a_client_that_does_not_read_holds_nobody_up_and_misses_only_old_states(served):
    with socket.create_connection(("127.0.0.1", served.port)) as slow, served.page() as page:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        head = f"GET /ws/fleet HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nOrigin: {served.url}\r\nUpgrade: websocket\r\n"
        head += f"Connection: Upgrade\r\nSec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        slow.sendall(head.encode())
        claim(page)
        for _ in range(100):
            say(page, type="seen")
            hear(page, "state")
        blocked = [client for client in served.console.clients if client.kind == "fleet"]
        assert len(blocked) == 1
        assert len(blocked[0].notices) <= 32
        next_tick(page)


def test_a_mailbox_keeps_notices_and_the_newest_state():
    client = server.Client("fleet")
    client.show("old")
    client.tell({"type": "notice"})
    client.show("new")
    assert (list(client.notices), client.state) == (['{"type":"notice"}'], "new")


def test_the_first_timestep_waits_for_people(session):
    with serving(session, wait=2) as served, served.page() as first, served.page() as second:
        claim(first)
        assert hear(first, "waiting")["people"] <= 1
        assert served.session.metrics == []
        claim(second)
        say(first, type="seen")
        assert hear(first, "state")["tick"] >= 0


def test_everyone_is_told_when_it_is_over(session):
    with serving(session) as served, served.page() as page, served.page("fleet") as watch:
        next_tick(watch)
        served.console.stop()
        assert hear(page, "over")["tick"] > 0
        assert hear(watch, "over")["tick"] > 0


# Real browsers

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture
def browser():
    """A real browser; it fails tests whose pages report an error."""
    if CHROMIUM is None:
        pytest.skip("no chromium is installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as tools:
        launched = tools.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"], timeout=180_000)
        yield launched
        launched.close()


def open_page(browser, served, path: str, errors: list[str], **options):
    page = browser.new_context(**options).new_page()
    page.set_default_timeout(60_000)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto(served.url + path)
    return page


def mode(page, *wanted: str) -> str:
    """Wait until a seat is in one of some modes, and return it."""
    page.wait_for_function("modes => modes.includes(document.getElementById('desk')?.dataset.mode)", arg=list(wanted))
    return page.get_attribute("#desk", "data-mode")


def wait_for_action(page, session, action: tuple[float, float]) -> None:
    """Wait until an action of seat 2 is on record."""
    while True:
        rows = records(session)
        if action in map(tuple, rows["action"][:, 1][rows["given"][:, 1] == 1].tolist()):
            return
        page.wait_for_timeout(50)


def test_two_people_reset_one_robot_and_drive_another_to_its_goal(session, browser):
    session.config = session.engine.config = session.config.replace(min_teleop_time=10_000)
    stuck, ready = placed([-0.8, 0.5], [-0.5, 0.5], violation=True), placed([-0.8, 0.0], [-0.5, 0.0])
    place(session, stuck, ready, ready, ready)
    before = int(session.engine.state.human_data.pairs.size)
    errors: list[str] = []
    with serving(session, interval=0.5, wait=2) as served:  # slowly at first: robots go on by themselves
        pages = [open_page(browser, served, "/operator", errors) for _ in range(2)]
        fleet = open_page(browser, served, "/fleet", errors)
        resetting = next(page for page in pages if mode(page, "reset", "drive") == "reset")
        driving = next(page for page in pages if page is not resetting)
        assert mode(driving, "drive")
        assert "robot 0 is stuck" in resetting.text_content("#turn")
        assert resetting.is_disabled("#pad button")
        assert driving.get_attribute("#picture", "src").startswith("data:image/png;base64,")
        resetting.reload()
        mode(resetting, "reset")
        for page in pages:
            page.wait_for_function("() => document.getElementById('seat').textContent.startsWith('Seat ')")
        assert sorted(page.text_content("#seat") for page in pages) == ["Seat 1", "Seat 2"]
        fleet.wait_for_function("() => document.getElementById('seats').textContent.includes('robot 0 waits for R')")
        assert sum(m.hard_resets[0] for m in session.metrics) == 0
        served.console.options = served.console.options._replace(interval=0.1)
        resetting.keyboard.press("r")
        mode(resetting, "drive", "free")
        driving.keyboard.down("ArrowRight")
        fleet.wait_for_function("() => Number(document.querySelector('#curves strong').textContent) >= 1")
        driving.keyboard.up("ArrowRight")
        for words in ("Seat 1 (person)", "Seat 2 (person)", "helps robot"):
            assert words in fleet.text_content("#seats")
    assert errors == []
    rows = records(session)
    given = rows["given"] == 1
    assert sum(m.hard_resets[0] for m in session.metrics) == 1
    assert sum(m.successes[0] for m in session.metrics) >= 1
    assert rows["confirmed"].sum() == 2  # t_R timesteps, one press
    data = session.engine.state.human_data.pairs
    assert int(data.size) - before == given.sum() > 0
    np.testing.assert_array_equal(data.rows.action[before : int(data.size)], rows["action"][given])
    assert set(map(tuple, rows["action"][given].tolist())) == {(1.0, 0.0)}
    assert len(set(rows["robot"][given].tolist())) == 1


@pytest.mark.slow
def test_a_reload_keeps_the_seat_and_buttons_do_what_keys_do(session, browser):
    session.config = session.engine.config = session.config.replace(min_teleop_time=10_000)
    place(session, *[placed([-0.8, 0.0], [0.8, 0.0])] * 4)
    errors: list[str] = []
    with serving(session, interval=0.3, wait=1) as served:
        page = open_page(browser, served, "/operator?seat=2", errors, has_touch=True, viewport={"width": 390, "height": 844})
        mode(page, "drive")
        assert page.text_content("#seat") == "Seat 2"
        robot = page.text_content("#turn")
        page.reload()
        mode(page, "drive")
        assert (page.text_content("#seat"), page.text_content("#turn")) == ("Seat 2", robot)
        page.tap("[data-name=up]")
        wait_for_action(page, session, (0.0, 1.0))
        page.focus("[data-name=left]")
        page.keyboard.press("Enter")
        wait_for_action(page, session, (-1.0, 0.0))
        other = open_page(browser, served, "/operator?seat=2", errors)
        other.wait_for_selector("#choices button")
        assert other.text_content("#turn") == "Seat 2 is taken"
        other.click("#choices button")
        mode(other, "drive", "reset")
        assert other.text_content("#seat") == "Seat 1"
        page.click("#leave")
        page.wait_for_selector("#choices button")
        assert page.text_content("#turn") == "You have left your seat."
    assert errors == []


@pytest.mark.slow
def test_a_token_opens_the_pages_of_a_browser(session, browser):
    errors: list[str] = []
    with serving(session, token=TOKEN) as served:
        page = open_page(browser, served, f"/?token={TOKEN}", errors)
        page.wait_for_function("() => document.getElementById('headline').textContent.includes('navigation')")
        assert page.url == served.url + "/"
        page.click("text=Watch the fleet")
        page.wait_for_function("() => document.querySelectorAll('#robots img[src]').length === 4")
        page.click("text=Take a seat")
        mode(page, "drive", "reset")
    assert errors == []
