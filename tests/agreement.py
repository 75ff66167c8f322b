"""How tests compare physics backends: recorded states and controls, and what differs after a control step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from compiling import compiled
from record_states import DATA, physics_of

from fleetjax.physics.base import PhysicsState

NUM_ROBOTS = 32  # of every batch, so that MJX compiles once


@functools.cache
def mover(name: str, backend: str):
    """Return `(states, controls, active) -> states` of a batch of robots."""
    step = compiled(jax.vmap(physics_of(name, backend).step))

    def move(states: PhysicsState, control, active=True) -> PhysicsState:
        return jax.tree.map(np.asarray, step(states, control, jnp.broadcast_to(active, NUM_ROBOTS)))

    return move


@functools.cache
def recorded(name: str) -> tuple[PhysicsState, np.ndarray]:
    """128 states before a violation, the first half of them with three contacts or more, and controls for each."""
    with np.load(DATA / f"{name}_states.npz") as arrays:
        fields = dict(arrays)
    control = fields.pop("control")
    return PhysicsState(**fields), control


def rows(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


def mixed(name: str) -> tuple[PhysicsState, np.ndarray]:
    """Recorded states, half of each kind, and their controls, enough for a batch."""
    return rows(recorded(name), slice(64 - NUM_ROBOTS // 2, 64 + NUM_ROBOTS // 2))


# Median and 95th percentile that the largest error of a robot must stay below: three times what was measured, and three (the
# hand) to ten times.
BOUNDS = {  # m and rad; m/s and rad/s; N and N m; m/s^2 and rad/s^2
    "humanoid": {"qpos": (3e-6, 2e-4), "qvel": (2e-4, 2e-2), "sensors": (2e-2, 15.0), "warmstart": (3e-2, 5.0)},
    "anymal": {"qpos": (1e-6, 2e-5), "qvel": (5e-5, 2e-3), "warmstart": (6e-3, 3e-1)},
    "allegro_hand": {"qpos": (4e-4, 5e-2), "qvel": (3e-2, 5.0), "warmstart": (1.5, 7e2)},
}


WARP_TAILS = {  # where the solver stops before it converges, and at the cube's faces, other contacts lead to other places
    "humanoid": {"qpos": 2e-2, "qvel": 1.0, "sensors": 50.0, "warmstart": 2e2},
    "anymal": {},
    "allegro_hand": {"qpos": 5e-2, "qvel": 5.0, "warmstart": 7e2},
}


def assert_agree_with_native(name: str, backend: str) -> None:
    """Check one control step; the largest error of a robot, over robots: median and 95th percentile."""
    states, controls = recorded(name)
    errors = {field: [] for field in BOUNDS[name]}
    for batch in np.split(np.arange(len(controls)), len(controls) // NUM_ROBOTS):
        one, other = (mover(name, by)(rows(states, batch), controls[batch]) for by in ("native", backend))
        np.testing.assert_allclose(one.time, other.time, rtol=1e-6)
        for field, found in errors.items():
            found.append(np.abs(getattr(one, field) - getattr(other, field)).max(axis=1))
    for field, (median, tail) in BOUNDS[name].items():
        error = np.concatenate(errors[field])
        typical, rare = np.quantile(error, [0.5, 0.95])
        print(f"{name} {field} {backend}: median {typical:.1e}, 95th percentile {rare:.1e}, largest {error.max():.1e}")
        assert typical < median, field
        assert rare < (WARP_TAILS[name].get(field, tail) if backend == "warp" else tail), field
