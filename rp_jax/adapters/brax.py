"""Environments as brax's, fresh resets for brax's own, and the shield for any of them.

Importing this module registers every environment: `brax.envs.get_environment("rp_jax_jam")`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax import shield
from rp_jax.adapters import registry
from rp_jax.adapters.quiet import quietly
from rp_jax.envs import base
from rp_jax.validate import number

with quietly():
    from brax import envs
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers import training


def _typed(key: Array) -> Array:
    """brax hands out raw keys; ours are typed."""
    return key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)


def _split(keys: Array) -> tuple[Array, Array]:
    """Two raw keys from one, or from each of a batch; what a state carries must be raw."""
    split = jax.random.split if _typed(keys).ndim == 0 else jax.vmap(jax.random.split)
    pair = jax.random.key_data(split(_typed(keys)))
    return pair[..., 0, :], pair[..., 1, :]


class BraxEnv(Env):
    """One of our environments, unbatched.

    `pipeline_state` is the environment's own state. `done` is 1 at a true end only: as in all of
    brax, the time limit is the wrappers' (`wrap` sets it); `info["truncation"]` tells of it here.
    Danger is `info["cost"]`, and in `metrics`.
    """

    def __init__(self, env: base.Env, params: Any):
        self.env, self.params = env, params

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self.env.LIDAR_BINS + len(self.env.SCALE)

    @property
    def action_size(self) -> int:
        """2: acceleration and turn, as shares in [-1, 1] of the strongest."""
        return 2

    @property
    def backend(self) -> str:
        """None of brax's."""
        return "rp_jax"

    @property
    def time_limit(self) -> int:
        """Steps of an episode."""
        return int(self.params.time_limit)

    def reset(self, rng: Array) -> State:
        """A fresh start. `rng` is a typed key or a raw one."""
        start, key = _split(rng)
        state = self.env.reset(_typed(start), self.params)
        zero, no = jnp.zeros(()), jnp.zeros((), jnp.float32)
        return State(
            pipeline_state=state,
            obs=self.env.observe(state, self.params),
            reward=zero,
            done=no,
            metrics={"cost": zero, "goal": no},
            info={"cost": zero, "truncation": no, "key": key},
        )

    def step(self, state: State, action: Array) -> State:
        """One transition: the environment's `step` under a key that the state carries.

        Args:
            state: of `reset` or `step`.
            action: () int, one of the discrete actions; or (2,) float, cut to [-1, 1].

        Raises:
            ValueError: the action has another shape or type.
        """
        now, later = _split(state.info["key"])
        args = _typed(now), state.pipeline_state, _checked(action), self.params
        reached, outcome = self.env.step(*args)
        truncation = outcome.truncated.astype(jnp.float32)
        cost, goal = outcome.danger, outcome.goal.astype(jnp.float32)
        return state.replace(
            pipeline_state=reached,
            obs=self.env.observe(reached, self.params),
            reward=outcome.reward,
            done=outcome.terminated.astype(jnp.float32),
            metrics=state.metrics | {"cost": cost, "goal": goal},
            info=state.info | {"cost": cost, "truncation": truncation, "key": later},
        )


def _checked(action: Any) -> Array:
    action = jnp.asarray(action)
    discrete = action.shape == () and jnp.issubdtype(action.dtype, jnp.integer)
    continuous = action.shape == (2,) and jnp.issubdtype(action.dtype, jnp.floating)
    if not (discrete or continuous):
        raise ValueError(
            f"action is {action.dtype} of shape {action.shape}; it must be an integer or 2 floats"
        )
    return action


class FreshResets(Wrapper):
    """Begins anew, from a start drawn anew, wherever an episode of a batch has ended.

    For any brax environment that takes a batch of keys; brax's AutoResetWrapper returns to the
    first start for ever. The observation that an episode ended with is `info["final_obs"]`.
    """

    def reset(self, rng: Array) -> State:
        """Starts; `rng` has a leading axis (B,)."""
        start, key = _split(rng)
        state = self.env.reset(start)
        return state.replace(info=state.info | {"reset_key": key, "final_obs": state.obs})

    def step(self, state: State, action: Array) -> State:
        """One transition of all; `done` and `info` tell of the step, `obs` of what follows."""
        now, later = _split(state.info["reset_key"])
        info = dict(state.info)
        if "steps" in info:
            info["steps"] = jnp.where(state.done > 0, 0, info["steps"])
        reached = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action)

        def starts(rows: Array) -> tuple[Any, Any]:
            fresh = self.env.reset(now.at[rows].get(mode="clip"))
            return fresh.pipeline_state, fresh.obs

        seen = reached.pipeline_state, reached.obs
        pipeline_state, obs = base.renew(reached.done > 0, seen, starts)
        info = reached.info | {"reset_key": later, "final_obs": reached.obs}
        return reached.replace(pipeline_state=pipeline_state, obs=obs, info=info)


