"""Every parameter of a run: its meaning, unit, default, range, and whether changing it compiles again.

The defaults are the paper's (Section 5.2 and Appendix); environments change some of them, see `fleetjax.envs.get_defaults`. The
help of the command line is made from these tables, without loading JAX.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

# What a value of each kind is called in messages.
KINDS: dict[type, str] = {
    str: "a text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    tuple: "a list of whole numbers",
}


class Field(NamedTuple):
    """What is known of a parameter, be it a field of `Config` or an algorithm's own.

    Attributes:
        help: meaning.
        unit: unit, or "".
        kind: `str`, `int`, `float`, `bool` or `tuple`.
        traced: whether it is an array that can be swept without compiling again; an algorithm's own parameters always are.
        low: smallest allowed value.
        high: largest allowed value.
        default: value unless another is given.
        per_human: whether it may be a tuple with a value for each human.
    """

    help: str
    unit: str = ""
    kind: type = float
    traced: bool = True
    low: float | None = 0
    high: float | None = None
    default: Any = 0.0
    per_human: bool = False


def _static(default: Any, help: str, unit: str = "", *, low: float | None = None) -> Any:
    field = Field(help, unit, type(default), False, low, None, default)
    return dataclasses.field(default=default, metadata={"field": field})


def _traced(
    default: Any, help: str, unit: str = "", *, low: float | None = 0, high: float | None = None, per_human: bool = False
) -> Any:
    field = Field(help, unit, type(default), True, low, high, default, per_human)
    return dataclasses.field(default=default, metadata={"field": field})


_of_humans = functools.partial(_traced, per_human=True)


@dataclasses.dataclass(frozen=True)
class Fields:
    """The parameters that every run has. Static ones shape the program, traced ones are arrays."""

    environment: str = _static("humanoid", "name of the environment")
    algorithm: str = _static("cur", "name of the algorithm, an order of the letters c, u, r, or MODULE:NAME")
    supervisor: str = _static("", "name of the supervisor; empty = the environment's own")
    backend: str = _static("auto", "physics backend: native (CPU threads), mjx (pure JAX), warp (NVIDIA GPU), auto")
    allocation: str = _static("hard", "hard, or soft: relaxed for derivatives (algorithms with differentiable scores)")
    human_model: str = _static("perfect", "name of the model of humans: perfect, or imperfect, which has parameters below")
    link_model: str = _static("perfect", "connections to the robots: perfect, gilbert_elliott, unequal, swapping")
    num_robots: int = _static(100, "robots N", low=1)
    num_humans: int = _static(10, "human supervisors M, at most N", low=1)
    num_steps: int = _static(10_000, "operation time T", "timesteps", low=1)
    ensemble_size: int = _static(5, "networks in the policy ensemble E (discrete actions: 1)", low=1)
    hidden_sizes: tuple[int, ...] = _static((256, 256), "units of the hidden layers of policy and critics")
    batch_size: int = _static(256, "samples per gradient step", low=1)
    gradient_steps: int = _static(1, "gradient steps per timestep", low=0)
    augmented_copies: int = _static(1, "copies kept of each human pair; if more than 1, their images are augmented", low=1)
    human_capacity: int = _static(0, "pairs of human data that fit; 0 = as many as the run can produce", low=0)
    critic_capacity: int = _static(
        250_000,
        "room for the critics' data, at least one per robot; when it is full, new data replace the oldest",
        "transitions",
        low=1,
    )

    min_teleop_time: int = _traced(5, "shortest teleoperation t_T", "timesteps", low=1)
    hard_reset_time: int = _traced(5, "duration of a hard reset t_R", "timesteps", low=1)
    initial_period: int = _traced(
        0,
        "first t_I timesteps, in which cur, other orders with C, weighted and asa send no human to robots in violation",
        "timesteps",
    )
    success_return: float = _traced(
        0.0, "return above which an episode of full length succeeds, where the environment judges by returns", low=None
    )
    uncertainty_threshold: float = _traced(
        0.05, "robots below this uncertainty count as certain; in nats where actions are discrete"
    )
    risk_threshold: float = _traced(0.5, "robots below this risk count as safe", high=1)
    temperature: float = _traced(
        0.1, "softness of the soft allocation: width of its sigmoids, in units of scores (successes: of the success tolerance)"
    )
    learning_rate: float = _traced(3e-4, "Adam's learning rate, policy and critics")
    normalize_observations: bool = _traced(
        True, "scale observations by the mean and standard deviation of the demonstrations (images: by a fixed scale)"
    )
    num_demonstrations: int = _traced(5000, "offline pairs from supervisor episodes, the last one cut to fit", low=1)
    extra_demonstrations: int = _traced(0, "further offline pairs (the constraint baseline)")
    pretraining_steps: int = _traced(1000, "gradient steps on the demonstrations")
    critic_pretraining_steps: int = _traced(3000, "gradient steps on the offline transitions")
    num_critic_transitions: int = _traced(20_000, "offline transitions for the critic")
    critic_noise: float = _traced(0.25, "standard deviation of the action noise in those transitions")
    positive_fraction: float = _traced(0.25, "share of positives in a critic batch", high=1)
    risk_discount: float = _traced(0.5, "discount of the safety critic", high=1)
    goal_discount: float = _traced(0.999, "discount of the goal critic", high=1)
    target_rate: float = _traced(2e-4, "rate at which target networks follow, per gradient step", high=1)

    action_noise: float = _of_humans(0.0, "standard deviation of the noise on their actions")
    mistake_rate: float = _of_humans(0.0, "chance of a random action", high=1)
    takeover_time: float = _of_humans(0.0, "mean time from their assignment to their first action", "timesteps")
    takeover_spread: float = _of_humans(0.5, "standard deviation of that time, as a share of its mean")
    action_delay: float = _of_humans(0.0, "time by which their actions are late", "timesteps", high=10)
    switching_lag: float = _of_humans(0.0, "further time if they come from another robot", "timesteps")
    fatigue: float = _of_humans(0.0, "growth of takeover time and noise for one who is always busy, as a share")
    absence: float = _of_humans(0.0, "share of the time in which they are away", high=0.99)
    absence_time: float = _of_humans(100.0, "mean time for which they are away", "timesteps", low=1)
    link_failure_rate: float = _traced(0.01, "gilbert_elliott: chance per timestep that a working link fails", high=1)
    link_repair_rate: float = _traced(0.1, "gilbert_elliott: chance per timestep that a failed link is repaired", high=1)


FIELDS: dict[str, Field] = {f.name: f.metadata["field"] for f in dataclasses.fields(Fields)}

# The parameters of imperfect people, neutral by default; the shapes make no difference alone.
OF_HUMANS = tuple(name for name, field in FIELDS.items() if field.per_human)
SHAPES_OF_HUMANS = ("takeover_spread", "absence_time")
OF_LINKS = ("link_failure_rate", "link_repair_rate")

# What acts only before the fleet starts.
OFFLINE = (
    "num_demonstrations",
    "extra_demonstrations",
    "pretraining_steps",
    "critic_pretraining_steps",
    "num_critic_transitions",
    "critic_noise",
    "normalize_observations",
)

# The orders of C, U and R, such as C.U.R.
ORDERS = tuple("".join(letters) for size in (3, 2, 1) for letters in itertools.permutations("cur", size))
ORDERS_WITH_C = tuple(letters for letters in ORDERS if "c" in letters)
_IDLE = Field("in the initial period, free humans teleoperate random robots", kind=bool, high=None, default=False)

_TAU = Field("mean squared difference of actions above which they count as a discrepancy (lazy_dagger: 0.032)", default=0.0025)

# The parameters that an algorithm has besides, by its name. `register_algorithm` adds those of others.
PARAMETERS: dict[str, Mapping[str, Field]] = {
    "random": {"random_threshold": Field("scores below this become 0", high=1, default=0.9)},
    "thrifty_dagger": {
        "thrifty_weight": Field("weight of the chance of failure", high=1, default=0.25),
        "thrifty_threshold": Field("normalised scores at or below this become 0", default=3.25),
    },
    "weighted": {
        "violation_weight": Field("weight of a violation", default=100.0),
        "uncertainty_weight": Field("weight of the uncertainty, in units of its threshold", default=10.0),
        "risk_weight": Field("weight of the risk, in units of its threshold", default=1.0),
        "goal_weight": Field("weight of the chance not to reach the goal; needs an environment with goals", default=0.0),
    },
    "quantile_ensemble": {
        "quantile_rate": Field("target share of robots that ask, over time", high=1, default=0.01),
        "quantile_memory": Field("time within which quantiles forget", "timesteps", low=1, default=1000.0),
        "quantile_calibration": Field("time from which the quantile stays as it is; 0 = never", "timesteps", default=0.0),
    },
    "thrifty_quantile": {
        "thrifty_rate": Field("target share of robots that ask, over time, by each of two criteria", high=1, default=0.01),
        "thrifty_memory": Field("time within which quantiles forget", "timesteps", low=1, default=1000.0),
    },
    "safe_dagger": {
        "safe_threshold": Field("chance of a discrepancy below which no robot asks", high=1, default=0.5),
        "discrepancy_tau": _TAU,
    },
    "lazy_dagger": {
        "lazy_threshold": Field("chance of a discrepancy below which no robot asks", high=1, default=0.5),
        "discrepancy_tau": _TAU._replace(default=0.032),
        "lazy_handback": Field("discrepancy at which a human hands back, as a share of discrepancy_tau", default=0.25),
    },
    "dropout_dagger": {
        "dropout_threshold": Field("mean squared difference up to which a sampled action is near the human's", default=0.05),
        "dropout_share": Field(
            "share of near actions, of those sampled, at or above which a robot does not ask", high=1, default=0.5
        ),
    },
    "oracle_discrepancy": {
        "oracle_threshold": Field("mean squared difference of actions below which no robot asks", default=0.05),
    },
    "crsail": {
        "crsail_threshold": Field(
            "distance to what humans saw, in units of the radius, below which no robot asks", default=1.0
        ),
        "crsail_rate": Field("share of demonstrated states beyond the radius", high=1, default=0.05),
    },
    "conformal": {
        "conformal_threshold": Field("width of the interval below which no robot asks", default=0.5),
        "conformal_rate": Field("share of humans' actions that may lie outside the interval", high=1, default=0.1),
        "conformal_gain": Field("how fast the interval adapts", default=0.05),
    },
    "aim": {"aim_rate": Field("target share of robots that ask, over time", high=1, default=0.05)},
    "iifl": {"iifl_rate": Field("target share of robots that ask, over time", high=1, default=0.001)},
    "round_robin": {
        "round_robin_threshold": Field("time without help up to which no robot is served", "timesteps", default=100.0),
    },
    "teach_first": {
        "teaching_time": Field(
            "time for which humans act on moving robots, all together, before they only reset",
            "human timesteps",
            low=1,
            default=5000.0,
        ),
    },
    "whittle": {
        "whittle_threshold": Field("index, as worth of a timestep of help, at or below which no robot is helped", default=0.1),
        "whittle_discount": Field("discount per timestep", high=0.99, default=0.99),
    },
    "asa": {
        "asa_threshold": Field("gain in coverage below which nobody else is helped", default=0.351),
        "asa_uncertainty": Field("robots below this uncertainty count as certain", default=0.151),
        "asa_risk": Field("robots below this risk count as safe", high=1, default=0.198),
    },
    **{letters: {"idle_humans_teleoperate": _IDLE} for letters in ORDERS_WITH_C},
}


def every_field() -> dict[str, Field]:
    """Return the fields of `Config` and the parameters of all registered algorithms, by name.

    Of a parameter that several algorithms have, it is the first one's.
    """
    found: dict[str, Field] = {}
    for own in PARAMETERS.values():
        for name, field in own.items():
            found.setdefault(name, field)
    return found | FIELDS


def owners(name: str) -> tuple[str, ...]:
    """Return the algorithms that have a parameter of this name."""
    return tuple(algorithm for algorithm, own in PARAMETERS.items() if name in own)


def owners_in_words(name: str) -> str:
    """Return the same as people read it.

    >>> owners_in_words("random_threshold"), owners_in_words("idle_humans_teleoperate")
    ('random', 'cur and other orders with c')
    """
    found = owners(name)
    others = [algorithm for algorithm in found if algorithm not in ORDERS_WITH_C]
    return ", ".join([*others, *(["cur and other orders with c"] if len(others) < len(found) else [])])
