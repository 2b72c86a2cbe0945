"""Environments for gymnasium, single and batched, and the shield for any gymnasium environment.

Importing this module registers every environment: `gymnasium.make("rp_jax/Jam-v0")`, and
`gymnasium.make_vec("rp_jax/Jam-v0", num_envs=1024)` for a batch in one compiled program.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rp_jax import shield
from rp_jax.adapters import registry
from rp_jax.envs import autoreset, optional
from rp_jax.envs.contract import Env
from rp_jax.validate import number, positive

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(
        "rp_jax.adapters.gymnasium needs gymnasium 1.1 or newer (pip install 'rp_jax[gymnasium]')"
    ) from error

FARTHEST = 100.0  # bound of observations beside the LIDAR; gymnasium wants a finite one


def _spaces(env: Env, params: Any) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Discrete]:
    """Returns the spaces of observations and actions; LIDAR values are in [0, 1]."""
    bins = optional.lidar_bins(env)
    sizes = bins, optional.observation_size(env, params) - bins
    low, high = (
        np.repeat(np.asarray(ends, np.float32), sizes) for ends in ((0, -FARTHEST), (1, FARTHEST))
    )
    return gymnasium.spaces.Box(low, high), gymnasium.spaces.Discrete(
        optional.num_actions(env, params)
    )


def _checked(action: Any, shape: tuple[int, ...], count: int) -> np.ndarray:
    """Returns an action, or a batch of them, as int32.

    Args:
        action: what the user gave.
        shape: shape that it must have.
        count: number of actions.

    Raises:
        ValueError: the shape differs, or a value is not an integer in [0, count).
    """
    given = np.asarray(action)
    if given.shape != shape or not np.issubdtype(given.dtype, np.integer):
        raise ValueError(
            f"action is {given.dtype} of shape {given.shape}; it must be integers of shape {shape}"
        )
    if given.size and (given.min() < 0 or given.max() >= count):
        raise ValueError(
            f"action is between {given.min()} and {given.max()}; it must be between 0 and "
            f"{count - 1}"
        )
    return given.astype(np.int32)


def _key(env: Any) -> jax.Array:
    """Draws a random key from gymnasium's own generator, which a seed may have been given to."""
    return jax.random.key(int(env.np_random.integers(2**31)))


@functools.partial(jax.jit, static_argnums=0)
def _start(env: Env, key: jax.Array, params: Any) -> tuple:
    """Returns the next key, a new start, and its observation."""
    key, now = jax.random.split(key)
    state = env.reset(now, params)
    return key, state, env.observe(state, params)


@functools.partial(jax.jit, static_argnums=0)
def _advance(env: Env, key: jax.Array, state: Any, action: Any, params: Any) -> tuple:
    """Returns the next key, the state after a step, its observation, and the outcome."""
    key, now = jax.random.split(key)
    reached, outcome = env.step(now, state, action, params)
    return key, reached, env.observe(reached, params), outcome


@functools.partial(jax.jit, static_argnums=(0, 2))
def _start_all(env: Env, key: jax.Array, count: int, params: Any) -> tuple:
    """Returns the next key, new starts (count,), and their observations."""
    key, now = jax.random.split(key)
    states = jax.vmap(env.reset, (0, None))(jax.random.split(now, count), params)
    return key, states, jax.vmap(env.observe, (0, None))(states, params)


@functools.partial(jax.jit, static_argnums=0)
def _advance_all(env: Env, key: jax.Array, states: Any, actions: Any, params: Any) -> tuple:
    """Makes a step of a batch.

    Returns:
        The next key; the states to continue from and their observations, new starts included; the
        observations that the step led to, terminal ones included; and the outcomes.
    """
    key, now = jax.random.split(key)
    keys = jax.random.split(now, len(actions))
    look = lambda states: jax.vmap(env.observe, (0, None))(states, params)  # noqa: E731
    carried, reached, outcome = autoreset.step_and_renew(env, keys, states, actions, params, look)
    return key, *carried, reached[1], outcome


