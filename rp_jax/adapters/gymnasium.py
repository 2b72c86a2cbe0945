"""Environments for gymnasium, single and batched, and the shield for any gymnasium environment.

Importing this module registers every environment: `gymnasium.make("rp_jax/Jam-v0")`, and
`gymnasium.make_vec("rp_jax/Jam-v0", num_envs=1024)` for a batch in one compiled program.
"""

import dataclasses
import functools
import inspect
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from rp_jax import shield
from rp_jax.adapters import registry
from rp_jax.arrays import select
from rp_jax.envs import autoreset, optional
from rp_jax.envs.contract import Env
from rp_jax.validate import number, positive

try:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.utils import RecordConstructorArgs, seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(
        "rp_jax.adapters.gymnasium needs gymnasium 1.1 or newer (pip install 'rp_jax[gymnasium]')"
    ) from error

DTYPE = np.float32  # of observations and rewards, whatever precision JAX computes in
UNLIMITED = 10**9  # time limit of a single environment: `gymnasium.make` sets one around it

Spaces = tuple[gymnasium.spaces.Box, gymnasium.spaces.Discrete]


def _spaces(env: Env, params: Any) -> Spaces:
    """Returns the spaces of observations and actions.

    LIDAR values are in [0, 1], all others within what the longest episode can come to: angles are
    not wrapped, and change by less than 1 a step.
    """
    bins = optional.lidar_bins(env)
    sizes = bins, optional.observation_size(env, params) - bins
    low, high = (
        np.repeat(np.asarray(ends, DTYPE), sizes) for ends in ((0, -UNLIMITED), (1, UNLIMITED))
    )
    return gymnasium.spaces.Box(low, high, dtype=DTYPE), gymnasium.spaces.Discrete(
        optional.num_actions(env, params)
    )


