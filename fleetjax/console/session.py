"""A run that people supervise, in its run folder."""

import jax
import numpy as np

from fleetjax import envs
from fleetjax.console import record
from fleetjax.console.engine import Engine, Inputs, View
from fleetjax.io import chunks, files, folder, metrics_csv, text
from fleetjax.io.errors import Diverged
from fleetjax.metrics import Metrics, first_divergence
from fleetjax.priority import get_algorithm

SHOWN = 36  # robots that the fleet's page has pictures of


class Session:
    """The timesteps of a run, each in two halves, written down as they are completed.

    Args:
        run: its folder, which this process has locked, and its configuration.

    Attributes:
        engine: the fleet.
        num_tiles: robots that the fleet's page has pictures of.
        metrics: Metrics[1] of each timestep so far.
        curves: cumulative successes, violations and idle time, and the return on human effort, after each.
    """

    def __init__(self, run: folder.Run):
        self.run, self.config = run, run.config
        self.env = envs.make(run.config.environment, run.config.backend)
        self.num_tiles = min(run.config.num_robots, SHOWN)
        self.engine = Engine(run.config, jax.random.key(run.seed), self.env, num_pictures=sorted({1, self.num_tiles}))
        self.metrics: list[Metrics] = []
        self._total = dict.fromkeys(Metrics._fields, 0.0)
        self.curves = [self._heights()]
        self._rows = record.row_type(run.config, self.env.spec)
        self._view: View | None = None
        self._logs: tuple[files.Log, ...] = ()  # the record and the metrics, once there is a timestep

    @property
    def over(self) -> bool:
        """Whether every timestep is completed."""
        return len(self.metrics) >= self.config.num_steps

    def begin(self, kinds: np.ndarray) -> View:
        """Begin a timestep with who sits in each seat, u8[M]."""
        self._view = self.engine.plan(kinds)
        return self._view

    def finish(self, inputs: Inputs) -> Metrics:
        """Complete the timestep and write it down; return its Metrics[1]. The first deletes an older run in the folder.

        Raises:
            OSError: if it cannot be written.
            Diverged: if something learnt is no longer finite.
        """
        assert self._view is not None
        view, self._view = self._view, None
        metrics = as_chunk(self.engine.advance(inputs))
        if not self._logs:
            folder.create(self.run)
            self._logs = record.open_record(self.run.folder), metrics_csv.open_log(self.run.folder)
        log, table = self._logs
        record.append(log, view, inputs, self._rows)
        metrics_csv.append(table, metrics, view.timestep)
        self.metrics.append(metrics)
        self._total = {name: self._total[name] + more for name, more in text.add_up(metrics).items()}
        self.curves.append(self._heights())
        found = first_divergence(metrics)
        if found:
            raise Diverged(text.divergence(view.timestep, found[1]))
        return metrics

    def _heights(self) -> tuple[float, float, float, float]:
        total = self._total
        return total["successes"], total["violations"], total["idle"], text.rohe_of(total, self.config)

    def complete(self) -> Metrics:
        """Put what was written on the disk, and the policy beside it; return the Metrics[t]."""
        for log in self._logs:
            log.mark()
        if get_algorithm(self.config.algorithm).pretrains:
            folder.write_policy(self.run.folder, self.engine.state.policy)
        return chunks.join(self.metrics)

    def close(self) -> None:
        """Close the files."""
        for log in self._logs:
            log.close()


def as_chunk(metrics: Metrics) -> Metrics:
    """Return the Metrics[1] of one timestep."""
    return jax.tree.map(lambda x: np.asarray(x)[None], metrics)
