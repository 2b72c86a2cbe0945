"""Model predictive control: tree search in the true model, a few steps ahead (appendix G.4).

The agent's body, walls and rewards come from the environment's own step, without the hazards that
move. Each of these is simulated apart by its `HazardSource`: the search takes the expectation over
everything that it may do, and sums the dangers of all of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.copies import parts
from rp_jax.envs import optional
from rp_jax.envs.contract import Env
from rp_jax.hazards import is_static
from rp_jax.planning.percept import Percept
from rp_jax.planning.pmdp import PMDP
from rp_jax.shield import threshold_array
from rp_jax.streams import STATES, Stream, key_of
from rp_jax.validate import number, shown

UNSAFE = 1e4  # subtracted above the limit of danger; more than any reward within a horizon
SAME = 1e-4  # scores that differ by less are equal up to rounding
CHUNK = 16  # number of sequences of first actions tried at a time


class Model(Env, Protocol):
    """An environment that is deterministic without its moving hazards.

    The source of each kind that moves has `behaviour`, the `ControlDistribution` whose controls its
    `step` takes as noise.
    """

    def without_moving_hazards(self, state: Any) -> Any:
        """Returns a state without the hazards that move.

        Args:
            state: any state.
        """


class Search(struct.PyTreeNode):
    """The model and the settings of a search; to be built by `make_search`."""

    params: Any  # the environment's parameters
    penalty: Array  # () subtracted from the reward per unit of danger
    limit: Array  # () sequences of at most this danger are safe and come before all others
    model: Model = struct.field(pytree_node=False)  # the environment
    horizon: int = struct.field(pytree_node=False)  # number of actions of a sequence

    __reduce__ = parts

    @property
    def actions(self) -> Array:
        """All actions, (A,) int."""
        return jnp.arange(optional.num_actions(self.model, self.params))

    def score(self, node: "Node") -> Array:
        """Returns a node's reward less its penalised danger.

        Above the limit, less danger is always better.

        Args:
            node: the end of a sequence.

        Returns:
            ().
        """
        unsafe = jnp.where(node.danger > self.limit, UNSAFE * (1 + node.danger), 0.0)
        return node.reward - self.penalty * node.danger - unsafe


def make_search(
    model: Model, params: Any, horizon: int, penalty: float, limit: float = np.inf
) -> Search:
    """Returns a search, checked.

    Args:
        model: the environment.
        params: the environment's parameters.
        horizon: number of actions of a sequence; the work grows with num_actions^(horizon - 1).
        penalty: subtracted from the reward per unit of danger: 200 on Circuit, 50 on Jam.
        limit: greatest danger of a sequence that counts as safe; with infinity danger only costs.

    Raises:
        ValueError: a value is out of range, or the model lacks what the search needs.
    """
    if not hasattr(model, "without_moving_hazards"):
        raise ValueError(
            f"model is {shown(model)}; it must have without_moving_hazards(state), which returns "
            "the state without the hazards that move"
        )
    for kind, sub in model.sub_rmdps(params).items():
        if not (is_static(sub.source) or hasattr(sub.source, "behaviour")):
            raise ValueError(
                f"source of {kind!r} has no `behaviour`; it must have one, the ControlDistribution "
                "whose controls its `step` takes as noise: the search follows each of them"
            )
    number("horizon", horizon, least=1, most=6, integer=True)
    number("penalty", penalty, least=0)
    number("limit", limit, least=0, infinite=True)
    return Search(
        params=params,
        penalty=jnp.asarray(penalty, float),
        limit=threshold_array(limit),
        model=model,
        horizon=horizon,
    )


class Movers(NamedTuple):
    """All that each moving hazard of one kind may be doing."""

    state: Any  # states of the hazards, leading axes (N, M): hazards, branches
    weight: Array  # (N, M) probability of the branch; 0 once it has hit


class Node(NamedTuple):
    """The situation that a sequence of actions leads to."""

    state: Any  # the environment's state, without the hazards that move
    movers: dict[str, Movers]  # the moving hazards by kind
    reward: Array  # () reward so far
    danger: Array  # () expected danger so far, summed over hazards
    done: Array  # () bool, the episode has ended


def root(state: Any, search: Search) -> Node:
    """Returns the node of the empty sequence, in which each moving hazard has one branch.

    Args:
        state: the environment's state.
        search: the model and the settings.
    """
    model, zero = search.model, jnp.zeros(())
    subs = model.sub_rmdps(search.params)
    movers = {
        kind: Movers(
            state=jax.tree.map(lambda a: a[:, None], group.state),
            weight=group.present[:, None].astype(zero.dtype),
        )
        for kind, group in model.hazards(state, search.params).items()
        if not is_static(subs[kind].source)  # the environment's own step includes the static ones
    }
    return Node(model.without_moving_hazards(state), movers, zero, zero, jnp.zeros((), bool))


def follow(node: Node, action: Array, search: Search) -> Node:
    """Returns the node one action further; after the end, nothing is earned or risked.

    Args:
        node: where the action is taken.
        action: () int.
        search: the model and the settings.
    """
    key = jax.random.key(0)  # nothing random is left
    reached, outcome = search.model.step(key, node.state, action, search.params)
    subs = search.model.sub_rmdps(search.params)
    danger, movers = outcome.danger, {}
    for kind, group in node.movers.items():
        source = subs[kind].source
        movers[kind], hits = _branch(group, node.state.body, reached.body, source)
        danger = danger + hits
    return Node(
        state=reached,
        movers=movers,
        reward=node.reward + jnp.where(node.done, 0.0, outcome.reward),
        danger=node.danger + jnp.where(node.done, 0.0, danger),
        done=node.done | outcome.done,
    )


def _branch(movers: Movers, before: Any, body: Any, source: Any) -> tuple[Movers, Array]:
    """Moves hazards by one step; each branch splits into the K things that its hazard may do.

    Args:
        movers: the hazards of one kind.
        before: the body's state before the step.
        body: the body's state after the step.
        source: the kind of hazard.

    Returns:
        The branches (N, M * K), and the expected number of hazards that hit for the first time, ().
    """
    behaviour = source.behaviour

    def split(hazard: Any, weight: Array) -> tuple[Any, Array, Array]:
        def one(control: Any) -> tuple[Any, Array]:
            moved = source.step(hazard, before, control)
            return moved, source.hits(body, moved)

        # A control moves a hazard only one step later, so that its branches all hit, or none does.
        moved, hit = jax.vmap(one, out_axes=(0, None))(behaviour.controls)
        return moved, jnp.where(hit, 0.0, weight) * behaviour.probabilities, hit

    moved, weight, hit = jax.vmap(jax.vmap(split))(*movers)
    flat = lambda a: a.reshape(a.shape[0], -1, *a.shape[3:])  # noqa: E731
    return Movers(jax.tree.map(flat, moved), flat(weight)), jnp.sum(movers.weight * hit)


def best(node: Node, steps: int, search: Search) -> Array:
    """Returns the score of the best continuation of a node, ().

    Args:
        node: where the continuation begins.
        steps: number of its actions.
        search: the model and the settings.
    """
    if steps == 0:
        return search.score(node)
    return jnp.max(_by_action(node, steps, search))


def _by_action(node: Node, steps: int, search: Search) -> Array:
    # What does not depend on the last action (as the next position does not) is computed only once.
    return jax.vmap(lambda a: best(follow(node, a, search), steps - 1, search))(search.actions)


def exhaustive(state: Any, search: Search) -> Array:
    """Returns the score of each action, (A,): that of the best sequence that begins with it.

    Args:
        state: the environment's state.
        search: the model and the settings.
    """
    return _by_action(root(state, search), search.horizon, search)


def pruned(state: Any, search: Search) -> Array:
    """Returns the scores of `exhaustive` for the best actions, and lower bounds of them for others.

    Sequences of first actions are tried in the order of their upper bounds, until no bound exceeds
    the best score found.

    Args:
        state: the environment's state.
        search: the model and the settings.

    Returns:
        (A,); minus infinity for actions that were not tried.
    """
    start = root(state, search)
    # With moving hazards each last step is expensive; otherwise two levels at once are cheap.
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
        # The last slice moves back, so that some sequences are tried twice.
        rows = jax.lax.dynamic_slice(order, (tried,), (min(CHUNK, len(order)),))
        found = jnp.where(promise[rows] > -jnp.inf, jax.vmap(value)(rows), -jnp.inf)
        return tried + CHUNK, scores.at[rows // places[0]].max(found)

    scores = jnp.full(len(search.actions), -jnp.inf)
    return jax.lax.while_loop(promising, more, (jnp.asarray(0), scores))[1]


def _promises(start: Node, depth: int, search: Search) -> Array:
    """Returns an upper bound of the score of each sequence of `depth` first actions, (A^depth,).

    With moving hazards it is the score as if all of them vanished. Without, it is the score itself
    for sequences that have ended, and infinity for others. Of sequences that do the same, all but
    one get minus infinity.
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
    """Returns which actions do not merely repeat an earlier one, (A,) bool.

    Args:
        fan: the nodes after each action, leading axis (A,).
        ended: () bool, the episode has ended: the first action stands for all.
    """
    leaves = [leaf.reshape(len(leaf), -1).astype(float) for leaf in jax.tree.leaves(fan)]
    rows = jnp.concatenate(leaves, axis=-1)
    alike = jnp.all(rows[:, None] == rows[None], axis=-1) | ended
    return ~jnp.any(jnp.tril(alike, -1), axis=-1)


