"""A robot's physics: a MuJoCo model, bound to a backend."""

import importlib.util
from pathlib import Path

import jax
import mujoco

from fleetjax.physics import native
from fleetjax.physics.contract import Physics, PhysicsState, initial_state

__all__ = ["BACKENDS", "MODELS", "Physics", "PhysicsState", "check_backend", "make_physics", "resolve_backend"]

BACKENDS = ("auto", "native", "mjx", "warp")
MODELS = Path(__file__).parent / "models"


def resolve_backend(backend: str) -> str:
    """Return the backend that `"auto"` stands for here: native on a CPU, mjx elsewhere.

    Raises:
        ValueError: if `backend` is unknown.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend = {backend!r} is unknown; choose one of {', '.join(BACKENDS)}")
    if backend != "auto":
        return backend
    return "native" if jax.default_backend() == "cpu" else "mjx"


def check_backend(backend: str) -> None:
    """Check that this process can simulate robots by a backend.

    Raises:
        ValueError: if `backend` is unknown, or it is warp and there is no NVIDIA GPU, or warp is not installed.
    """
    if resolve_backend(backend) != "warp":
        return
    missing = [] if jax.default_backend() == "gpu" else ["JAX finds no GPU here"]
    missing += [] if importlib.util.find_spec("warp") else ["warp-lang is not installed"]
    if missing:
        raise ValueError(
            f"backend = 'warp' needs an NVIDIA GPU and pip install \".[cuda12,warp]\" ({' and '.join(missing)}); "
            "or choose backend = 'mjx'"
        )


def make_physics(model_file: str, *, substeps: int, backend: str = "auto") -> Physics:
    """Load a MuJoCo model and bind it to a backend.

    Args:
        model_file: file name below `fleetjax/physics/models`, or the absolute path of a model of your own.
        substeps: simulation steps in one control step.
        backend: `"native"` (MuJoCo C on CPU threads), `"mjx"` (pure JAX), `"warp"` (NVIDIA GPUs) or `"auto"`.

    Raises:
        ValueError: if `backend` is unknown.
    """
    backend = resolve_backend(backend)
    model = mujoco.MjModel.from_xml_path(str(MODELS / model_file))
    if backend == "native":
        step = native.make_step(model, substeps)
    else:
        module = importlib.import_module(f"fleetjax.physics.{backend}")  # on demand: it takes seconds
        step = module.make_step(model, substeps)
    return Physics(initial_state(model), step, model, substeps * float(model.opt.timestep))
