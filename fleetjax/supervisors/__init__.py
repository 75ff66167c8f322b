"""Supervisors: simulated humans, chosen by registered names."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from fleetjax.envs import allegro_hand, block_push, navigation
from fleetjax.envs.base import Env
from fleetjax.precision import in_32_bits
from fleetjax.registry import Registry
from fleetjax.supervisors import expert
from fleetjax.types import EnvState


class Supervisor(NamedTuple):
    """A human's policy for teleoperation (paper, Section 3); hard resets are the fleet's.

    Attributes:
        act: `(EnvState, key) -> f32[A]`, the action for one robot; one-hot where actions are discrete.
    """

    act: Callable[[EnvState, jax.Array], jax.Array]


def _navigation(env: Env) -> Supervisor:
    del env
    return Supervisor(lambda state, key: navigation.teach(state))


def _block_push(env: Env) -> Supervisor:
    del env
    return Supervisor(block_push.teach)


def _shipped(name: str, view: expert.View = expert.everything) -> Callable[[Env], Supervisor]:
    def make_supervisor(env: Env) -> Supervisor:
        del env
        weights = expert.load_weights(name)
        return Supervisor(lambda state, key: expert.policy(weights, state.obs, view))

    return make_supervisor


SUPERVISORS: Registry[Callable[[Env], Supervisor]] = Registry("supervisor")
_SHIPPED: dict[str, Callable[[Env], Supervisor]] = {
    "humanoid": _shipped("humanoid"),
    "anymal": _shipped("anymal"),
    "allegro_hand": _shipped("allegro_hand", allegro_hand.view),
    "block_push": _block_push,
    "navigation": _navigation,
}


for _name, _make in _SHIPPED.items():
    SUPERVISORS.register(_name, _make)


def register_supervisor(name: str, make_supervisor: Callable[[Env], Supervisor]) -> None:
    """Make a supervisor available to configs, and to environments whose `spec.supervisor` names it.

    Args:
        name: what users call it.
        make_supervisor: `env -> Supervisor`.

    Raises:
        ValueError: if the name is taken.
    """
    SUPERVISORS.register(name, make_supervisor)


def list_supervisors() -> tuple[str, ...]:
    """Return the registered names."""
    return SUPERVISORS.names()


@in_32_bits
def check(name: str, env: Env) -> None:
    """Check that a supervisor is registered and can act in an environment; nothing is computed.

    Raises:
        ValueError: if it is not, or cannot; the message has the closest names, or the reason.
    """
    supervisor = make(name, env)
    state = jax.eval_shape(env.reset, jax.random.key(0), jax.ShapeDtypeStruct((), jnp.int32))
    does_not_fit = f"supervisor = {name!r} does not fit environment = {env.spec.name!r}"
    try:
        action = jax.eval_shape(supervisor.act, state, jax.random.key(0))
    except Exception as error:  # whatever another environment's states make of it
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"{does_not_fit}: it cannot act on its states ({reason}); choose another") from error
    if getattr(action, "shape", None) != (env.spec.action_size,):
        found = getattr(action, "shape", type(action).__name__)
        raise ValueError(f"{does_not_fit}: it gives {found}, and actions have ({env.spec.action_size},); choose another")


def make(name: str, env: Env) -> Supervisor:
    """Return the supervisor `name` for an environment.

    Raises:
        ValueError: if the name is empty or unknown.
    """
    if not name:
        raise ValueError("supervisor = '' and the environment names none; register one and pass its name")
    return SUPERVISORS.get(name)(env)
