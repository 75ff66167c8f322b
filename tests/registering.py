"""Registries that are left as they were found."""

import contextlib
from collections.abc import Iterator

from fleetjax import envs, field, humans, priority, supervisors
from fleetjax.learning import estimators

REGISTRIES = (
    envs.ENVIRONMENTS,
    priority.ALGORITHMS,
    supervisors.SUPERVISORS,
    estimators.ESTIMATORS,
    humans.HUMAN_MODELS,
    humans.LINK_MODELS,
)


@contextlib.contextmanager
def only_here() -> Iterator[None]:
    """Let what is registered within this block vanish after it, so that no other test meets it."""
    before = [(table, dict(table)) for table in (field.PARAMETERS, *(registry.entries for registry in REGISTRIES))]
    try:
        yield
    finally:
        for table, entries in before:
            table.clear()
            table.update(entries)