class JaxEnv(gymnasium.Env[np.ndarray, np.int64]):
    """A single environment with its state in `state` and the danger of a step in `info["cost"]`."""

    metadata = {"render_modes": []}  # noqa: RUF012 (gymnasium's way)

    def __init__(self, name: str, **settings: Any):
        """Makes an environment from its registered name.

        Args:
            name: a name in `registry.ENVS`.
            **settings: settings of the environment's `make_params`.

        Raises:
            ValueError: the name is not registered, or a setting is out of range.
        """
        self.env, self.params = registry.make(name, **settings)
        self.observation_space, self.action_space = _spaces(self.env, self.params)
        self.state: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws a new start.

        Args:
            seed: makes this start and all that follows reproducible.
            options: not used.

        Returns:
            The observation, and an empty table.
        """
        super().reset(seed=seed)
        self._key, self.state, seen = _start(self.env, _key(self), self.params)
        return np.array(seen), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Makes one transition.

        Args:
            action: an integer.

        Returns:
            The observation, the reward, whether the episode was terminated, whether it was
            truncated, and a table with "cost" (the danger) and "goal".

        Raises:
            ValueError: the action is not an integer, or out of range.
            gymnasium.error.ResetNeeded: `reset` was never called.
        """
        _reset_first(self.state)
        taken = _checked(action, (), optional.num_actions(self.env, self.params))
        self._key, self.state, seen, outcome = _advance(
            self.env, self._key, self.state, taken, self.params
        )
        ended = bool(outcome.terminated), bool(outcome.truncated)
        info = {"cost": float(outcome.danger), "goal": bool(outcome.goal)}
        return np.array(seen), float(outcome.reward), *ended, info


class JaxVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batch of environments in one program, with new starts in the step that ends an episode.

    `info` describes what the step itself led to: "cost" and "goal" of every row, and for rows whose
    episode ended the last observation as "final_obs", and cost and goal again as "final_info".
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, name: str, num_envs: int = 1, **settings: Any):
        """Makes a batch of environments from their registered name.

        Args:
            name: a name in `registry.ENVS`.
            num_envs: number of environments.
            **settings: settings of the environment's `make_params`.

        Raises:
            ValueError: the name is not registered, or a setting is out of range.
        """
        self.num_envs = int(positive("num_envs", num_envs, integer=True))
        self.env, self.params = registry.make(name, **settings)
        self.single_observation_space, self.single_action_space = _spaces(self.env, self.params)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.states: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws new starts.

        Args:
            seed: makes these starts and all that follows reproducible.
            options: not used.

        Returns:
            The observations (num_envs, n), and an empty table.
        """
        super().reset(seed=seed)
        self._key, self.states, seen = _start_all(self.env, _key(self), self.num_envs, self.params)
        return np.array(seen), {}

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Makes one transition of every environment.

        Args:
            actions: (num_envs,) integers.

        Returns:
            The observations to continue from (num_envs, n), new starts included; the rewards,
            whether each episode was terminated, whether it was truncated, (num_envs,) each; and a
            table.

        Raises:
            ValueError: the actions are not integers (num_envs,), or out of range.
            gymnasium.error.ResetNeeded: `reset` was never called.
        """
        _reset_first(self.states)
        taken = _checked(actions, (self.num_envs,), optional.num_actions(self.env, self.params))
        self._key, self.states, seen, last, outcome = _advance_all(
            self.env, self._key, self.states, taken, self.params
        )
        ended = np.array(outcome.terminated), np.array(outcome.truncated)
        everywhere = np.ones(self.num_envs, bool)
        costs = {"cost": np.array(outcome.danger), "goal": np.array(outcome.goal)}
        info: dict[str, Any] = costs | {f"_{name}": everywhere.copy() for name in costs}
        done = ended[0] | ended[1]
        if done.any():
            info |= _final(np.asarray(last), costs, done)
        return np.array(seen), np.array(outcome.reward), *ended, info


def _reset_first(state: Any) -> None:
    """Raises ResetNeeded if there is no state yet."""
    if state is None:
        raise gymnasium.error.ResetNeeded("step is called before reset")


