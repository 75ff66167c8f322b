"""Settings that every test shares: strict dtypes, quick compilation, reproducible hypothesis runs."""

import os
import signal

import hypothesis
import pytest

# Most tests compile more than they compute: with these, XLA compiles a fleet in a third of the time.
QUICK_FLAGS = "--xla_cpu_use_fusion_emitters=false"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in what a shell runs in the background; tests interrupt runs
    signal.signal(signal.SIGINT, signal.default_int_handler)

hypothesis.settings.register_profile("fleetjax", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("fleetjax")


def pytest_configure(config: pytest.Config) -> None:
    """Compile quickly where no slow test runs: in this process, in xdist's, and in those that tests start."""
    if config.option.markexpr == "not slow":
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_FLAGS}".strip()
    import jax  # reads the environment once

    jax.config.update("jax_numpy_dtype_promotion", "strict")