class _World:
    """An environment of a registered name with its parameters, and what gymnasium asks of both.

    Copies share the environment, which is a module and cannot be copied.
    """

    # The process in which an environment was last made, and the spaces of those made in it.
    process: int | None = None
    spaces_of: dict[tuple[str, str], Spaces] = {}  # noqa: RUF012 (shared on purpose)

    def __init__(self, name: str, settings: dict[str, Any]):
        """Makes the parameters; in a process that was forked from one that did, only the spaces.

        Args:
            name: a name in `registry.ENVS`.
            settings: settings of the environment's `make_params`.

        Raises:
            ValueError: the name is not registered, or a setting is out of range.
        """
        self.name, known = name, (name, repr(sorted(settings.items())))
        self.forked = _World.process not in (None, os.getpid())
        if self.forked:
            # JAX would wait for threads that a fork does not copy. The error comes with the first
            # reset: gymnasium's workers report it from there.
            if known not in self.spaces_of:
                self.refuse_fork()
            self.spaces = self.spaces_of[known]
            return
        env, self.params = registry.make(name, **settings)
        _World.process = os.getpid()
        self.spaces = self.spaces_of[known] = _spaces(env, self.params)

    @property
    def env(self) -> Env:
        """The environment."""
        return registry.ENVS[self.name]

    def refuse_fork(self) -> None:
        """Raises RuntimeError: JAX cannot run here.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(
            f"{self.name}: this process was forked from one that uses JAX, in which JAX cannot run;"
            " start workers anew, by vector_kwargs={'context': 'spawn'} in gymnasium.make_vec, or"
            " let one compiled program step the batch, by leaving vectorization_mode out"
        )


def _limited(
    settings: dict[str, Any], render_mode: str | None, max_episode_steps: int | None
) -> dict[str, Any]:
    """Returns the settings with the shorter of the two time limits.

    Raises:
        ValueError: the limit is not a positive integer, or there is a render mode.
    """
    if render_mode is not None:
        raise ValueError(f"render_mode is {render_mode!r}; it must be None: there is no picture")
    if max_episode_steps is None:
        return settings
    most = positive("max_episode_steps", max_episode_steps, most=UNLIMITED, integer=True)
    return settings | {"time_limit": min(int(most), settings.get("time_limit", most))}


def _limit_told(spec: EnvSpec | None, limit: int) -> EnvSpec | None:
    """Returns a specification that tells a time limit, if it is one."""
    if spec is None or limit >= UNLIMITED:
        return spec
    return dataclasses.replace(spec, max_episode_steps=limit)


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
def _start_all(
    env: Env, key: jax.Array, count: int, seeds: Any, states: Any, mask: Any, params: Any
) -> tuple:
    """Returns the next key, new starts (count,), and their observations.

    Args:
        env: the environment.
        key: random key.
        count: number of rows.
        seeds: (count,) of the rows' starts; None: they come from the key.
        states: (count,) those that stay where the mask is False; None without a mask.
        mask: (count,) bool, or None.
        params: the environment's parameters.
    """
    key, now = jax.random.split(key)
    keys = jax.random.split(now, count) if seeds is None else jax.vmap(jax.random.key)(seeds)
    begun = jax.vmap(env.reset, (0, None))(keys, params)
    if mask is not None:
        begun = jax.vmap(select)(mask, begun, states)
    return key, begun, jax.vmap(env.observe, (0, None))(begun, params)


def _seeds(seeds: Any, count: int) -> list[int | None]:
    """Returns a list of seeds, checked.

    Raises:
        ValueError: there is not one for each environment, or one is neither None nor a seed.
    """
    if len(seeds) != count:
        raise ValueError(f"seed has {len(seeds)} entries; there must be one for each of {count}")
    found: list[int | None] = []
    for one in seeds:
        if one is not None:
            number("seed", one, least=0, most=2**32 - 1, integer=True)
        found.append(None if one is None else int(one))
    return found


def _mask(options: dict[str, Any] | None, count: int) -> np.ndarray | None:
    """Returns which environments begin anew; None: all.

    Raises:
        ValueError: the mask is not (count,) bool, or marks none.
    """
    if not options or options.get("reset_mask") is None:
        return None
    mask = np.asarray(options["reset_mask"])
    if mask.shape != (count,) or mask.dtype != bool or not mask.any():
        raise ValueError(
            f"options: reset_mask is {mask.dtype} of shape {mask.shape} with {int(mask.sum())} "
            f"marked; it must be bool of shape ({count},) with at least one"
        )
    return mask


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

    def __init__(
        self,
        name: str,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **settings: Any,
    ):
        """Makes an environment from its registered name.

        Args:
            name: a name in `registry.ENVS`.
            render_mode: must be None.
            max_episode_steps: steps of an episode. By default, and without the setting
                `time_limit`, episodes only end by themselves: `gymnasium.make` limits them from
                outside.
            **settings: settings of the environment's `make_params`.

        Raises:
            ValueError: the name is not registered, or a setting is out of range.
        """
        settings = {"time_limit": UNLIMITED} | settings
        self._world = _World(name, _limited(settings, render_mode, max_episode_steps))
        self.observation_space, self.action_space = self._world.spaces
        self.state: Any = None
        self.render_mode = render_mode

    @property
    def env(self) -> Env:
        """The environment of this library that is wrapped."""
        return self._world.env

    @property
    def params(self) -> Any:
        """The environment's parameters."""
        return self._world.params

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
        if self._world.forked:
            self._world.refuse_fork()
        super().reset(seed=seed)
        self._key, self.state, seen = _start(self.env, _key(self), self.params)
        return np.array(seen, DTYPE), {}

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
        return np.array(seen, DTYPE), float(outcome.reward), *ended, info


class JaxVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batch of environments in one program, with new starts in the step that ends an episode.

    `info` describes what the step itself led to: "cost" and "goal" of every row, and for rows whose
    episode ended the last observation as "final_obs", and cost and goal again as "final_info".
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        name: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **settings: Any,
    ):
        """Makes a batch of environments from their registered name.

        Args:
            name: a name in `registry.ENVS`.
            num_envs: number of environments.
            render_mode: must be None.
            max_episode_steps: steps of an episode; the setting `time_limit` counts where it is
                shorter.
            **settings: settings of the environment's `make_params`.

        Raises:
            ValueError: the name is not registered, or a setting is out of range.
        """
        self.num_envs = int(positive("num_envs", num_envs, integer=True))
        self._world = _World(name, _limited(settings, render_mode, max_episode_steps))
        if self._world.forked:
            self._world.refuse_fork()
        self.single_observation_space, self.single_action_space = self._world.spaces
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.states: Any = None
        self.render_mode = render_mode

    @property
    def env(self) -> Env:
        """The environment of this library that is wrapped."""
        return self._world.env

    @property
    def params(self) -> Any:
        """The environment's parameters."""
        return self._world.params

    @property
    def spec(self) -> EnvSpec | None:
        """What gymnasium can make the same batch from again; it tells the time limit."""
        return _limit_told(self._spec, int(self.params.time_limit))

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Keeps what gymnasium made the batch from.

        Args:
            spec: as `gymnasium.make_vec` sets it.
        """
        self._spec = spec

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws new starts.

        Args:
            seed: makes these starts and all that follows reproducible. A list has one seed for each
                environment, which its start alone depends on.
            options: "reset_mask" (num_envs,) bool marks the environments that begin anew; the
                others stay as they are. Everything else is ignored.

        Returns:
            The observations (num_envs, n), and an empty table.

        Raises:
            ValueError: the list of seeds, or the mask, does not fit.
            gymnasium.error.ResetNeeded: a mask is given before there are states.
        """
        mask = _mask(options, self.num_envs)
        if mask is not None and self.states is None:
            raise gymnasium.error.ResetNeeded("options: reset_mask is given before the first reset")
        keys = None
        if seed is None or isinstance(seed, int):
            super().reset(seed=seed)
        else:
            seeds = _seeds(seed, self.num_envs)
            super().reset(seed=None)
            given = [one for one in seeds if one is not None]
            if len(given) == len(seeds):
                # Tuples of integers have the same hash everywhere.
                self._np_random, self._np_random_seed = seeding.np_random(abs(hash(tuple(given))))
            drawn = self.np_random.integers(2**31, size=self.num_envs)
            chosen = [d if one is None else one for one, d in zip(seeds, drawn, strict=True)]
            keys = np.asarray(chosen, np.uint32)
        before = None if mask is None else self.states
        args = self.env, _key(self), self.num_envs, keys, before, mask, self.params
        self._key, self.states, seen = _start_all(*args)
        return np.array(seen, DTYPE), {}

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
            info |= _final(np.asarray(last, DTYPE), costs, done)
        return np.array(seen, DTYPE), np.array(outcome.reward, DTYPE), *ended, info


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


