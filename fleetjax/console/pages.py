"""What pages are told, as JSON: the operator's view of one robot, and everybody's view of the fleet."""

import base64
import io
import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from fleetjax.config import Config
from fleetjax.console.controls import controls_of
from fleetjax.console.engine import EMPTY, PERSON, View
from fleetjax.console.seats import Seat
from fleetjax.console.session import Session
from fleetjax.field import ORDERS_WITH_C
from fleetjax.io import text
from fleetjax.priority import get_algorithm
from fleetjax.types import EnvState

POINTS = 120  # of a curve
TILE = 96  # pixels, of a robot on the fleet's page
_WHO = ("empty", "person", "simulated")


def to_json(content: Mapping[str, Any]) -> str:
    """Return a message as it is sent."""
    return json.dumps(content, allow_nan=False, separators=(",", ":"))


def introduction(session: Session, interval: float) -> dict[str, Any]:
    """Return what does not change: names, times, controls."""
    config, controls = session.config, controls_of(session.env)
    return {
        "headline": text.headline(config, session.run.seed),
        "robots": config.num_robots,
        "seats": config.num_humans,
        "steps": config.num_steps,
        "interval": interval,
        "verb": controls.verb,
        "hold": controls.hold,
        "actions": list(controls.actions),
        "resetTime": int(config.hard_reset_time),
    }


def portraits(session: Session, robots: Collection[int]) -> dict[int, str]:
    """Return large pictures of robots, as data."""
    env, engine = session.engine.state.env, session.engine
    return {robot: _encode(engine.pictures(env, np.array([robot], np.int32))[0]) for robot in robots}


def tiles(session: Session, env: EnvState, view: View) -> dict[int, str]:
    """Return small pictures for the fleet's page, as data: of robots that have help, then in violation, then others.

    Args:
        session: the run.
        env: EnvState[N] at the timestep.
        view: the timestep.
    """
    helped = [int(robot) for robot in view.robot if robot >= 0]
    others = [i for i in np.argsort(~view.violation, kind="stable").tolist() if i not in helped]
    robots = np.array([*helped, *others][: session.num_tiles], np.int32)
    return {
        int(robot): _encode(picture, TILE) for robot, picture in zip(robots, session.engine.pictures(env, robots), strict=True)
    }


def _encode(picture: np.ndarray, width: int = 0) -> str:
    """Return a picture u8[H, W, 3] as a data URL, made smaller to about `width`."""
    image = Image.fromarray(picture)
    if width and image.width >= 2 * width:
        image = image.reduce(image.width // width)
    data = io.BytesIO()
    image.save(data, "png", compress_level=1)
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode()


def operator(session: Session, view: View, number: int, seat: Seat, pictures: Mapping[int, str]) -> dict[str, Any]:
    """Return what the person in a seat sees at a timestep."""
    robot = seat.robot
    content: dict[str, Any] = {"type": "state", "tick": view.timestep, "steps": session.config.num_steps, "robot": robot}
    if robot < 0:
        waiting = bool(np.any(view.violation))
        return content | {"mode": "free", "resets_begin": _resets_begin(session.config, view.timestep) if waiting else -1}
    config, done = session.config, int(view.duration[number])
    signals = _signals(session, view, robot)
    needed = int(config.hard_reset_time if seat.resetting else config.min_teleop_time)
    return content | {
        "since": seat.since,
        "mode": "reset" if seat.resetting else "drive",
        "confirmed": seat.confirmed,
        "bound": max(0, needed - done),
        "needed": needed,
        "why": _why(signals, violation=bool(view.violation[robot]), bound=done < needed),
        "signals": signals,
        "picture": pictures.get(robot),
    }


def _signals(session: Session, view: View, robot: int) -> list[dict[str, Any]]:
    """Return a robot's signals beside their thresholds."""
    config = session.config
    estimators = get_algorithm(config.algorithm).estimators
    compared = _compared(config.algorithm)
    limits = {"uncertainty": config.uncertainty_threshold, "risk": config.risk_threshold}
    threshold = {name: float(limit) for name, limit in limits.items() if name in compared}
    rows: list[tuple[str, float, float | None]] = [
        ("uncertainty", float(view.uncertainty[robot]), threshold.get("uncertainty"))
    ]
    if "safety" in estimators:
        rows.append(("risk", float(view.risk[robot]), threshold.get("risk")))
    if "goal" in estimators:
        rows.append(("chance of success", float(view.goal[robot]), None))
    return [{"name": name, "value": value, "threshold": threshold} for name, value, threshold in rows]


def _compared(algorithm: str) -> tuple[str, ...]:
    """Return the signals that an algorithm compares with their thresholds; what users registered may do without."""
    if algorithm == "ensemble_dagger":
        return ("uncertainty",)
    letters = {"u": "uncertainty", "r": "risk"} if text.is_order(algorithm) else {}
    return tuple(name for letter, name in letters.items() if letter in algorithm)


def _why(signals: list[dict[str, Any]], *, violation: bool, bound: bool) -> str:
    """Return why a robot has help, in a few words."""
    if violation:
        return "in violation: it stands still until a hard reset"
    compared = [s for s in signals if s["threshold"] is not None]
    above = [s["name"] for s in compared if s["value"] >= s["threshold"]]
    if above:
        return " and ".join(above) + " above the threshold"
    if bound and compared:
        return "no signal is above its threshold now; the help still has its shortest time to go"
    return "highest priority"


def fleet(
    session: Session, view: View, kinds: np.ndarray, confirmed: Sequence[bool], pictures: Mapping[int, str]
) -> dict[str, Any]:
    """Return what everybody sees of the fleet at a timestep.

    Args:
        session: the run.
        view: the timestep.
        kinds: u8[M] who sits in each seat.
        confirmed: whether each seat's person confirmed the hard reset.
        pictures: of robots, as data.
    """
    helper = {int(robot): seat for seat, robot in enumerate(view.robot) if robot >= 0}
    robots = [
        {
            "violation": bool(view.violation[i]),
            "helper": helper.get(i, -1),
            "uncertainty": round(float(view.uncertainty[i]), 4),
            "risk": round(float(view.risk[i]), 3),
        }
        for i in range(session.config.num_robots)
    ]
    seats = [
        {"who": _WHO[kind], "robot": int(robot), "resets": bool(robot >= 0 and view.resetting[robot])}
        for kind, robot in zip(kinds, view.robot, strict=True)
    ]
    for seat, kind, sure in zip(seats, kinds, confirmed, strict=True):
        seat["waits"] = bool(seat["resets"] and kind == PERSON and not sure)  # until its person presses R
    places = np.unique(np.linspace(0, len(session.curves) - 1, POINTS).round().astype(int)).tolist()
    curves = [[round(session.curves[i][panel], 4) for i in places] for panel in range(4)]
    return {
        "type": "fleet",
        "tick": view.timestep,
        "resets_begin": _resets_begin(session.config, view.timestep),
        "robots": robots,
        "seats": seats,
        "people": int(np.sum(kinds == PERSON)),
        "empty": int(np.sum(kinds == EMPTY)),
        "pictures": pictures,
        "places": places,
        "curves": curves,
    }


def _resets_begin(config: Config, timestep: int) -> int:
    """Return the timestep before which robots in violation wait, -1 if it has come."""
    waits = config.algorithm in (*ORDERS_WITH_C, "weighted", "asa")
    begins = int(config.initial_period)
    return begins if waits and timestep < begins else -1
