"""Print the human time that finished C.U.R. runs asked for: what the `constraint` and `random` baselines are calibrated by.

    for seed in 0 1 2; do fleetjax run humanoid --seed $seed --output runs/humanoid-cur-$seed; done
    python experiments/human_time.py runs/humanoid-cur-*

The mean goes to `CUR_HUMAN_TIME` in `fleetjax/envs/__init__.py`.
"""

import argparse
import json
import statistics
from pathlib import Path

import pandas as pd


def main() -> None:
    """Print human timesteps of each run, hard resets included, and their mean."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders of algorithm cur")
    times = []
    for folder in parser.parse_args().runs:
        config = json.loads((folder / "config.json").read_text())
        metrics = pd.read_csv(folder / "metrics.csv")
        times.append(int(metrics["human_steps"].to_numpy().sum()))
        capacity = config["config"]["num_humans"] * len(metrics)
        print(f"{folder}: {times[-1]} of {capacity} human timesteps, {100 * times[-1] / capacity:.1f} %")
    print(f"mean {statistics.mean(times):.0f}")


if __name__ == "__main__":
    main()
