"""How tests compile what is large: XLA's optimisations make a program of MJX three times slower to compile, and no righter."""

QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
