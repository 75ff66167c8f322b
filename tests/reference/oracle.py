"""Interactive fleet learning in NumPy, as the paper writes it (Sections 3 and 4, Algorithm 1). Nothing here is fast.

What the loop cannot know is a recorded input: what the environment answers to an action, what the networks say of a
state, and every random draw. Symbols are the paper's: robots i < N, humans j < M, states s, constraint indicator c, scores p,
allocation alpha (N x M of 0 and 1), auxiliary state x (type and duration of each robot's intervention), human data D.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

HARD_RESET, TELEOP, NOTHING = "hard reset", "teleop", "nothing"
State = dict[str, np.ndarray]  # rows of all robots; among them "obs", "violation", "success", "timeout", "reward"


class Problem(NamedTuple):
    """What is fixed for a whole run."""

    num_robots: int
    num_humans: int
    priority: str  # "constraint", "random", "ensemble_dagger", "thrifty_dagger", "expert", or letters such as "cur"
    min_teleop_time: int  # t_T
    hard_reset_time: int  # t_R
    initial_period: int  # t_I
    uncertainty_threshold: float
    risk_threshold: float
    random_threshold: float
    thrifty_weight: float
    thrifty_threshold: float
    learns: bool  # whether human data are recorded and the policy is updated
    gradient_steps: int
    ring_sizes: dict[str, tuple[int, int]]  # room for positives and negatives of each critic, "safety" or "goal"
    new_goals: bool  # whether a success brings a new goal and the episode goes on


class Recorded(NamedTuple):
    """What happened outside the loop in one timestep, for every robot [N]."""

    uncertainty: np.ndarray  # of pi_theta_t at s_t
    risk: np.ndarray
    goal: np.ndarray
    uniform: np.ndarray  # U(0, 1)
    tie_order: np.ndarray  # robots in random order
    available: np.ndarray  # [M] humans who are there
    present: np.ndarray  # whether a teleoperator really gives an action
    robot_action: np.ndarray  # pi_theta_t(s_t)
    human_action: np.ndarray  # pi_H(s_t)
    after_robot: State  # s_t+1 if the robot's action is taken
    after_human: State  # s_t+1 if the human's action is taken
    fresh: State  # s^0 ~ p_i^0
    renewed_robot: State  # after_robot with a new goal
    renewed_human: State  # after_human with a new goal
    resample_bits: np.ndarray  # [E, N] random 32 bits of each member for robot i's pair, if there is one


@dataclass
class Critic:
    """Rings of transitions (s, a, s', violation, success), by kind the positive and the negative ones."""

    positives: list[tuple] = field(default_factory=list)
    negatives: list[tuple] = field(default_factory=list)
    stored: list[int] = field(default_factory=lambda: [0, 0])


@dataclass
class Fleet:
    """All that the next timestep needs."""

    state: State
    alpha: np.ndarray
    type: list[str]
    duration: list[int]
    t: int = 0
    data: list[tuple] = field(default_factory=list)  # D: (s, pi_H(s))
    resample: list[list[int]] = field(default_factory=list)  # of each ensemble member, indices into D
    critics: dict[str, Critic] = field(default_factory=dict)
    thrifty_history: list[tuple[float, float]] = field(default_factory=list)
    gradient_steps: int = 0
    successes: int = 0  # cumulative
    human_steps: int = 0  # cumulative


class Outcome(NamedTuple):
    """What an observer sees of one timestep."""

    score: list[float]
    alpha: np.ndarray
    duration_before: list[int]  # of each robot's intervention, without this timestep
    type: list[str]
    action: np.ndarray
    hard_resets: list[int]  # robots
    soft_resets: list[int]
    new_goals: list[int]
    metrics: dict[str, int]
    reward: float
    rohe: float


def start(problem: Problem, state: State, num_members: int) -> Fleet:
    """Return a fleet without data whose humans are all free."""
    n = problem.num_robots
    return Fleet(
        state=state,
        alpha=np.zeros((n, problem.num_humans), int),
        type=[NOTHING] * n,
        duration=[0] * n,
        resample=[[] for _ in range(num_members)],
        critics={kind: Critic() for kind in problem.ring_sizes},
    )


def above(value: float, threshold: float) -> float:
    """Return `value`, or 0 if it is below `threshold` or no number."""
    return value if value >= threshold else 0.0


def rank(rows: list[tuple]) -> list[float]:
    """Return scores that sort as the tuples do: the lowest tuple that is not all zero gets 1; all zero gets 0."""
    ladder = sorted({row for row in rows if any(row)})
    return [1.0 + ladder.index(row) if any(row) else 0.0 for row in rows]


def scores(problem: Problem, fleet: Fleet, given: Recorded) -> list[float]:
    """Return p(s_i, pi_theta_t) for every robot (Section 4.2)."""
    robots = range(problem.num_robots)
    letters = {
        "c": [float(c) for c in fleet.state["violation"]],
        "u": [above(given.uncertainty[i], problem.uncertainty_threshold) for i in robots],
        "r": [above(given.risk[i], problem.risk_threshold) for i in robots],
    }
    if problem.priority == "expert":
        return [1.0 for _ in robots]
    if problem.priority == "constraint":
        return letters["c"]
    if problem.priority == "random":
        return [above(given.uniform[i], problem.random_threshold) for i in robots]
    if problem.priority == "ensemble_dagger":
        return rank(list(zip(letters["u"], letters["c"], strict=True)))
    if problem.priority == "thrifty_dagger":
        return rank(list(zip(thrifty(problem, fleet, given), letters["c"], strict=True)))
    p = rank(list(zip(*[letters[letter] for letter in problem.priority], strict=True)))
    if "c" in problem.priority and fleet.t < problem.initial_period:
        p = [0.0 if fleet.state["violation"][i] else p[i] for i in robots]
    return p


def thrifty(problem: Problem, fleet: Fleet, given: Recorded) -> list[float]:
    """Return the sum of normalised uncertainty and chance of failure, 0 where it is not above its threshold."""
    values = [(given.uncertainty[i], 1.0 - given.goal[i]) for i in range(problem.num_robots)]
    fleet.thrifty_history.extend(values)
    history = np.array(fleet.thrifty_history, float)
    z = (np.array(values, float) - history.mean(axis=0)) / np.maximum(history.std(axis=0), 1e-8)
    combined = (1 - problem.thrifty_weight) * z[:, 0] + problem.thrifty_weight * z[:, 1]
    return [value if value > problem.thrifty_threshold else 0.0 for value in combined]


def allocate(problem: Problem, fleet: Fleet, p: list[float], tie_order: np.ndarray, available: np.ndarray) -> np.ndarray:
    """Return alpha_t (Algorithm 1)."""
    alpha = np.zeros_like(fleet.alpha)
    for i in range(problem.num_robots):
        for j in range(problem.num_humans):
            if fleet.alpha[i, j] == 1 and available[j]:
                if fleet.type[i] == HARD_RESET and fleet.duration[i] < problem.hard_reset_time:
                    alpha[i, j] = 1
                if fleet.type[i] == TELEOP and fleet.duration[i] < problem.min_teleop_time:
                    alpha[i, j] = 1
    bound_robots, bound_humans = alpha.sum(axis=1), alpha.sum(axis=0)

    waiting = [i for i in tie_order if p[i] > 0 and not bound_robots[i]]
    waiting.sort(key=lambda i: -p[i])  # a stable sort: robots of equal score stay in random order
    unlocked = [j for j in range(problem.num_humans) if available[j] and not bound_humans[j]]
    chosen = waiting[: len(unlocked)]

    for i in chosen:  # a human whose robot is chosen again stays with it
        for j in unlocked:
            alpha[i, j] = fleet.alpha[i, j]
    new_robots = [i for i in chosen if not alpha[i].any()]
    free_humans = [j for j in unlocked if not alpha[:, j].any()]
    for i, j in zip(new_robots, free_humans, strict=False):
        alpha[i, j] = 1
    return alpha


def timestep(problem: Problem, fleet: Fleet, given: Recorded) -> tuple[Fleet, Outcome]:
    """Return the fleet one timestep later, and what happened."""
    s, robots = fleet.state, range(problem.num_robots)
    c = s["violation"]

    # Who gets help, of which type, and for how long already.
    p = scores(problem, fleet, given)
    alpha = allocate(problem, fleet, p, given.tie_order, given.available)
    helped = alpha.sum(axis=1)
    kind = [(HARD_RESET if c[i] else TELEOP) if helped[i] else NOTHING for i in robots]
    before = [fleet.duration[i] if goes_on(problem, fleet, alpha, kind, i) else 0 for i in robots]
    duration = [before[i] + 1 if helped[i] else 0 for i in robots]

    # Every robot that violates no constraint acts, and the environment answers.
    moving = [i for i in robots if not c[i]]
    by_human = [i for i in moving if kind[i] == TELEOP and given.present[i]]
    by_robot = [i for i in moving if i not in by_human]
    action = merge(given.robot_action, given.human_action, by_human)
    s_next = merge(merge(s, given.after_robot, by_robot), given.after_human, by_human)

    # Data: D_H, and what the critics learn from, before any reset.
    if problem.learns:
        for i in by_human:
            fleet.data.append((s["obs"][i], given.human_action[i]))
        for i in by_human:
            for e, member in enumerate(fleet.resample):
                member.append(int(given.resample_bits[e, i]) % len(fleet.data))
    for i in moving:
        store(problem, fleet, (s["obs"][i], action[i], s_next["obs"][i], s_next["violation"][i], s_next["success"][i]))

    # Resets and new goals.
    hard = [i for i in robots if kind[i] == HARD_RESET and duration[i] >= problem.hard_reset_time]
    ends = [s_next["timeout"][i] or (s_next["success"][i] and not problem.new_goals) for i in robots]
    soft = [i for i in moving if ends[i]]
    renewed = [i for i in moving if s_next["success"][i] and not ends[i]]
    s_after = merge(s_next, given.fresh, hard + soft)
    s_after = merge(s_after, given.renewed_robot, [i for i in renewed if i in by_robot])
    s_after = merge(s_after, given.renewed_human, [i for i in renewed if i in by_human])

    metrics = {
        "successes": sum(bool(s_next["success"][i]) for i in moving),
        "violations": sum(bool(s_next["violation"][i]) for i in moving),
        "hard_resets": len(hard),
        "idle": problem.num_robots - len(moving),
        "human_steps": int(alpha.sum()),
        "teleop_steps": kind.count(TELEOP),
        "switches": sum(bool((alpha[i] != fleet.alpha[i]).any()) for i in robots),
        "moving": len(moving),
    }
    successes = fleet.successes + metrics["successes"]
    human_steps = fleet.human_steps + metrics["human_steps"]
    return_on_effort = problem.num_humans / problem.num_robots * successes / (1 + human_steps / 100)
    reward = float(sum(s_next["reward"][i] for i in moving))
    after = Fleet(
        state=s_after,
        alpha=alpha,
        type=kind,
        duration=duration,
        t=fleet.t + 1,
        data=fleet.data,
        resample=fleet.resample,
        critics=fleet.critics,
        thrifty_history=fleet.thrifty_history,
        gradient_steps=fleet.gradient_steps + (problem.gradient_steps if problem.learns else 0),
        successes=successes,
        human_steps=human_steps,
    )
    return after, Outcome(p, alpha, before, kind, action, hard, soft, renewed, metrics, reward, return_on_effort)


def goes_on(problem: Problem, fleet: Fleet, alpha: np.ndarray, kind: list[str], i: int) -> bool:
    """Return whether robot i's intervention is the last timestep's: same human, same type, no hard reset that is completed."""
    same_human = alpha[i].any() and (alpha[i] == fleet.alpha[i]).all()
    completed = fleet.type[i] == HARD_RESET and fleet.duration[i] >= problem.hard_reset_time
    return bool(same_human and kind[i] == fleet.type[i] and not completed)


def merge(old: Any, new: Any, robots: list[int]) -> Any:
    """Return `old` with the rows of `robots` taken from `new`; arrays, or dictionaries of them."""
    if isinstance(old, dict):
        return {name: merge(old[name], new[name], robots) for name in old}
    rows = np.array(old)
    rows[robots] = new[robots]
    return rows


def store(problem: Problem, fleet: Fleet, transition: tuple) -> None:
    """Add a transition to the ring of positives or of negatives of every critic; a full ring loses its oldest."""
    _, _, _, violation, success = transition
    for kind, critic in fleet.critics.items():
        positive = bool(violation if kind == "safety" else success)
        ring, room = (critic.positives, critic.negatives)[not positive], problem.ring_sizes[kind][not positive]
        ring.append(transition)
        critic.stored[not positive] += 1
        del ring[:-room]