class TrueState(NamedTuple):
    """The observation that MPC gets: the state itself."""

    states: Any  # states of the environment, leading axis (B,)
    alive: Array  # (B,) bool, an action is needed


class Omniscient(PMDP):
    """A P-MDP for policies that observe the state itself; learners get a `PMDP`."""

    def perceive(self, states: Any, alive: Array | None = None) -> Percept:
        """Returns the percept of a `PMDP`, with a `TrueState` in place of the observation.

        Args:
            states: states, leading axis (B,).
            alive: (B,) bool; where it is False, no action is needed.
        """
        needed = jnp.ones(states.time.shape, bool) if alive is None else alive
        percept = super().perceive(states, alive)
        return percept._replace(encoded=TrueState(states, needed))  # type: ignore[arg-type]


def omniscient(search: Search) -> Omniscient:
    """Returns the P-MDP to evaluate a search in: its environment, with all actions admissible.

    Args:
        search: the model and the settings.
    """
    nothing = jnp.zeros(())
    return Omniscient(
        params=search.params,
        threats={},
        shielded=False,
        x=jnp.asarray(jnp.inf),
        penalty=nothing,
        insecure_penalty=nothing,
        env=search.model,
    )


def drawn(state: Any, scores: Array) -> Array:
    """Returns a random preference among the best actions.

    Equal scores are frequent, and the first actions of a table are much alike. The random numbers
    come from the state, so that a search needs no key.

    Args:
        state: the environment's state.
        scores: (A,) scores of the actions.

    Returns:
        (A,) random positive numbers for actions whose scores equal the best one up to rounding, 0
        for others.
    """
    place = jax.lax.bitcast_convert_type(state.body.position.astype(jnp.float32), jnp.uint32)
    key = key_of(jax.random.key(STATES), Stream.LOTS)
    for part in (state.time, *place):
        key = jax.random.fold_in(key, part)
    lots = jax.random.uniform(key, scores.shape, scores.dtype, minval=0.5)
    return jnp.where(scores >= jnp.max(scores) - SAME, lots, 0.0)


def values(search: Search) -> Callable[[Percept], Array]:
    """Returns the scores of a search, in the form that `evaluation.run_episodes` takes.

    They hold for an `Omniscient` P-MDP. States are searched one after another, so that memory is
    needed for one only, and none waits for a harder one.

    Args:
        search: the model and the settings.

    Returns:
        A function from a percept to scores (B, A), greatest for the action to take.
    """
    count = len(search.actions)

    def one(row: tuple[Any, Array]) -> Array:
        state, alive = row
        search_it = lambda: drawn(state, pruned(state, search))  # noqa: E731
        return jax.lax.cond(alive, search_it, lambda: jnp.zeros(count))

    return lambda percept: jax.lax.map(one, tuple(percept.encoded))
