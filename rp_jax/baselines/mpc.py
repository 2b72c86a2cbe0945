"""Model predictive control: tree search in the true model, a few steps ahead (appendix G.4).

Agent, walls and rewards come from the environment's own step, taken without the hazards that move.
Each of these has a virtual environment of its own, stepped by its `HazardSource`: the search takes
the expectation over all that it may do, and sums the dangers of all of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.envs.base import Env
from rp_jax.planning.pmdp import PMDP, Percept
from rp_jax.validate import number

UNSAFE = 1e4  # taken off beyond the limit of danger; more than any reward within a horizon
SAME = 1e-4  # by which two ways to add up one score may differ
CHUNK = 16  # sequences of first actions tried at a time
LOTS = 0x107  # of actions that are equally good


class Model(Env, Protocol):
    """An environment that is deterministic once the hazards that move are taken out."""

    def alone(self, state: Any) -> Any:
        """`state` without the hazards that move."""


class Search(struct.PyTreeNode):
    """What is searched, and for what. Build by `make_search`."""

    params: Any  # of the environment
    penalty: Array  # () taken off the reward per unit of danger
    limit: Array  # () safe sequences, of at most this danger, come before all others
    model: Model = struct.field(pytree_node=False)
    horizon: int = struct.field(pytree_node=False)  # actions that a sequence has

    @property
    def actions(self) -> Array:
        """(A,) all of them."""
        return jnp.arange(self.model.num_actions(self.params))

    def score(self, node: "Node") -> Array:
        """() reward less penalised danger; beyond the limit, the less danger the better."""
        unsafe = jnp.where(node.danger > self.limit, UNSAFE * (1 + node.danger), 0.0)
        return node.reward - self.penalty * node.danger - unsafe


def make_search(
    model: Model, params: Any, horizon: int, penalty: float, limit: float = np.inf
) -> Search:
    """A search, checked.

    Args:
        model: the environment.
        params: of the environment.
        horizon: actions of a sequence; the work grows with num_actions^(horizon - 1).
        penalty: taken off the reward per unit of danger: 200 on Circuit, 50 on Jam.
        limit: the greatest danger of a sequence that counts as safe; inf: danger only costs.

    Raises:
        ValueError: a value is out of range.
    """
    number("horizon", horizon, least=1, most=6, integer=True)
    number("penalty", penalty, least=0)
    number("limit", limit, least=0, infinite=True)
    return Search(
        params=params,
        penalty=jnp.asarray(penalty, float),
        limit=jnp.asarray(limit, float),
        model=model,
        horizon=horizon,
    )


class Movers(NamedTuple):
    """All that each moving hazard of one kind may be doing."""

    state: Any  # leading axes (N, M): hazards, branches
    weight: Array  # (N, M) probability of the branch; 0 once it has hit


class Node(NamedTuple):
    """Where a sequence of actions leads."""

    state: Any  # of the environment, without the hazards that move
    movers: dict[str, Movers]  # by kind
    reward: Array  # () so far
    danger: Array  # () expected so far, summed over hazards
    done: Array  # () bool


def root(state: Any, search: Search) -> Node:
    """The node of the empty sequence; each moving hazard has one branch."""
    model, zero = search.model, jnp.zeros(())
    subs = model.sub_rmdps(search.params)
    movers = {
        kind: Movers(
            state=jax.tree.map(lambda a: a[:, None], group.state),
            weight=group.present[:, None].astype(zero.dtype),
        )
        for kind, group in model.hazards(state, search.params).items()
        if not subs[kind].source.static  # the environment's step knows the static ones
    }
    return Node(model.alone(state), movers, zero, zero, jnp.zeros((), bool))


def follow(node: Node, action: Array, search: Search) -> Node:
    """The node one action further; after the end, nothing is earned or risked."""
    key = jax.random.key(0)  # nothing random is left
    reached, outcome = search.model.step(key, node.state, action, search.params)
    subs = search.model.sub_rmdps(search.params)
    danger, movers = outcome.danger, {}
    for kind, group in node.movers.items():
        source = subs[kind].source
        movers[kind], hits = _branch(group, node.state.agent, reached.agent, source)
        danger = danger + hits
    return Node(
        state=reached,
        movers=movers,
        reward=node.reward + jnp.where(node.done, 0.0, outcome.reward),
        danger=node.danger + jnp.where(node.done, 0.0, danger),
        done=node.done | outcome.done,
    )


def _branch(movers: Movers, before: Any, agent: Any, source: Any) -> tuple[Movers, Array]:
    """One step of hazards, each branch splitting into the K things that it may do.

    Returns:
        The branches (N, M * K), and () the expected number of hazards that hit for the first time.
    """
    behaviour = source.behaviour

    def split(hazard: Any, weight: Array) -> tuple[Any, Array, Array]:
        def one(control: Any) -> tuple[Any, Array]:
            moved = source.step(hazard, before, control)
            return moved, source.hits(agent, moved)

        # A control moves a hazard one step later, so that all its branches hit alike.
        moved, hit = jax.vmap(one, out_axes=(0, None))(behaviour.controls)
        return moved, jnp.where(hit, 0.0, weight) * behaviour.probabilities, hit

    moved, weight, hit = jax.vmap(jax.vmap(split))(*movers)
    flat = lambda a: a.reshape(a.shape[0], -1, *a.shape[3:])  # noqa: E731
    return Movers(jax.tree.map(flat, moved), flat(weight)), jnp.sum(movers.weight * hit)


def best(node: Node, steps: int, search: Search) -> Array:
    """() score of the best of all sequences of `steps` actions that go on from a node."""
    if steps == 0:
        return search.score(node)
    return jnp.max(_by_action(node, steps, search))


def _by_action(node: Node, steps: int, search: Search) -> Array:
    # What does not depend on the last action, such as where it leads, is computed once for all.
    return jax.vmap(lambda a: best(follow(node, a, search), steps - 1, search))(search.actions)


def exhaustive(state: Any, search: Search) -> Array:
    """(A,) score of each action: that of the best sequence which it begins."""
    return _by_action(root(state, search), search.horizon, search)


def pruned(state: Any, search: Search) -> Array:
    """(A,) what `exhaustive` finds for the best actions, and no more than that for others.

    Sequences of first actions are tried in the order of what they promise (`_promises`), until
    none promises more than what has been found.
    """
    start = root(state, search)
    # Moving hazards make each look-up at the end dear; otherwise, two levels are cheap in one go.
    depth = max(1, search.horizon - (1 if start.movers else 2))
    promise = _promises(start, depth, search)
    order = jnp.argsort(-promise)
    places = len(search.actions) ** np.arange(depth)[::-1]

    def value(sequence: Array) -> Array:
        node = start
        for place in places:
            node = follow(node, sequence // place % len(search.actions), search)
        return best(node, search.horizon - depth, search)

    def promising(carry: tuple[Array, Array]) -> Array:
        tried, scores = carry
        most = promise[order[jnp.minimum(tried, len(order) - 1)]]
        worth = (most > -jnp.inf) & (most >= jnp.max(scores) - SAME)
        return (tried < len(order)) & worth

    def more(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        tried, scores = carry
        # At the end, some are tried again: the slice moves back.
        rows = jax.lax.dynamic_slice(order, (tried,), (min(CHUNK, len(order)),))
        found = jnp.where(promise[rows] > -jnp.inf, jax.vmap(value)(rows), -jnp.inf)
        return tried + CHUNK, scores.at[rows // places[0]].max(found)

    scores = jnp.full(len(search.actions), -jnp.inf)
    return jax.lax.while_loop(promising, more, (jnp.asarray(0), scores))[1]


def _promises(start: Node, depth: int, search: Search) -> Array:
    """(A^depth,) the most that each sequence of `depth` actions may lead to.

    With hazards that move: the score if all of them vanished. Without, that of a sequence which
    has ended, and infinity for others. -inf for all but one of sequences that do the same.
    """
    nodes = jax.tree.map(lambda a: a[None], start._replace(movers={}))
    fan = jax.vmap(follow, (None, 0, None))
    distinct = jnp.ones(1, bool)
    for _ in range(depth):
        fans = jax.vmap(fan, (0, None, None))(nodes, search.actions, search)
        distinct = (distinct[:, None] & jax.vmap(_distinct)(fans, nodes.done)).reshape(-1)
        nodes = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), fans)
    if start.movers:
        most = jax.vmap(lambda node: best(node, search.horizon - depth, search))(nodes)
    else:
        most = jnp.where(nodes.done, jax.vmap(search.score)(nodes), jnp.inf)
    return jnp.where(distinct, most, -jnp.inf)


def _distinct(fan: Node, ended: Array) -> Array:
    """(A,) bool, the actions without those that do what an earlier one does.

    Args:
        fan: the nodes after each action, leading axis (A,).
        ended: () bool, there is nothing to do: the first action stands for all.
    """
    leaves = [leaf.reshape(len(leaf), -1).astype(float) for leaf in jax.tree.leaves(fan)]
    rows = jnp.concatenate(leaves, axis=-1)
    alike = jnp.all(rows[:, None] == rows[None], axis=-1) | ended
    return ~jnp.any(jnp.tril(alike, -1), axis=-1)


class Seen(NamedTuple):
    """What MPC is given in the place of observations."""

    states: Any  # leading axis (B,)
    alive: Array  # (B,) bool, whether an action is needed


class Omniscient(PMDP):
    """A P-MDP for policies that are given the state itself; learners get a `PMDP`."""

    def perceive(self, states: Any, alive: Array | None = None) -> Percept:
        """As in `PMDP`, with a `Seen` for what is encoded there."""
        needed = jnp.ones(states.time.shape, bool) if alive is None else alive
        percept = super().perceive(states, alive)
        return percept._replace(encoded=Seen(states, needed))  # type: ignore[arg-type]


def omniscient(search: Search) -> Omniscient:
    """What a search is evaluated in: its environment, with nothing forbidden."""
    nothing = jnp.zeros(())
    return Omniscient(
        params=search.params,
        threats=None,
        x=jnp.asarray(jnp.inf),
        penalty=nothing,
        toll=nothing,
        env=search.model,
    )


def drawn(state: Any, scores: Array) -> Array:
    """(A,) 0, but for the best of the scores: positive numbers in a random order.

    Equal scores are frequent, and the first actions of a table have much in common. The lots are
    drawn from the state, so that a search has no key.
    """
    place = jax.lax.bitcast_convert_type(state.agent.position.astype(jnp.float32), jnp.uint32)
    key = jax.random.key(LOTS)
    for part in (state.time, *place):
        key = jax.random.fold_in(key, part)
    lots = jax.random.uniform(key, scores.shape, scores.dtype, minval=0.5)
    return jnp.where(scores >= jnp.max(scores) - SAME, lots, 0.0)


def values(search: Search) -> Callable[[Percept], Array]:
    """Prefers (B, A) the best actions, for `evaluate.run_episodes` with an `Omniscient`.

    States are searched one after another: memory is that of one, and none waits for a harder one.
    """
    count = len(search.actions)

    def one(row: tuple[Any, Array]) -> Array:
        state, alive = row
        search_it = lambda: drawn(state, pruned(state, search))  # noqa: E731
        return jax.lax.cond(alive, search_it, lambda: jnp.zeros(count))

    return lambda percept: jax.lax.map(one, tuple(percept.encoded))
