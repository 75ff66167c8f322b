"""Settings that every test shares: strict dtypes, quick compilation, reproducible hypothesis runs, long files first."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import compiling
import hypothesis
import pytest

# Files that take longest. They begin first, so that the workers end at about the same time.
LONGEST = (
    "mesh",
    "gates",
    "gradients",
    "resume",
    "sweep",
    "distributed",
    "humans",
    "faults",
    "conformity",
    "fuzz",
    "console_web",
    "oracle",
    "expert",
    "physics",
    "containment",
    "console",
)

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in what a shell runs in the background; tests interrupt runs
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Every compiled program maps memory, and Linux lets a process have about 65,000 maps; XLA crashes at the next one.
MOST_MAPS = 30_000

hypothesis.settings.register_profile("fleetjax", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("fleetjax")


def pytest_configure(config: pytest.Config) -> None:
    """Compile quickly where no slow test runs: in this process, in xdist's, and in those that tests start."""
    if config.option.markexpr == "not slow and not long":
        os.environ.update(compiling.environment())
    import jax  # only now, since it reads the environment

    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_num_cpu_devices", 8)  # virtual ones, for `test_mesh.py`; others use the first


@pytest.fixture(autouse=True)
def names_of_a_test() -> Iterator[None]:
    """Let what a test registers vanish after it."""
    import registering

    with registering.only_here():
        yield


@pytest.fixture(scope="module")
def toy_supervisors() -> Iterator[None]:
    """Register the supervisors of `toy_envs.py` for as long as a file's tests run."""
    import registering
    import toy_envs

    with registering.only_here():
        toy_envs.register_supervisors()
        yield


@pytest.fixture(params=["quickly", pytest.param("optimized", marks=pytest.mark.slow)])
def compiled_both_ways() -> None:
    """Run a test about bits a second time, among the slow tests, where XLA optimises."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first."""
    order = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem.removeprefix("test_"), len(LONGEST)))


@pytest.fixture(autouse=True, scope="module")
def few_maps() -> Iterator[None]:
    """Forget compiled programs after a file of tests, before there are too many of them."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > MOST_MAPS:
        import jax

        jax.clear_caches()
