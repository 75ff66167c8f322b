"""fleetjax: interactive fleet learning in JAX. N robots, M humans: who gets help, and what does the fleet gain?"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from fleetjax.version import VERSION

if TYPE_CHECKING:
    from fleetjax import envs
    from fleetjax.allocation import allocate
    from fleetjax.config import Config, make_config, validate
    from fleetjax.envs import Env, EnvSpec, list_envs, register_env
    from fleetjax.envs.checking import check_env
    from fleetjax.experiment import Result, evaluate, extend, prepare, run, run_logged
    from fleetjax.field import Field
    from fleetjax.fleet import Fleet, FleetState, make_fleet
    from fleetjax.gradients import Sensitivity, sensitivity
    from fleetjax.humans import HumanModel, register_human_model
    from fleetjax.io.animation import Animation, animate
    from fleetjax.io.comparing import compare
    from fleetjax.io.comparison import Comparison
    from fleetjax.io.figure import plot
    from fleetjax.learning.estimator import Estimator, Step
    from fleetjax.learning.estimators import register_estimator
    from fleetjax.metrics import Metrics, first_divergence, rohe
    from fleetjax.priority import Algorithm, Priority, list_algorithms, register_algorithm, register_priority
    from fleetjax.supervisors import Supervisor, list_supervisors, register_supervisor
    from fleetjax.tuning import Tuned, tune
    from fleetjax.types import EnvState, HumanState, Interventions, Plan, Signals

__version__ = VERSION
__all__ = [
    "Algorithm",
    "Animation",
    "Comparison",
    "Config",
    "Env",
    "EnvSpec",
    "EnvState",
    "Estimator",
    "Field",
    "Fleet",
    "FleetState",
    "HumanModel",
    "HumanState",
    "Interventions",
    "Metrics",
    "Plan",
    "Priority",
    "Result",
    "Sensitivity",
    "Signals",
    "Step",
    "Supervisor",
    "Tuned",
    "allocate",
    "animate",
    "check_env",
    "compare",
    "envs",
    "evaluate",
    "extend",
    "first_divergence",
    "list_algorithms",
    "list_envs",
    "list_supervisors",
    "make_config",
    "make_fleet",
    "plot",
    "prepare",
    "register_algorithm",
    "register_env",
    "register_estimator",
    "register_human_model",
    "register_priority",
    "register_supervisor",
    "rohe",
    "run",
    "run_logged",
    "sensitivity",
    "tune",
    "validate",
]

# The names of each module. It is imported when the first of them is used: JAX takes a second to load, and the help of the
# command line does without.
_NAMES = {
    "allocation": ["allocate"],
    "config": ["Config", "make_config", "validate"],
    "envs": ["Env", "EnvSpec", "list_envs", "register_env"],
    "envs.checking": ["check_env"],
    "experiment": ["Result", "evaluate", "extend", "prepare", "run", "run_logged"],
    "field": ["Field"],
    "fleet": ["Fleet", "FleetState", "make_fleet"],
    "gradients": ["Sensitivity", "sensitivity"],
    "io.animation": ["Animation", "animate"],
    "io.comparing": ["compare"],
    "io.comparison": ["Comparison"],
    "io.figure": ["plot"],
    "humans": ["HumanModel", "register_human_model"],
    "learning.estimator": ["Estimator", "Step"],
    "learning.estimators": ["register_estimator"],
    "metrics": ["Metrics", "first_divergence", "rohe"],
    "priority": ["Algorithm", "Priority", "list_algorithms", "register_algorithm", "register_priority"],
    "supervisors": ["Supervisor", "list_supervisors", "register_supervisor"],
    "tuning": ["Tuned", "tune"],
    "types": ["EnvState", "HumanState", "Interventions", "Plan", "Signals"],
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Return a public name, or a module of the package."""
    if name in _MODULES:
        return getattr(importlib.import_module(f"fleetjax.{_MODULES[name]}"), name)
    if not name.startswith("_") and importlib.util.find_spec(f"fleetjax.{name}"):
        return importlib.import_module(f"fleetjax.{name}")
    raise AttributeError(f"module 'fleetjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
