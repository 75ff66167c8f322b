"""Environments: the contract and the registry."""
from fleetjax.envs.base import Env, EnvSpec
from fleetjax.envs import humanoid
SUCCESS_FLOOR = {"humanoid": 6000.0}
def make_env(name, **kw):
    return humanoid.make_env(**kw)