def wrap(
    env: Env,
    episode_length: int,
    action_repeat: int = 1,
    randomization_fn: Callable | None = None,
) -> Wrapper:
    """For brax's agents, as `wrap_env_fn`: batches, time limits that are no ends, fresh resets.

    Args:
        env: unbatched.
        episode_length: steps; a time limit of the environment's own counts where it is shorter.
        action_repeat: 1; a crash inside a repeated action would not be seen.
        randomization_fn: not supported.

    Raises:
        ValueError: `randomization_fn` is given, or `action_repeat` is not 1.
    """
    number("action_repeat", action_repeat, least=1, most=1, integer=True)
    if randomization_fn is not None:
        raise ValueError("randomization_fn is given; it must be None: vary the parameters instead")
    limit = min(episode_length, getattr(env, "time_limit", episode_length))
    return FreshResets(training.EpisodeWrapper(training.VmapWrapper(env), limit, action_repeat))


class Shielded(Wrapper):
    """Lets no inadmissible action through where there is an admissible one, whatever the policy.

    For any brax environment, batched or not. `info` and `metrics` tell of each step whether the
    policy's choice was replaced ("intervention") and whether no action was admissible
    ("insecure"); then the least threatening one is taken.
    """

    def __init__(
        self,
        env: Env,
        threat: Callable[[State], Array],
        x: Array | float,
        table: Array | None = None,
    ):
        """The threat is asked before every step.

        Args:
            env: takes () int actions, or with a table (D,) floats.
            threat: maps a state to the threats (A,) of its actions; with leading axes where `env`
                is batched.
            x: largest admissible threat; infinity lets everything pass.
            table: (A, D) the actions that threats are given for, where they are continuous.
        """
        super().__init__(env)
        self.threat, self.x, self.table = threat, x, table

    def reset(self, rng: Array) -> State:
        """As without a shield."""
        state = self.env.reset(rng)
        none = jnp.zeros_like(state.done)
        return _tell(state, {"intervention": none, "insecure": none})

    def step(self, state: State, action: Array) -> State:
        """One transition under the nearest thing to `action` that is admissible.

        Args:
            state: of `reset` or `step`.
            action: () int, whose substitute is the least threatening action; or (A,) floats, the
                policy's scores, whose substitute is its next best; or with a table (D,) floats,
                taken for the nearest row, whose substitute is the nearest that is admissible.
        """
        threat = self.threat(state)
        function = functools.partial(shield.correct, x=self.x, table=self.table)
        for _ in range(threat.ndim - 1):
            function = jax.vmap(function)
        chosen = function(threat, jnp.asarray(action))
        taken = chosen.action if self.table is None else self.table[chosen.action]
        told = {"intervention": chosen.intervened, "insecure": ~chosen.secure}
        told = {name: value.astype(state.done.dtype) for name, value in told.items()}
        return _tell(self.env.step(state, taken), told)


def _tell(state: State, told: dict[str, Array]) -> State:
    return state.replace(info=state.info | told, metrics=state.metrics | told)


def _device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """A copy of every array on each device, along a new leading axis."""
    mesh = jax.sharding.Mesh(np.asarray(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    copies = lambda a: jnp.broadcast_to(a, (len(devices), *jnp.shape(a)))  # noqa: E731
    return jax.tree.map(lambda a: jax.device_put(copies(a), sharding), tree)


# brax 0.14.2's PPO and SAC call what jax 0.10 took away (https://github.com/google/brax/issues/671).
# brax's development version no longer does; this goes with the release that follows.
if not hasattr(jax, "device_put_replicated"):
    jax.device_put_replicated = _device_put_replicated  # type: ignore[assignment]


def _maker(name: str) -> Callable[..., BraxEnv]:
    return lambda **settings: BraxEnv(*registry.make(name, **settings))


for _name in registry.ENVS:
    envs.register_environment(f"rp_jax_{_name}", _maker(_name))
