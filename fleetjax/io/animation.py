"""Robots as an animation in a notebook: `fleetjax.animate`."""

import base64
import dataclasses
from pathlib import Path

import jax

from fleetjax import checks
from fleetjax.config import Config, taught_pairs
from fleetjax.experiment import extend, prepare
from fleetjax.fleet import FleetState
from fleetjax.io import files, render


@dataclasses.dataclass(frozen=True)
class Animation:
    """An animation that a notebook shows if it is the last value of a cell.

    Attributes:
        gif: content of a GIF file.
    """

    gif: bytes = dataclasses.field(repr=False)

    def save(self, path: str | Path) -> None:
        """Write the GIF file."""
        files.write(Path(path), self.gif)

    def _repr_html_(self) -> str:
        return f'<img alt="animated robots" src="data:image/gif;base64,{base64.b64encode(self.gif).decode()}">'


def animate(
    config: Config, key: jax.Array, state: FleetState | None = None, *, num_shown: int = 9, every: int = 2, width: int = 120
) -> Animation:
    """Run `config.num_steps` timesteps of a fleet, and show its first robots: marked blue if teleoperated, red in violation.

    Args:
        config: configuration.
        key: random key.
        state: where to start, such as `result.state` of a run; None pre-trains first.
        num_shown: robots to show.
        every: timesteps from one picture to the next.
        width: of each robot's picture (pixels).

    Raises:
        ValueError: if a number is below 1, the environment has nothing to draw, no OpenGL library is found, or the state does
            not fit the configuration.
    """
    for name, value in {"num_shown": num_shown, "every": every, "width": width}.items():
        if value < 1:
            raise ValueError(f"{name} = {value} must be at least 1")
    render.check(config)
    start = jax.jit(prepare)(config, key) if state is None else extend(state, taught_pairs(config))
    env = checks.check_run(config, state=start)
    film = render.shoot(config, key, start, num_shown=num_shown)
    pictures = render.draw(film, env.scene, width=width, every=every)
    return Animation(render.encode(pictures, Path("film.gif"), rate=1 / (env.spec.control_step * every)))
