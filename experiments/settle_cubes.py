"""Drop cubes into Allegro hands and keep what comes to rest: the states that episodes start from.

    python experiments/settle_cubes.py [--number 1024] [--seed 0] [--output FILE]

Fingers hold a random, slightly bent pose; cubes fall from 4 cm above the goal in random orientations. A cube that lies
still near the goal after two seconds is kept. Without --output it writes the file that the package ships,
`fleetjax/physics/models/allegro_hand_settled.npz`.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout

from fleetjax.envs import allegro_hand
from fleetjax.physics.base import MODELS

SECONDS = 2.0
NEAR = 0.08  # m from the goal's position
SLOW = 0.02  # m/s and rad/s


def start(rng: np.random.Generator, model: mujoco.MjModel, number: int) -> np.ndarray:
    """Return positions f64[K, nq] before the fall."""
    low, high = model.jnt_range[:16].T
    angles = np.clip(0.2 * rng.uniform(low, high, (number, 16)), low, high)
    position = np.array([0.0, -0.2, 0.56]) + rng.uniform(-0.01, 0.01, (number, 3))
    half = np.pi / 2 * rng.uniform(-1, 1, (number, 2))
    (cx, cy), (sx, sy) = np.cos(half).T, np.sin(half).T
    orientation = np.stack([cx * cy, sx * cy, cx * sy, sx * sy], axis=1)  # about y, then about x
    return np.concatenate([angles, position, orientation], axis=1)


def main() -> None:
    """Simulate, select and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=1024, help="states to keep")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=allegro_hand.SETTLED, help="npz file to write")
    args = parser.parse_args()
    model = mujoco.MjModel.from_xml_path(str(MODELS / "allegro_hand.xml"))
    steps = round(SECONDS / model.opt.timestep)
    rng, kept, tried = np.random.default_rng(args.seed), [], 0
    with rollout.Rollout(nthread=2) as pool:
        data = [mujoco.MjData(model) for _ in range(2)]
        while sum(map(len, kept)) < args.number:
            qpos = start(rng, model, args.number)
            state = np.concatenate([np.zeros((args.number, 1)), qpos, np.zeros((args.number, model.nv))], axis=1)
            control = np.repeat(qpos[:, None, :16], steps, axis=1)
            after = pool.rollout(model, data, state, control)[0][:, -1]
            qpos, qvel = after[:, 1 : 1 + model.nq], after[:, 1 + model.nq :]
            near = np.linalg.norm(qpos[:, 16:19] - allegro_hand.GOAL_POSITION, axis=1) < NEAR
            kept.append(qpos[near & (np.abs(qvel).max(axis=1) < SLOW)])
            tried += args.number
    print(f"{sum(map(len, kept))} of {tried} cubes came to rest near the goal")
    np.savez_compressed(args.output, qpos=np.concatenate(kept)[: args.number].astype(np.float32))


if __name__ == "__main__":
    main()
