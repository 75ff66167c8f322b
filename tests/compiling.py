"""How tests compile what is large, whatever else runs: XLA's optimisations take three times as long, and make it no righter."""

import os
from typing import Any

_FLAG = "--xla_cpu_use_fusion_emitters=false"
_QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}


def environment() -> dict[str, str]:
    """Return variables that make a process compile quickly. They must be set before it imports JAX."""
    flags = [flag for flag in os.environ.get("XLA_FLAGS", "").split() if flag != _FLAG]
    return {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "XLA_FLAGS": " ".join([*flags, _FLAG])}


def compiled(function: Any, **options: Any) -> Any:
    """Return what `jax.jit` does, compiled quickly on a CPU."""
    import jax  # only now, since `conftest.py` sets the environment first

    return jax.jit(function, compiler_options=_QUICKLY if jax.default_backend() == "cpu" else None, **options)
