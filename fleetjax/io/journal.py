"""What a run writes while it is under way: its metrics, its log of interventions, and its checkpoints."""

from collections.abc import Mapping
from typing import Any

from fleetjax import envs
from fleetjax.fleet import FleetState
from fleetjax.io import checkpoint, files, folder, interventions, metrics_csv
from fleetjax.io.chunks import Chunk
from fleetjax.metrics import Metrics


class Journal:
    """The files of a run that grow with it. None is touched before `create` or `reopen`.

    Args:
        run: the run.
        checkpoint_every: timesteps between checkpoints; 0 = none.

    Attributes:
        metrics: Metrics[C] of the chunks that were written, in order, in numpy arrays.
        timestep: timesteps that were written.
    """

    def __init__(self, run: folder.Run, checkpoint_every: int):
        self._folder, self._total, self._every = run.folder, run.config.num_steps, checkpoint_every
        self.metrics: list[Metrics] = []
        self.timestep = self._saved = 0
        self._spec = envs.make(run.config.environment, run.config.backend).spec if run.logged else None
        self._logs: dict[str, files.Log] = {}
        self._writer = checkpoint.Writer(run.folder, folder.identity(run.config, run.seed))

    def create(self, run: folder.Run) -> None:
        """Start new files; an older run in the folder is deleted."""
        folder.create(run)
        self._open({})

    def reopen(self, run: folder.Run, metrics: Metrics, notes: Mapping[str, Any]) -> None:
        """Cut the files back to a checkpoint.

        Args:
            run: the run, with the versions that it continues under.
            metrics: Metrics[t] until then, in numpy arrays.
            notes: what `save` noted.
        """
        folder.write_config(run, sealed=False)
        self._open(notes)
        self.metrics = [metrics]
        self.timestep = self._saved = len(metrics.successes)

    def _open(self, notes: Mapping[str, Any]) -> None:
        self._logs["metrics"] = metrics_csv.open_log(self._folder, notes.get("metrics"))
        if self._spec:
            self._logs["interventions"] = interventions.open_log(self._folder, notes.get("interventions"))

    def append(self, chunk: Chunk) -> None:
        """Add a chunk of timesteps."""
        metrics_csv.append(self._logs["metrics"], chunk.metrics, self.timestep)
        if self._spec and chunk.interventions:
            interventions.append(self._logs["interventions"], chunk.interventions, self.timestep, self._spec)
        self.metrics.append(chunk.metrics)
        self.timestep += len(chunk.metrics.successes)

    @property
    def is_due(self) -> bool:
        """Whether it is time for a checkpoint."""
        return 0 < self._every <= self.timestep - self._saved and self.timestep < self._total

    def save(self, state: FleetState) -> None:
        """Write a checkpoint in the background, with what is needed to cut the files back to it."""
        self._writer.write(state, self.marks())
        self._saved = self.timestep

    def marks(self) -> dict[str, Any]:
        """Put what was written on the disk; return what is needed to cut the files back to it."""
        return {name: log.mark() for name, log in self._logs.items()}

    def finish(self) -> None:
        """Wait until all checkpoints are written.

        Raises:
            OSError: if one could not be written.
        """
        self._writer.wait()

    def close(self) -> None:
        """Close the files."""
        for log in self._logs.values():
            log.close()
