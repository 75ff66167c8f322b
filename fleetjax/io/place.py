"""Where the processes of a sweep compute: cores of their own, and a GPU of their own where there are any.

Nothing here loads JAX. A process must take its place first: JAX starts a thread for each core, and holds every GPU it sees.
"""

import importlib.util
import os
import subprocess
import sys
from typing import NamedTuple

_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")  # without which JAX sees no NVIDIA GPU
_VISIBLE = "CUDA_VISIBLE_DEVICES"
_COUNT = "import jax; print(jax.local_device_count() if jax.default_backend() == 'gpu' else 0)"


class Place(NamedTuple):
    """What a process may use.

    Attributes:
        cores: their numbers.
        gpu: as CUDA_VISIBLE_DEVICES names it; None = whatever the process sees.
    """

    cores: list[int]
    gpu: str | None

    def take(self) -> None:
        """Bind this process to its cores and its GPU."""
        os.sched_setaffinity(0, self.cores)
        if self.gpu is not None:
            os.environ[_VISIBLE] = self.gpu


def gpus() -> list[str]:
    """Return the GPUs that JAX would use here, as CUDA_VISIBLE_DEVICES names them. Another process looks, and holds none."""
    if not any(map(importlib.util.find_spec, _PLUGINS)):
        return []
    looked = subprocess.run([sys.executable, "-c", _COUNT], capture_output=True, text=True)
    count = int(looked.stdout.split()[-1]) if looked.returncode == 0 else 0
    return os.environ.get(_VISIBLE, ",".join(map(str, range(count)))).split(",")[:count]


def divide(most: int, wanted: int | None) -> list[Place]:
    """Return the places of a sweep's processes.

    Args:
        most: number of processes that would find something to do.
        wanted: number that was asked for; None = one for each GPU, or, without GPUs, for each core.
    """
    cores, found = sorted(os.sched_getaffinity(0)), gpus()
    number = min(wanted or len(found or cores), most)
    shares = [cores[i::number] or [cores[i % len(cores)]] for i in range(number)]
    return [Place(share, found[i % len(found)] if found else None) for i, share in enumerate(shares)]
