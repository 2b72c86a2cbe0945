"""An environment on trial: its functions, compiled, and the steps that all checks share."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.dynamics import Plans
from rp_jax.envs import autoreset, optional
from rp_jax.envs.check.batches import (
    BATCH,
    Batched,
    RandomDraws,
    frozen,
    is_key,
    join,
    take,
    thawed,
    typed,
)
from rp_jax.envs.check.contacts import Contact, contacts
from rp_jax.envs.check.pairs import Pairs

STEPS = 64  # of each row, at most
PLACES = 64 * BATCH  # states with another body that are looked at, at most
MEMORY = 100e6  # bytes of the states that are held at a time, about
HELD = 0.95  # chance that a row that holds its actions takes the last one once more


class Steps(struct.PyTreeNode):
    """Steps of an environment, leading axis (n,); random keys are held as their data."""

    keys: Any  # of `auto_reset_step`
    before: Any  # states
    action: Any  # int32
    carried: Any  # states to go on from
    reached: Any  # states the steps led to
    outcome: Any
    modelled: Any  # bodies, from the body's model
    infinite: Any  # int32 index of the first observed value that is not finite, else -1
    scan: Any  # int32 index of the first LIDAR value outside [0, 1], else -1
    contacts: dict[str, Contact]  # by kind
    collisions: dict[str, Any]  # by kind; empty if the environment does not tell
    clearance: Any  # () under plans, else 0


def replaced(tree: Any, **fields: Any) -> Any:
    """Returns a state with other values of some fields.

    Args:
        tree: the state, a dataclass or a named tuple.
        **fields: the values, by name; what is no field, but computed from others, stays.
    """
    own = set(getattr(tree, "_fields", ()))
    if dataclasses.is_dataclass(tree):
        own |= {field.name for field in dataclasses.fields(tree)}
    fields = {name: value for name, value in fields.items() if name in own or not own}
    if hasattr(tree, "replace"):
        return tree.replace(**fields)
    if hasattr(tree, "_replace"):
        return tree._replace(**fields)
    return dataclasses.replace(tree, **fields)


class Trial:
    """An environment with its functions compiled; steps are made when a check asks for them."""

    def __init__(self, env: Any, params: Any, seed: int) -> None:
        """Takes an environment that fulfils the structure of the contract.

        Args:
            env: the environment.
            params: its parameters.
            seed: of all random numbers.
        """
        self.env, self.params = env, params
        key = jax.random.key(seed)
        self.draws = RandomDraws(key)
        self.num_actions = int(optional.num_actions(env, params))
        self.limit = int(params.time_limit)
        self.model = params.body
        self.plans = isinstance(params.body.baseline, Plans)
        self.pairs = {
            kind: Pairs(env, params, kind, self.draws) for kind in sorted(env.sub_rmdps(params))
        }
        self._example = jax.eval_shape(env.reset, key, params)
        if any(is_key(leaf) for leaf in jax.tree.leaves(self._example)):
            self._example = env.reset(key, params)
        self.start = Batched(lambda params, key: env.reset(typed(key), params))
        self.find = Batched(lambda params, state: env.hazards(self.thaw(state), params))
        self.find_moving = Batched(self._moving)
        self.move = Batched(_move)
        self._control = Batched(_planned)
        self._advance = Batched(self._look, whole=True)

    def thaw(self, state: Any) -> Any:
        """Returns a state with typed random keys in place of their data.

        Args:
            state: with the data of its keys.
        """
        return thawed(state, self._example)

    def _moving(self, params: Any, state: Any) -> dict[str, Any]:
        """The hazards of the kinds that are not static."""
        groups = self.env.hazards(self.thaw(state), params)
        return {kind: group for kind, group in groups.items() if not self.pairs[kind].static}

    def at_most(self, rows: int) -> int:
        """Returns how many of some rows of states fit into the memory, at least 1.

        Args:
            rows: how many are wanted.
        """
        leaves = jax.tree.leaves(jax.eval_shape(frozen, self._example))
        size = sum(leaf.dtype.itemsize * leaf.size for leaf in leaves)
        return int(np.clip(MEMORY / max(size, 1), 1, rows))

    def _look(self, params: Any, keys: Any, states: Any, actions: Any) -> Steps:
        env, before = self.env, self.thaw(states)
        carried, reached, outcome = autoreset.auto_reset_step(
            env, typed(keys), before, actions, params
        )

        def row(before: Any, action: Array, reached: Any) -> tuple[Any, ...]:
            seen = env.observe(reached, params)
            bad = _first(~jnp.isfinite(seen))
            scan = seen[: optional.lidar_bins(env)]
            odd = _first((scan < 0) | (scan > 1))
            told = env.collisions(reached, params) if hasattr(env, "collisions") else {}
            left = jnp.zeros(())
            if self.plans:
                left = env.clearance(reached.body.position, params)
            moved = params.body.step(before.body, params.body.control(action))
            return moved, bad, odd, contacts(env, before, reached, params), told, left

        modelled, infinite, scan, met, told, left = jax.vmap(row)(before, actions, reached)
        return Steps(
            keys=keys,
            before=states,
            action=actions,
            carried=frozen(carried),
            reached=frozen(reached),
            outcome=outcome,
            modelled=modelled,
            infinite=infinite,
            scan=scan,
            contacts=met,
            collisions=told,
            clearance=left,
        )

    def advance(self, states: Any, actions: np.ndarray) -> Steps:
        """Makes a step from each state (n, ...) under an action each (n,).

        Args:
            states: leading axis (n,).
            actions: (n,) indices.
        """
        return self._advance(self.params, self.draws.keys(len(actions)), states, actions)

    def away(self, bodies: Any, actions: Any, k: int = -1, choice: Any = None) -> Any:
        """Returns where the body's model takes bodies (n, ...) in a step.

        Args:
            bodies: where they are.
            actions: (n,) taken where k is -1.
            k: step of the baseline policy that is taken instead, counted after the first action.
            choice: (n,) in [0, 1), which of several plans is followed; the same for all k.
        """
        count = len(actions)
        choice = np.zeros(count) if choice is None else choice
        steps, keys = np.full(count, k, np.int32), self.draws.keys(count)
        return self.move(self.params, bodies, actions, steps, keys, choice.astype(np.float32))

    def control(self, bodies: Any, k: int, choice: np.ndarray) -> Any:
        """Returns the controls of plans in bodies (n, ...).

        Args:
            bodies: where they are.
            k: step of the plan, counted after the first action.
            choice: (n,) in [0, 1), which of several plans is followed.
        """
        steps = np.full(len(choice), k, np.int32)
        return self._control(self.params, bodies, steps, choice.astype(np.float32))

    @functools.cached_property
    def steps(self) -> Steps:
        """Steps of episodes in which a third of the rows acts at random, and others hold actions.

        Some rows begin shortly before the time limit, and some after it.
        """
        draws = self.draws
        states = self.start(self.params, draws.keys(BATCH))
        steps = max(4, self.at_most(STEPS * BATCH) // BATCH)
        rows = np.arange(BATCH)
        late = self.limit - 1 - rows // 4 % steps
        time = np.where(rows % 4 == 1, np.maximum(late, 0), np.asarray(states.time))
        time = np.where(rows % 16 == 3, self.limit + 2, time).astype(states.time.dtype)
        states, made = replaced(states, time=time), []
        actions = draws.integers(BATCH, self.num_actions)
        for _ in range(steps):
            made.append(self.advance(states, actions))
            states = made[-1].carried
            held = (draws.uniform(BATCH) < HELD) & (rows % 3 > 0)
            actions = np.where(held, actions, draws.integers(BATCH, self.num_actions))
        return join(*made)

    @functools.cached_property
    def placed(self) -> Steps:
        """Steps from visited states in which the body is where it was in another visited state.

        Most of them are chosen so that the body would hit a hazard that stands still; a third are
        the last before the time limit.
        """
        steps, draws = self.steps, self.draws
        count, places = len(steps.action), self.at_most(PLACES)
        where, whose = (draws.integers(places, count) for _ in range(2))
        states = replaced(take(steps.before, where), body=take(steps.before.body, whose))
        met = self._meets(self.params, states, take(steps.modelled, whose))
        chosen = [draws.among(np.arange(places), 4 * BATCH)]
        for hits in met.values():
            if hits.any():
                chosen.append(draws.among(np.flatnonzero(hits), 4 * BATCH))
        rows = np.concatenate(chosen)
        states, last = take(states, rows), np.arange(len(rows)) % 3 == 0
        time = np.where(last, self.limit - 1, states.time).astype(states.time.dtype)
        return self.advance(replaced(states, time=time), take(steps.action, whose[rows]))

    @functools.cached_property
    def _meets(self) -> Batched:
        """Whether bodies (n, ...) hit a hazard, by kind, that is present in states (n, ...)."""

        def row(params: Any, state: Any, body: Any) -> dict[str, Array]:
            subs, met = self.env.sub_rmdps(params), {}
            for kind, group in self.env.hazards(self.thaw(state), params).items():
                hits = jax.vmap(subs[kind].source.hits, (None, 0))(body, group.state)
                met[kind] = jnp.any(hits & group.present)
            return met

        return Batched(row)

    def visited(self, kind: str, count: int) -> tuple[Any, Any]:
        """Returns pairs of a body and a hazard that was present in a visited state.

        Args:
            kind: of hazard.
            count: of pairs; there are none if no hazard of the kind was present.
        """
        steps, draws = self.steps, self.draws
        rows = draws.among(np.arange(len(steps.action)), BATCH)
        group = self.find(self.params, take(steps.before, rows))[kind]
        where, which = np.nonzero(group.present)
        if len(where):
            chosen = draws.among(np.arange(len(where)), count)
            where, which = where[chosen], which[chosen]
        hazards = jax.tree.map(lambda a: a[where, which], group.state)
        return take(steps.before.body, rows[where]), hazards


def _first(bad: Array) -> Array:
    """Returns the index of the first true value, () int32; -1 if there is none."""
    if not bad.shape[0]:
        return jnp.full((), -1, jnp.int32)
    return jnp.where(jnp.any(bad), jnp.argmax(bad), -1).astype(jnp.int32)


def _move(params: Any, body: Any, action: Array, k: Array, key: Any, choice: Array) -> Any:
    """A step of the body's model under an action (k < 0), or step k of the baseline policy."""
    model = params.body
    control = model.control(action)
    if isinstance(model.baseline, Plans):
        other = _planned(params, body, k, choice)
    else:
        other = model.baseline.act(body, model.baseline.draw(typed(key)))
    chosen = jax.tree.map(lambda a, b: jnp.where(k < 0, a, b), control, other)
    return model.step(body, chosen)


def _planned(params: Any, body: Any, k: Array, choice: Array) -> Any:
    """Returns the control of step k of one of several plans."""
    plans = params.body.baseline
    index = (choice * len(plans.target)).astype(jnp.int32)
    rows = {name: getattr(plans, name)[index] for name in ("rotation", "target", "steps")}
    return plans.replace(**rows).control(k, body.speed)
