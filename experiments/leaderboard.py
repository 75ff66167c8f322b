"""Compare the rules for help at equal human time: which has the most successes for what people spend?

    python experiments/leaderboard.py [ENV ...] [--algorithms cur,random] [--budgets 5000,10000] [--seeds 5]
    python experiments/leaderboard.py --rows-only          # table and figure from the stored rows; no simulation

It does for every rule what `fleetjax leaderboard add RULE` does for one. Rows go to `experiments/results/leaderboard.csv`, what
was calibrated to `leaderboard.json`, and the table and the figure beside them. Repeat the command to resume: runs that are
stored, or finished below --output, are not run again.
"""

import argparse
from pathlib import Path

import fleetjax
from fleetjax.field import ORDERS
from fleetjax.io import files, leaderboard, scripts, standings
from fleetjax.io.lists import listed

FIRST = ("cur", "random", "teach_first", "ensemble_dagger", "round_robin")  # to be run


def every_rule() -> list[str]:
    """Return the names of all rules but orders of letters and expert, in the order in which they are run."""
    left_out = {"expert", *ORDERS} - {"cur"}
    rules = [name for name in fleetjax.list_algorithms() if name not in left_out]
    return sorted(rules, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))


def main() -> None:
    """Run what is missing of what is asked for, then show all that is stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", tuple(leaderboard.BUDGETS))
    parser.add_argument(
        "--algorithms",
        type=listed(str),
        help="names, separated by commas [default: all but orders and expert]",
    )
    parser.add_argument("--budgets", type=listed(int), help="human timesteps")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds [default: 5]")
    parser.add_argument("--output", type=Path, default=Path("runs/leaderboard"), help="folder for the run folders")
    results = Path(__file__).parent / "results"
    parser.add_argument("--results", type=Path, default=results, help="folder for rows, table and figure")
    parser.add_argument("--rows-only", action="store_true", help="no runs; only table and figure")
    args = parser.parse_args()
    args.results.mkdir(parents=True, exist_ok=True)
    with files.lock(args.results):
        asked = (args.environments, args.budgets or (), args.seeds, args.output)
        try:
            store = leaderboard.Store(args.results)
            entries = [] if args.rows_only else leaderboard.entries(args.algorithms or every_rule(), *asked)
            failed = leaderboard.compete(store, entries)
        except ValueError as error:
            parser.error(str(error))
        if store.runs:
            print(standings.publish(store))
    if failed:
        raise SystemExit(f"failed: {'; '.join(failed)}")


if __name__ == "__main__":
    main()
