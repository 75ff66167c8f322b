"""Settings that every test shares: strict dtypes, few simulation threads, reproducible hypothesis runs."""

import signal

import hypothesis
import jax

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in what a shell runs in the background; tests interrupt runs
    signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_numpy_dtype_promotion", "strict")

hypothesis.settings.register_profile("fleetjax", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("fleetjax")
