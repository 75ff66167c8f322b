"""Fill in the tables of pages below `docs/` from stored rows; no simulation.

    python experiments/page.py [PAGE ...] [--results experiments/results]

A table stands between `<!-- NAME -->` and `<!-- end -->`, where NAME is one of:

- a part of the study, such as `main`: what the algorithms achieved in it, each robot's one after the other.
- `claims`: the verdicts of `claims.py`.
- `missing`: how many runs of each part are stored, of how many, and what they ran on.
- `teach_first`, `teach_more`, `teach_early`: how Teach First compares with C.U.R. and others at equal human time; in the second
  and third, with as many gradient steps as in the part `main`; in the third, with half of these before the start.
- `leaderboard`: the table of `leaderboard.py`.
- `people_ENV`: the table of `people.py`.
"""

import argparse
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import claims
import paper
import people

from fleetjax.io import comparing, files, folder, leaderboard, rows, standings, text
from fleetjax.io.outcomes import Group, Outcome, group
from fleetjax.io.study import combine

PUBLISHED = {  # successes of the trained policies (paper, Appendix); Fleet-TD is the hand's only
    "humanoid": {"constraint": 0, "random": 746.3, "ensemble_dagger": 617.7, "cur": 771.0, "expert": 894},
    "anymal": {"constraint": 32.7, "random": 207.3, "ensemble_dagger": 257.3, "cur": 257.0, "expert": 293},
    "allegro_hand": {
        "constraint": 70.0,
        "random": 7360.3,
        "ensemble_dagger": 3032.0,
        "thrifty_dagger": 4296.3,
        "cur": 6032.7,
        "expert": 21609,
    },
}
PAGES = ("results", "beat_cur", "leaderboard", "humans")
COLUMNS = {"successes": "successes", "violations": "violations", "human_steps": "human time", "rohe": "ROHE"}


def readable(label: str) -> str:
    """Return the label of a group in words.

    >>> readable("C.U.R., min_teleop_time 5, idle_humans_teleoperate True, tired False")
    'C.U.R., t_T = 5, idle humans teleoperate'
    """
    label = re.sub(r", \w+ False|(?<=\w) True", "", label).replace("_", " ")
    for name, short in claims.NAMES.items():
        label = label.replace(f" {name.replace('_', ' ')} ", f" {short} = ")
    return label


def mean(one: Group, metric: str, *, spread: bool = False) -> str:
    """Return the mean of a metric over seeds, with the smallest and the largest if asked for."""
    found = comparing.values(one, metric)
    shown = text.number(found.mean())
    return f"{shown} ({text.number(found.min())} to {text.number(found.max())})" if spread and len(found) > 1 else shown


def achieved(found: list[Group], alone: Mapping[str, Group]) -> str:
    """Return a table of what groups of runs achieved, and of what their policies did `alone`, by name."""
    columns = COLUMNS if alone else {**COLUMNS, "idle": "idle time"}
    counted = any("constraint" in one.config.algorithm for one in found)
    head = ["", "seeds", *columns.values(), *(["ROHE, demonstrations counted"] if counted else [])]
    policies = ["policy alone: successes", "violations", "the paper's policy: successes"] if alone else []
    table = [tuple(head + policies)]
    for one in sorted(found, key=lambda one: [*claims.NAMES].index(one.config.environment)):
        place, algorithm = one.config.environment, one.config.algorithm
        cells = [f"{claims.NAMES[place]}, {readable(one.label)}", str(len(one.runs))]
        cells += [mean(one, metric, spread=metric == "successes") for metric in columns]
        if counted:
            cells += [mean(one, "rohe_with_demonstrations") if "constraint" in algorithm else ""]
        if alone:
            policy = alone.get(f"{place} {one.label}")
            paper_value = PUBLISHED.get(place, {}).get(algorithm)
            fewer = f" ({len(policy.runs)} of {len(one.runs)} seeds)" if policy and len(policy.runs) < len(one.runs) else ""
            cells += [mean(policy, "successes") + fewer, mean(policy, "violations")] if policy else ["", ""]
            cells += ["" if paper_value is None else text.number(paper_value)]
        table.append(tuple(cells))
    return text.markdown_table(table)


def groups(results: Path, *parts: str) -> list[Group]:
    """Return the groups of the stored runs of some parts."""
    paths = [results / f"{part}{rows.SUFFIX}" for part in parts]
    return group([run for path in paths if path.exists() for run in rows.read(path)])


def missing(args: argparse.Namespace) -> str:
    """Return a table of the runs that are stored of each part, of all that it has, and of what they ran on."""
    table: list[tuple[str, ...]] = [("part", "runs stored", "of", "processor", "version", "command")]
    every: dict[str, Outcome] = {}
    wanted: set[str] = set()
    for name in paper.PARTS:
        stored = paper.Part(name, args).rows()
        plans = combine(paper.Part(paper.TRAINED if name == "policies" else name, args).study())
        planned = {folder.name_of(run) for run in plans}
        stored = {key: run for key, run in stored.items() if key in planned}  # none of older settings
        table.append((name, *counts(stored, len(plans)), f"`python experiments/paper.py {name}`"))
        kind = "policy " if name == "policies" else ""  # which is not the run that trained it
        every |= {kind + key: run for key, run in stored.items()}
        wanted |= {kind + key for key in planned}
    return text.markdown_table([*table, ("all, each once", *counts(every, len(wanted)), "`python experiments/paper.py`")])


