"""fleetjax: interactive fleet learning in JAX. N robots, M humans: who gets help, and what does the fleet gain?"""

from fleetjax import envs
from fleetjax.allocation import allocate
from fleetjax.config import Config, make_config, validate
from fleetjax.envs import Env, EnvSpec, list_envs, register_env
from fleetjax.envs.checking import check_env
from fleetjax.field import Field
from fleetjax.fleet import Fleet, FleetState, make_fleet
from fleetjax.learning.estimators import Estimator, Step, register_estimator
from fleetjax.metrics import Metrics, first_divergence, rohe
from fleetjax.priority import Algorithm, Priority, list_algorithms, register_algorithm, register_priority
from fleetjax.run import Result, evaluate, extend, prepare, run, run_logged
from fleetjax.supervisors import Supervisor, list_supervisors, register_supervisor
from fleetjax.types import EnvState, HumanState, Interventions, Plan, Signals
from fleetjax.version import VERSION

__version__ = VERSION
__all__ = [
    "Algorithm",
    "Config",
    "Env",
    "EnvSpec",
    "EnvState",
    "Estimator",
    "Field",
    "Fleet",
    "FleetState",
    "HumanState",
    "Interventions",
    "Metrics",
    "Plan",
    "Priority",
    "Result",
    "Signals",
    "Step",
    "Supervisor",
    "allocate",
    "check_env",
    "envs",
    "evaluate",
    "extend",
    "first_divergence",
    "list_algorithms",
    "list_envs",
    "list_supervisors",
    "make_config",
    "make_fleet",
    "prepare",
    "register_algorithm",
    "register_env",
    "register_estimator",
    "register_priority",
    "register_supervisor",
    "rohe",
    "run",
    "run_logged",
    "validate",
]
