"""Run the study of the paper's claims, part by part, and store a row for each run.

    python experiments/paper.py [PART ...] [--seeds 5] [--workers 2] [--output runs/paper]
    python experiments/paper.py [PART ...] --rows-only       # tables and figures from the rows that are stored; no simulation

A part is a file of `experiments/studies/`. Its runs go to a folder each below --output, its rows to
`experiments/results/PART.csv`, and its tables and figure beside them. Repeat the command to resume: finished runs are skipped.
"""

import argparse
import sys
from pathlib import Path

from fleetjax import cli

HERE = Path(__file__).parent


def fleetjax(*words: object) -> None:
    """Run a command of fleetjax.

    Raises:
        SystemExit: if it fails.
    """
    code = cli.main([str(word) for word in words])
    if code:
        sys.exit(code)


def main() -> None:
    """Run the parts that are asked for, then show what they gave."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help="all if none is given")
    parser.add_argument("--studies", type=Path, default=HERE / "studies", help="folder of the parts, a .toml file each")
    parser.add_argument("--seeds", type=int, help="in place of those in the file")
    parser.add_argument("--workers", type=int, help="processes [default: one for each core]")
    parser.add_argument("--output", type=Path, default=Path("runs/paper"), help="folder for the run folders")
    parser.add_argument("--results", type=Path, default=HERE / "results", help="folder for rows, tables and figures")
    parser.add_argument("--rows-only", action="store_true", help="do not run anything")
    args = parser.parse_args()
    known = sorted(path.stem for path in args.studies.glob("*.toml"))
    unknown = set(args.parts) - set(known)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: choose out of {', '.join(known)}")
    args.results.mkdir(parents=True, exist_ok=True)
    for part in args.parts or known:
        rows = args.results / f"{part}.csv"
        if not args.rows_only:
            given = {"--seeds": args.seeds, "--workers": args.workers}
            options = [word for flag, value in given.items() if value is not None for word in (flag, value)]
            fleetjax("sweep", args.studies / f"{part}.toml", "--output", args.output / part, *options)
            fleetjax("compare", args.output / part, "--allow-different", "--rows", rows, "--overwrite")
        outputs = [word for suffix in ("md", "png") for word in ("--output", args.results / f"{part}.{suffix}")]
        fleetjax("compare", rows, "--allow-different", *outputs, "--overwrite")


if __name__ == "__main__":
    main()
