"""The formats that interventions are exported in, and the libraries that each needs."""

import importlib.util

from fleetjax.registry import unknown

NEEDS = {"lerobot": ("pyarrow",), "robomimic": ("h5py",), "minari": ("minari", "gymnasium", "h5py")}
FORMATS = tuple(NEEDS)
PLACES = {"lerobot": "lerobot", "robomimic": "robomimic.hdf5", "minari": "minari"}  # in a run folder, unless told otherwise


def check(kind: str) -> None:
    """Check that the libraries of a format are installed.

    Raises:
        ValueError: if the format is unknown, or a library is not installed.
    """
    if kind not in FORMATS:
        raise ValueError(unknown("format", kind, FORMATS))
    for name in NEEDS[kind]:
        if importlib.util.find_spec(name) is None:
            raise ValueError(f'--format {kind} needs {name}; run pip install ".[{kind}]" in the source folder')
