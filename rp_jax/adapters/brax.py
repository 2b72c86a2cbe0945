"""Environments for brax, new starts after each episode, and the shield for any brax environment.

Importing this module registers every environment: `brax.envs.get_environment("rp_jax_jam")`.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax import arrays, shield
from rp_jax.adapters import registry
from rp_jax.adapters.quiet import quietly
from rp_jax.copies import parts
from rp_jax.envs import contract, optional
from rp_jax.validate import number, positive

with quietly():
    from brax import envs
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers import training


def _typed(key: Array) -> Array:
    """Returns a key in the typed form that this library uses; brax hands out raw keys."""
    return key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)


def _split(keys: Array) -> tuple[Array, Array]:
    """Returns two raw keys from one, or from each of a batch; keys inside a state must be raw."""
    split = jax.random.split if _typed(keys).ndim == 0 else jax.vmap(jax.random.split)
    pair = jax.random.key_data(split(_typed(keys)))
    return pair[..., 0, :], pair[..., 1, :]


class BraxEnv(Env):
    """One of this library's environments as a brax environment, unbatched.

    `pipeline_state` is the environment's own state. `done` is 1 only in terminal states: as
    everywhere in brax, the time limit is left to wrappers (`wrap` sets it), and
    `info["truncation"]` reports it. Danger is `info["cost"]`, and in `metrics`.
    """

    def __init__(self, env: contract.Env, params: Any):
        self.env, self.params = env, params

    __reduce__ = parts

    @property
    def observation_size(self) -> int:
        """The length of an observation."""
        return optional.observation_size(self.env, self.params)

    @property
    def action_size(self) -> int:
        """The size of a continuous action, 2: acceleration and turn, each in [-1, 1]."""
        return 2

    @property
    def backend(self) -> str:
        """The name of the physics backend, "rp_jax", since none of brax's is used."""
        return "rp_jax"

    @property
    def time_limit(self) -> int:
        """The number of steps of an episode."""
        return int(self.params.time_limit)

    def reset(self, rng: Array) -> State:
        """Returns a new start.

        Args:
            rng: random key, typed or raw.
        """
        start, key = _split(rng)
        state = self.env.reset(_typed(start), self.params)
        no = jnp.zeros(())
        return State(
            pipeline_state=state,
            obs=self.env.observe(state, self.params),
            reward=no,
            done=no,
            metrics={"cost": no, "goal": no},
            info={"cost": no, "truncation": no, "key": key},
        )

    def step(self, state: State, action: Array) -> State:
        """Makes one transition, under a random key that the state carries.

        Args:
            state: a state from `reset` or `step`.
            action: () int, one of the discrete actions; or (2,) float, clipped to [-1, 1].

        Returns:
            The state after.

        Raises:
            ValueError: the action has another shape or type.
        """
        now, later = _split(state.info["key"])
        args = _typed(now), state.pipeline_state, _checked(action), self.params
        reached, outcome = self.env.step(*args)
        # brax's wrappers know no flags, but floats in the precision of JAX.
        flags = outcome.terminated, outcome.truncated, outcome.goal
        done, truncation, goal = (flag.astype(float) for flag in flags)
        cost = outcome.danger
        return state.replace(
            pipeline_state=reached,
            obs=self.env.observe(reached, self.params),
            reward=outcome.reward,
            done=done,
            metrics=state.metrics | {"cost": cost, "goal": goal},
            info=state.info | {"cost": cost, "truncation": truncation, "key": later},
        )


def _checked(action: Any) -> Array:
    """Returns an action as an array; raises ValueError unless it is an integer or 2 floats."""
    action = jnp.asarray(action)
    discrete = action.shape == () and jnp.issubdtype(action.dtype, jnp.integer)
    continuous = action.shape == (2,) and jnp.issubdtype(action.dtype, jnp.floating)
    if not (discrete or continuous):
        raise ValueError(
            f"action is {action.dtype} of shape {action.shape}; it must be an integer or 2 floats"
        )
    return action


class FreshResets(Wrapper):
    """A wrapper that draws a new start wherever an episode of a batch has ended.

    It works for any brax environment that takes a batch of keys; brax's AutoResetWrapper always
    returns to the first start. `info["final_obs"]` is the observation that the last step led to,
    terminal ones included.
    """

    def reset(self, rng: Array) -> State:
        """Returns new starts.

        Args:
            rng: (B,) random keys.
        """
        start, key = _split(rng)
        state = self.env.reset(start)
        return state.replace(info=state.info | {"reset_key": key, "final_obs": state.obs})

    def step(self, state: State, action: Array) -> State:
        """Makes one transition of the batch.

        Args:
            state: states, leading axis (B,).
            action: (B, ...) actions.

        Returns:
            States whose `done` and `info` belong to the step, and whose `obs` is that of the states
            to continue from, new starts included.
        """
        now, later = _split(state.info["reset_key"])
        info = dict(state.info)
        if "steps" in info:
            info["steps"] = jnp.where(state.done > 0, 0, info["steps"])
        reached = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action)

        def starts(rows: Array) -> tuple[Any, Any]:
            fresh = self.env.reset(now.at[rows].get(mode="clip"))
            return fresh.pipeline_state, fresh.obs

        seen = reached.pipeline_state, reached.obs
        pipeline_state, obs = arrays.replace_rows(reached.done > 0, seen, starts)
        info = reached.info | {"reset_key": later, "final_obs": reached.obs}
        return reached.replace(pipeline_state=pipeline_state, obs=obs, info=info)


