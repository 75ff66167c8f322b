"""Run the paper's block-pushing experiment: 4 robots, 2 humans, 250 pushes, several seeds; print the tables, draw the figure.

    python experiments/block_push.py [--seeds 0 1 2] [--output runs/block_push] [-- PARAMETERS]

A run takes minutes on two cores. Finished runs are not run again: stop it at any time, and start it again.

Reference: paper, Section 5.3.
"""

from pathlib import Path

from comparison import make_parser, run_missing, show


def main() -> None:
    """Run what is missing, then show all."""
    args = make_parser(__doc__, output=Path("runs/block_push"), seeds=[0, 1, 2]).parse_args()
    cases = [("block_push", algorithm, seed) for algorithm in args.algorithms for seed in args.seeds]
    show(run_missing(cases, args.output, args.parameters), args.output / "block_push.png")


if __name__ == "__main__":
    main()
