"""What people can do in each environment: names of actions, which pages bind to keys and buttons."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.field import OF_HUMANS, SHAPES_OF_HUMANS


class Controls(NamedTuple):
    """How people act on a robot.

    Attributes:
        verb: what a key does to the robot, for people: "drive", "push".
        hold: whether an action continues while its key is held, and several held at once add up (clipped to [-1, 1]);
            else one press is one action.
        actions: f32[A] by name. Pages bind `right`, `up`, `left`, `down` to arrows and WASD, and `stop` to the space bar.
    """

    verb: str
    hold: bool
    actions: Mapping[str, tuple[float, ...]]


# By environment. Another one: `CONTROLS["mine"] = Controls(...)`; it also needs an `Env.picture`.
CONTROLS: dict[str, Controls] = {
    "navigation": Controls("drive", True, {"right": (1, 0), "up": (0, 1), "left": (-1, 0), "down": (0, -1), "stop": (0, 0)}),
    "block_push": Controls(
        "push", False, {"right": (1, 0, 0, 0), "up": (0, 1, 0, 0), "left": (0, 0, 1, 0), "down": (0, 0, 0, 1)}
    ),
}


def check_people(config: Config) -> None:
    """Check that no models of people and links are asked for, which a console has none of.

    Raises:
        ValueError: if there are; the message names the fields.
    """
    if config.human_model != "perfect":
        names = [name for name in OF_HUMANS if name not in SHAPES_OF_HUMANS]
        given = [name for name in names if any(np.any(np.asarray(x) != 0) for x in jax.tree.leaves(getattr(config, name)))]
        raise ValueError(
            f"{', '.join(given) or f'human_model = {config.human_model!r}'} cannot be used in a console, where people have "
            'their own times and make their own mistakes; omit it, or use "fleetjax run"'
        )
    if config.link_model != "perfect":
        raise ValueError(f'link_model = {config.link_model!r} cannot be used in a console; omit it, or use "fleetjax run"')


def controls_of(env: Env) -> Controls:
    """Return how people act in an environment.

    Raises:
        ValueError: if they cannot: it has no picture, or no controls are known.
    """
    name = env.spec.name
    known = [other for other in CONTROLS if other != name]
    choose = f"choose one of {', '.join(known)}" if known else "add one to fleetjax.console.controls.CONTROLS"
    if env.picture is None:
        raise ValueError(f"environment = {name!r} has no picture for people to look at; {choose}")
    if name not in CONTROLS:
        raise ValueError(f"environment = {name!r} has no controls for people to use; {choose}")
    return CONTROLS[name]


def action_of(controls: Controls, names: Sequence[str]) -> np.ndarray:
    """Return the action f32[A] that pressed keys amount to.

    Args:
        controls: the environment's.
        names: of the actions, each once.

    Raises:
        ValueError: if a name is unknown, or there are too many or none.

    >>> action_of(CONTROLS["navigation"], ["up", "right"]).tolist()
    [1.0, 1.0]
    """
    if not names or len(set(names)) < len(names) or not set(names) <= set(controls.actions):
        raise ValueError(f"actions must be distinct, and among {', '.join(controls.actions)}")
    if len(names) > 1 and not controls.hold:
        raise ValueError("one action at a time")
    return np.clip(np.sum([controls.actions[name] for name in names], axis=0), -1.0, 1.0).astype(np.float32)
