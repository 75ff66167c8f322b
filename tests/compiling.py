"""How tests compile what is large, whatever else runs: XLA's optimisations take three times as long, and make it no righter."""

import functools

import jax

compiled = functools.partial(
    jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
)