def counts(stored: Mapping[str, Outcome], number: int) -> tuple[str, ...]:
    """Return the number of stored runs, that of all, and the processors and versions of those stored."""
    processors = sorted({run.processor for run in stored.values()})
    versions = sorted({run.versions["fleetjax"] for run in stored.values()})
    return str(len(stored)), str(number), ", ".join(processors), ", ".join(versions)


def against_cur(found: list[Group], early: Sequence[Group] = ()) -> str:
    """Return a table of Teach First and others beside C.U.R.; ratios are of the successes over the seeds that both have.

    Args:
        found: runs, of which the first C.U.R. of each robot is the one to compare with.
        early: runs that are trained earlier.
    """
    table: list[tuple[str, ...]] = [("", "seeds", "successes", "times C.U.R.'s", "violations", "human time", "idle time")]
    for place in dict.fromkeys(one.config.environment for one in found):
        here: dict[str, Group] = {}
        for one in found:
            if one.config.environment == place:
                here.setdefault(one.config.algorithm, one)  # those of the study come before older ones
        reference = here.get("cur")
        usual = [(here[algorithm], "") for algorithm in ("cur", "random", "teach_first") if algorithm in here]
        others = [(one, ", trained early") for one in early if one.config.environment == place]
        ceiling = [(one, "") for algorithm, one in here.items() if algorithm == "expert"]
        for one, how in (*usual, *others, *ceiling):
            ratio = comparing.ratio_interval(one, reference, "successes") if reference and one is not reference else ""
            cells = [f"{claims.NAMES[place]}, {text.label(one.config.algorithm)}{how}", str(len(one.runs))]
            cells += [comparing.interval(comparing.values(one, "successes")), ratio]
            table.append((*cells, *(mean(one, metric) for metric in ("violations", "human_steps", "idle"))))
    return text.markdown_table(table)


def tables(results: Path) -> dict[str, Callable[[], str]]:
    """Return what makes each table, by its name."""
    alone = {f"{one.config.environment} {one.label}": one for one in groups(results, "policies")}
    every = argparse.Namespace(
        results=results, studies=paper.HERE / "studies", seeds=None, workers=1, output=Path("runs/paper")
    )
    parts = [part for part in paper.PARTS if part != "policies"]
    imperfect = [f"people_{name}" for name in people.ENVIRONMENTS]
    return {
        **{part: lambda part=part: achieved(groups(results, part), alone if part == paper.TRAINED else {}) for part in parts},
        "claims": lambda: claims.verdicts(claims.Study(results)),
        "missing": lambda: missing(every),
        "teach_first": lambda: against_cur(groups(results, "equal_budget")),
        "teach_more": lambda: against_cur(
            [one for one in groups(results, "main", "teaching") if one.config.environment == "humanoid"]
        ),
        "teach_early": lambda: against_cur(
            [one for one in groups(results, "main", "teaching") if one.config.environment in ("humanoid", "anymal")],
            groups(results, "trained_early"),
        ),
        "leaderboard": lambda: standings.table(leaderboard.Store(results)).strip(),
        **{name: lambda name=name: people.table(groups(results, name)).strip() for name in imperfect},
    }


def main() -> None:
    """Write the pages anew."""
    docs = paper.HERE.parent / "docs"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    usual = [docs / f"{name}.md" for name in PAGES]
    parser.add_argument(
        "pages", metavar="PAGE", nargs="*", type=Path, default=usual, help="Markdown file [default: those of docs/]"
    )
    parser.add_argument("--results", type=Path, default=paper.HERE / "results", help="folder of the rows")
    args = parser.parse_args()
    known = tables(args.results)
    for path in args.pages:
        page = path.read_text()
        names = [name for name in re.findall(r"<!-- (\w+) -->\n", page) if name != "end"]
        files.expect(bool(names), f"{path} has no table; a table stands from <!-- NAME --> to <!-- end -->")
        for name in names:
            files.expect(name in known, f"{path} has an unknown table {name!r}; choose from {', '.join(known)}")
            here = rf"(<!-- {name} -->\n)(?s:(?!<!--).)*(<!-- end -->)"
            page, count = re.subn(here, lambda m, n=name: f"{m[1]}\n{known[n]()}\n\n{m[2]}", page)
            files.expect(count == 1, f"{path}: table {name!r} must stand there once, from <!-- {name} --> to <!-- end -->")
        files.write(path, page.encode())
        print(path)


if __name__ == "__main__":
    main()