class Shielded(gymnasium.Wrapper, RecordConstructorArgs):
    """A wrapper that replaces inadmissible actions by admissible ones, whatever the policy.

    It works for any gymnasium environment. `info` reports for each step whether the policy's choice
    was replaced ("intervention"), and whether no action was admissible ("insecure"), in which case
    the least threatening one is taken.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        threat: Callable[[Any], Any],
        x: float | None = None,
        table: np.ndarray | None = None,
        state: Callable[[Any], Any] | None = None,
        c: float | None = None,
    ):
        """Wraps an environment with a shield, which asks for the threats before every step.

        Args:
            env: the environment; it has Discrete actions, or with a table Box actions (D,).
            threat: maps a state to the threats (A,) of its actions.
            x: greatest admissible threat; infinity lets every action pass. Beside c a cap.
            table: (A, D) the continuous actions that the threats belong to.
            state: finds the state in the unwrapped environment; by default the state is the last
                observation.
            c: danger that an episode may have, in place of x. Each action costs what its threat
                exceeds the least threat by, and what is left of c decides (docs/budgets.md).

        Raises:
            ValueError: neither x nor c is given, or one is not a number; the actions are not
                discrete and there is no table, or the table does not fit them.
        """
        RecordConstructorArgs.__init__(
            self, threat=threat, x=x, table=table, state=state, c=c, _disable_deepcopy=True
        )
        super().__init__(env)
        if x is None and c is None:
            raise ValueError("x is None, and so is c; one of them must be given")
        self._x = np.float64(np.inf if x is None else number("x", x, infinite=True))
        self._promised = None if c is None else number("c", c, above=0)
        self._budget: float | None = None  # what may still be spent; None: before the first step
        for name, function in (("threat", threat), ("state", state)):
            if not (callable(function) or (name == "state" and function is None)):
                raise ValueError(f"{name} is {function!r}; it must be a function")
        self._first, space = 0, env.action_space
        if table is not None:
            table = np.asarray(table, np.float64)
            fits = isinstance(space, gymnasium.spaces.Box) and table.shape[1:] == space.shape
            if not fits or len(table) == 0 or not np.isfinite(table).all():
                raise ValueError(
                    f"table has shape {table.shape}; its rows must be finite actions of {space}"
                )
            self._count = len(table)
        elif isinstance(space, gymnasium.spaces.Discrete):
            self._count, self._first = int(space.n), int(space.start)
        else:
            raise ValueError(
                f"env: its actions are {space}; they must be Discrete, or have a table"
            )
        self._threat, self._find, self._seen = threat, state, None
        self._table = table

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
        self._budget = None
        return self._seen, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Makes one transition under the admissible action that comes closest to the given one.

        Args:
            action: an integer, replaced by the least threatening action; or (A,) floats, scores of
                all actions, replaced by the best admissible one; or with a table (D,) floats, a
                continuous action, replaced by the nearest admissible row.

        Returns:
            What the wrapped environment's `step` returns, with "intervention" and "insecure" in the
            table, and with "budget", what is left of c, where c is given.

        Raises:
            FloatingPointError: all threats are nan, or a number of the action is.
            ValueError: there is not one threat for each action, or the action is not one of these.
            gymnasium.error.ResetNeeded: `reset` was never called.
        """
        _reset_first(self._seen)
        state = self._seen if self._find is None else self._find(self.env.unwrapped)
        threat, wish = np.asarray(self._threat(state), np.float64), np.asarray(action)
        if threat.shape != (self._count,):
            raise ValueError(f"threat has shape {threat.shape}; it must be ({self._count},)")
        if wish.dtype.kind in "iu" and wish.ndim == 0:
            last = self._first + self._count - 1
            number("action", wish.item(), least=self._first, most=last, integer=True)
            wish = wish - self._first
        if np.isnan(threat).all():
            raise FloatingPointError(f"threat: all {threat.size} numbers are nan")
        if wish.dtype.kind == "f" and np.isnan(wish).any():
            raise FloatingPointError(
                f"action: {np.isnan(wish).sum()} of {wish.size} numbers are nan"
            )
        with jax.enable_x64(True):  # narrowed threats could fall below x
            chosen = _correct(threat, wish, self._threshold(threat), self._table)
        row = int(chosen.action)
        taken = row + self._first if self._table is None else self._row(row)
        self._seen, reward, terminated, truncated, info = self.env.step(taken)
        told = {"intervention": bool(chosen.intervened), "insecure": not bool(chosen.secure)}
        if self._budget is not None:
            told["budget"] = self._budget = max(0.0, self._budget - threat[row] + np.nanmin(threat))
        return self._seen, reward, terminated, truncated, info | told

    def _threshold(self, threat: np.ndarray) -> np.float64:
        """Returns the greatest admissible threat, by x and by what is left of c."""
        if self._promised is None:
            return self._x
        least = np.nanmin(threat)
        if self._budget is None:
            self._budget = float(self._promised - least)
        return np.minimum(self._x, self._budget + least)

    def _row(self, row: int) -> np.ndarray:
        """Returns a row of the table as the environment takes it."""
        assert self._table is not None
        return self._table[row].astype(self.env.action_space.dtype)


_correct = jax.jit(shield.correct)

for _name, _env in registry.ENVS.items():
    gymnasium.register(
        f"rp_jax/{_name.title().replace('_', '')}-v0",
        entry_point="rp_jax.adapters.gymnasium:JaxEnv",
        vector_entry_point="rp_jax.adapters.gymnasium:JaxVectorEnv",
        max_episode_steps=inspect.signature(_env.make_params).parameters["time_limit"].default,
        kwargs={"name": _name},
    )