def _final(last: np.ndarray, costs: dict[str, np.ndarray], done: np.ndarray) -> dict[str, Any]:
    """Returns the entries of `info` for episodes that ended, each with a mask of their rows."""
    observations = np.full(len(done), None, object)
    for row in np.flatnonzero(done):
        observations[row] = last[row].copy()
    kept = {name: np.where(done, value, 0).astype(value.dtype) for name, value in costs.items()}
    told = kept | {f"_{name}": done.copy() for name in costs}
    masks = {"_final_obs": done.copy(), "_final_info": done.copy()}
    return {"final_obs": observations, "final_info": told, **masks}


class Shielded(gymnasium.Wrapper):
    """A wrapper that replaces inadmissible actions by admissible ones, whatever the policy.

    It works for any gymnasium environment. `info` reports for each step whether the policy's choice
    was replaced ("intervention"), and whether no action was admissible ("insecure"), in which case
    the least threatening one is taken.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        threat: Callable[[Any], Any],
        x: float,
        table: np.ndarray | None = None,
        state: Callable[[Any], Any] | None = None,
    ):
        """Wraps an environment with a shield, which asks for the threats before every step.

        Args:
            env: the environment; it has Discrete actions from 0 on, or with a table Box actions
                (D,).
            threat: maps a state to the threats (A,) of its actions.
            x: greatest admissible threat; infinity lets every action pass.
            table: (A, D) the continuous actions that the threats belong to.
            state: finds the state in the unwrapped environment; by default the state is the last
                observation.

        Raises:
            ValueError: the actions are not discrete and there is no table.
        """
        super().__init__(env)
        if table is not None:
            self._count = len(table)
        elif isinstance(env.action_space, gymnasium.spaces.Discrete):
            self._count = int(env.action_space.n)
        else:
            raise ValueError(
                f"env: its actions are {env.action_space}; they must be Discrete, or have a table"
            )
        self._threat, self._find, self._seen = threat, state, None
        self._table = table
        rows = None if table is None else jnp.asarray(table)
        self._correct = jax.jit(functools.partial(shield.correct, x=x, table=rows))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets the wrapped environment.

        Args:
            seed: passed on to the wrapped environment.
            options: passed on to the wrapped environment.

        Returns:
            The observation, and the wrapped environment's table.
        """
        self._seen, info = self.env.reset(seed=seed, options=options)
        return self._seen, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Makes one transition under the admissible action that comes closest to the given one.

        Args:
            action: an integer, replaced by the least threatening action; or (A,) floats, scores of
                all actions, replaced by the best admissible one; or with a table (D,) floats, a
                continuous action, replaced by the nearest admissible row.

        Returns:
            What the wrapped environment's `step` returns, with "intervention" and "insecure" in the
            table.

        Raises:
            FloatingPointError: all threats are nan, or a number of the action is.
            ValueError: there is not one threat for each action, or the action is not one of these.
        """
        state = self._seen if self._find is None else self._find(self.env.unwrapped)
        threat, wish = np.asarray(self._threat(state)), np.asarray(action)
        if threat.shape != (self._count,):
            raise ValueError(f"threat has shape {threat.shape}; it must be ({self._count},)")
        if wish.dtype.kind in "iu" and wish.ndim == 0:
            number("action", wish.item(), least=0, most=self._count - 1, integer=True)
        if np.isnan(threat).all():
            raise FloatingPointError(f"threat: all {threat.size} numbers are nan")
        if wish.dtype.kind == "f" and np.isnan(wish).any():
            raise FloatingPointError(
                f"action: {np.isnan(wish).sum()} of {wish.size} numbers are nan"
            )
        chosen = self._correct(jnp.asarray(threat), jnp.asarray(wish))
        row = int(chosen.action)
        taken = row if self._table is None else self._table[row]
        self._seen, reward, terminated, truncated, info = self.env.step(taken)
        told = {"intervention": bool(chosen.intervened), "insecure": not bool(chosen.secure)}
        return self._seen, reward, terminated, truncated, info | told


for _name in registry.ENVS:
    gymnasium.register(
        f"rp_jax/{_name.title().replace('_', '')}-v0",
        entry_point="rp_jax.adapters.gymnasium:JaxEnv",
        vector_entry_point="rp_jax.adapters.gymnasium:JaxVectorEnv",
        kwargs={"name": _name},
    )
