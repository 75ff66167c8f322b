"""How tests compile what is large, whatever else runs: XLA's optimisations take three times as long, and make it no righter."""

from typing import Any

import jax

_QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}


def compiled(function: Any, **options: Any) -> Any:
    """Return what `jax.jit` does, compiled quickly on a CPU."""
    return jax.jit(function, compiler_options=_QUICKLY if jax.default_backend() == "cpu" else None, **options)
