"""How tests compile what is large: XLA's optimisations make a program of MJX three times slower to compile, and no righter."""

import functools

import jax

compiled = functools.partial(
    jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
)
