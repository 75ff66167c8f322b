"""Run the study of the paper's claims, part by part, and store a row for each run.

    python experiments/paper.py [PART ...] [--seeds 5] [--workers 2] [--output runs/paper]
    python experiments/paper.py [PART ...] --rows-only       # tables and figures from the rows that are stored; no simulation

A part is a file of `experiments/studies/`, and `policies`: the trained policies of the part `main` on their own, for as many
timesteps as they were trained, without teleoperation.

Runs go to a folder each below --output, their rows to `experiments/results/PART.csv`, and tables and a figure beside them.
Repeat the command to resume: runs that have a row in one of these files, and finished runs, are not run again. Only a policy
that is not evaluated yet, and whose run folder is not below --output, is trained again.
"""

import argparse
from collections.abc import Iterable
from pathlib import Path

import jax

from fleetjax import compare, evaluate, plot
from fleetjax.io import comparing, figure, files, folder, rows, scripts, sweep
from fleetjax.io.outcomes import Outcome, group
from fleetjax.io.sources import collect
from fleetjax.io.study import Study, combine, make_study, plan
from fleetjax.priority import get_algorithm

HERE = Path(__file__).parent
PARTS = (  # in this order
    *("main", "gradient_steps", "policies", "ablations", "humans", "times", "equal_budget", "demonstrations"),
    *("teaching", "trained_early"),
)
TRAINED = "main"  # the part whose policies are evaluated
METRICS = {
    "main": ("successes", "violations", "idle", "rohe", "rohe_with_demonstrations"),
    "policies": ("successes", "violations", "idle"),
}  # that are compared; those of `fleetjax compare` in other parts


class Part:
    """A part of the study: its file, the folder of its runs, and its stored rows.

    Args:
        name: of the part.
        args: the script's arguments.
    """

    def __init__(self, name: str, args: argparse.Namespace):
        self.name, self.args, self.path = name, args, args.results / f"{name}{rows.SUFFIX}"

    def study(self) -> Study:
        """Return its runs as a sweep."""
        given = {"seeds": self.args.seeds, "workers": self.args.workers, "output": str(self.args.output / self.name)}
        return make_study([str(self.args.studies / f"{self.name}.toml")], {k: v for k, v in given.items() if v is not None})

    def rows(self) -> dict[str, Outcome]:
        """Return its stored runs."""
        return {folder.name_of(run): run for run in rows.read(self.path)} if self.path.exists() else {}

    def store(self, runs: Iterable[Outcome]) -> None:
        """Store runs in place of those that are stored."""
        if found := list(runs):
            files.write(self.path, rows.write(found))

    def run(self) -> None:
        """Complete the runs, and store the rows of those that finished, even if others fail or it is interrupted."""
        runs, own = plan(self.study()), self.rows()
        known = own | {
            name: run for other in PARTS if other != "policies" for name, run in Part(other, self.args).rows().items()
        }
        missing = [run for run in runs if folder.name_of(run) not in known]
        try:
            self.complete(missing)
        finally:
            known |= {folder.name_of(run): collect(run.folder)[0] for run in missing if sweep.is_finished(run)}
            wanted = dict.fromkeys([*map(folder.name_of, runs), *own])
            self.store(known[name] for name in wanted if name in known)

    def complete(self, runs: list[folder.Run]) -> None:
        """Complete runs of this part, which `plan` has checked, in their folders."""
        study = self.study()
        sweep.check_folder(study, combine(study))
        if runs:
            sweep.run_all(study, runs)

    def evaluate(self, trained: "Part") -> None:
        """Run the trained policies of another part, each with the seed after its own. Expert's run stands for itself."""
        untrained = {name: run for name, run in trained.rows().items() if not get_algorithm(run.config.algorithm).pretrains}
        known = untrained | self.rows()
        self.store(known.values())
        missing = [run for run in plan(trained.study()) if folder.name_of(run) not in known]
        elsewhere = [run for run in missing if not sweep.is_finished(run)]
        for run in missing:
            if run not in elsewhere:
                self.evaluate_one(run, known)
        if elsewhere:
            print(
                f"{len(elsewhere)} policies have no run folder in {trained.args.output / trained.name}: they are trained again"
            )
        trained.complete(elsewhere)
        for run in elsewhere:
            self.evaluate_one(run, known)

    def evaluate_one(self, run: folder.Run, known: dict[str, Outcome]) -> None:
        """Run the policy of a finished run on its own, and store it among the `known` ones."""
        found = collect(run.folder)[0]
        if get_algorithm(run.config.algorithm).pretrains:
            policy, key = folder.read_policy(folder.read_run(run.folder)), jax.random.key(run.seed + 1)
            found = found._replace(metrics=jax.device_get(jax.jit(evaluate)(run.config, key, policy).metrics))
        known[folder.name_of(run)] = found
        self.store(known.values())
        print(f"{run.folder.name}: {found.metrics.successes.sum():,} successes", flush=True)

    def show(self) -> None:
        """Write tables and a figure of the stored rows."""
        runs = list(self.rows().values())
        if not runs:
            return
        places = [one.config.environment for one in group(runs) if one.config.algorithm == "cur"]
        against = "cur" if places and len(set(places)) == len(places) else None  # where there is one C.U.R. to compare with
        table = compare(runs, against, METRICS.get(self.name, comparing.METRICS), allow_different=True)
        shown = [run for run in runs if run.config.algorithm != "expert"] or runs  # whose curves would flatten the others
        outputs = {".md": table.markdown().encode()}
        if self.name != "policies":  # which learn nothing, so that their curves are straight
            outputs[".png"] = figure.render(plot(shown))
        for suffix, content in outputs.items():
            files.write(self.path.with_suffix(suffix), content)
            print(self.path.with_suffix(suffix))


def add_options(parser: argparse.ArgumentParser, output: Path) -> None:
    """Let a script be told what `Part` needs; run folders go below `output` by default."""
    parser.add_argument("--studies", type=Path, default=HERE / "studies", help="folder of the parts' files")
    parser.add_argument("--seeds", type=int, help="number of seeds, instead of the file's")
    parser.add_argument("--workers", type=int, help="processes [default: one for each GPU; without GPUs, one for each core]")
    parser.add_argument("--output", type=Path, default=output, help="folder for the run folders")
    parser.add_argument("--results", type=Path, default=HERE / "results", help="folder for rows, tables and figures")
    parser.add_argument("--rows-only", action="store_true", help="no runs; only tables and figures")


def main() -> None:
    """Run the parts that are asked for, then show what they gave."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "parts", PARTS)
    add_options(parser, output=Path("runs/paper"))
    args = parser.parse_args()
    args.results.mkdir(parents=True, exist_ok=True)
    sweep.leave_gpus_to_workers()  # so policies are evaluated on the CPU
    with files.lock(args.results):  # another process would lose the rows that this one stores
        for part in [Part(name, args) for name in args.parts]:
            if not args.rows_only:
                part.evaluate(Part(TRAINED, args)) if part.name == "policies" else part.run()
            part.show()


if __name__ == "__main__":
    main()
