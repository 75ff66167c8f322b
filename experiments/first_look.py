"""Run every algorithm on every robot that it fits, at the paper's scale with one seed; print the tables, draw the figure.

    python experiments/first_look.py [--environments humanoid anymal ...] [--output runs/first_look] [-- PARAMETERS]

A run takes minutes on two cores. Finished runs are not run again: stop it at any time, and start it again.
"""

from pathlib import Path

from comparison import fits, make_parser, run_missing, show

import fleetjax


def main() -> None:
    """Run what is missing, then show all."""
    parser = make_parser(__doc__, output=Path("runs/first_look"), seeds=[0])
    parser.add_argument("--environments", nargs="+", choices=fleetjax.list_envs(), default=fleetjax.list_envs())
    args = parser.parse_args()
    cases = [(e, a, s) for e in args.environments for a in args.algorithms if fits(e, a) for s in args.seeds]
    show(run_missing(cases, args.output, args.parameters), args.output / "first_look.png")


if __name__ == "__main__":
    main()