def wrap(
    env: Env,
    episode_length: int,
    action_repeat: int = 1,
    randomization_fn: Callable | None = None,
) -> Wrapper:
    """Wraps an environment for brax's agents, as their `wrap_env_fn`.

    It adds a batch axis, a time limit that is not a terminal state, and new starts after each
    episode.

    Args:
        env: an unbatched environment.
        episode_length: number of steps; the environment's own time limit counts where it is
            shorter.
        action_repeat: must be 1; a crash inside a repeated action would be missed.
        randomization_fn: must be None; vary the environment's parameters instead.

    Raises:
        ValueError: `randomization_fn` is not None, `action_repeat` is not 1, or `episode_length`
            is not a positive integer.
    """
    number("action_repeat", action_repeat, least=1, most=1, integer=True)
    positive("episode_length", episode_length, integer=True)
    if randomization_fn is not None:
        raise ValueError("randomization_fn is given; it must be None: vary the parameters instead")
    limit = min(episode_length, getattr(env, "time_limit", episode_length))
    return FreshResets(training.EpisodeWrapper(training.VmapWrapper(env), limit, action_repeat))


class ShieldWrapper(Wrapper):
    """A wrapper that replaces inadmissible actions by admissible ones, whatever the policy.

    It works for any brax environment, batched or not. `info` and `metrics` report for each step
    whether the policy's choice was replaced ("intervention"), and whether no action was admissible
    ("insecure"), in which case the least threatening one is taken.
    """

    def __init__(
        self,
        env: Env,
        threat: Callable[[State], Array],
        x: Array | float,
        table: Array | None = None,
    ):
        """Wraps an environment with a shield, which asks for the threats before every step.

        Args:
            env: the environment; it takes () int actions, or with a table (D,) floats.
            threat: maps a state to the threats (A,) of its actions, with leading axes where `env`
                is batched.
            x: greatest admissible threat; infinity lets every action pass.
            table: (A, D) the continuous actions that the threats belong to.
        """
        super().__init__(env)
        self.threat, self.x, self.table = threat, x, table

    def reset(self, rng: Array) -> State:
        """Returns a start of the wrapped environment.

        Args:
            rng: random key or keys, as the wrapped environment takes them.
        """
        state = self.env.reset(rng)
        none = jnp.zeros_like(state.done)
        return _tell(state, {"intervention": none, "insecure": none})

    def step(self, state: State, action: Array) -> State:
        """Makes one transition under the admissible action that comes closest to the given one.

        Args:
            state: a state from `reset` or `step`.
            action: () int, replaced by the least threatening action; or (A,) floats, scores of all
                actions, replaced by the best admissible one; or with a table (D,) floats, a
                continuous action, replaced by the nearest admissible row.

        Returns:
            The state after.
        """
        threat = shield.threat_array(self.threat(state))
        function = functools.partial(shield.correct, x=self.x, table=self.table)
        for _ in range(threat.ndim - 1):
            function = jax.vmap(function)
        chosen = function(threat, jnp.asarray(action))
        taken = chosen.action if self.table is None else self.table[chosen.action]
        told = {"intervention": chosen.intervened, "insecure": ~chosen.secure}
        told = {name: value.astype(state.done.dtype) for name, value in told.items()}
        return _tell(self.env.step(_without(state, told), taken), told)


def _without(state: State, told: dict[str, Array]) -> State:
    """Returns a state as the wrapped environment made it, without a shield's entries.

    Wrappers inside count the metrics that they began with, and would not know these.
    """
    kept = lambda table: {name: table[name] for name in table if name not in told}  # noqa: E731
    return state.replace(info=kept(state.info), metrics=kept(state.metrics))


def _tell(state: State, told: dict[str, Array]) -> State:
    """Returns a state with entries added to its `info` and `metrics`."""
    return state.replace(info=state.info | told, metrics=state.metrics | told)


def _device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Returns a copy of every array on each device, along a new leading axis."""
    mesh = jax.sharding.Mesh(np.asarray(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    copies = lambda a: jnp.broadcast_to(a, (len(devices), *jnp.shape(a)))  # noqa: E731
    return jax.tree.map(lambda a: jax.device_put(copies(a), sharding), tree)


@contextlib.contextmanager
def training_agents() -> Iterator[None]:
    """Lets the agents of brax 0.14.2 train on new versions of jax, inside the context.

    Its PPO and SAC call a function that jax 0.10 removed
    (https://github.com/google/brax/issues/671). The development version of brax no longer does;
    this can be removed after its next release.
    """
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = _device_put_replicated  # type: ignore[assignment]
    try:
        yield
    finally:
        del jax.device_put_replicated


def _maker(name: str) -> Callable[..., BraxEnv]:
    """Returns the function from settings to an environment that brax registers.

    brax's scripts name a physics backend, `backend`; there is none here, and it is ignored.
    """
    return lambda backend=None, **settings: BraxEnv(*registry.make(name, **settings))


for _name in registry.ENVS:
    envs.register_environment(f"rp_jax_{_name}", _maker(_name))
