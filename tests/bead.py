"""A bead on a wire and a gate that opens and shuts, all along one axis: positions are ()."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from rp_jax.dynamics import ControlDistribution
from rp_jax.envs import contract
from rp_jax.hazards import SubRMDP

REACH, SPEEDS = 2.0, jnp.asarray([-0.2, -0.1, 0.0, 0.1, 0.2])


class Bead(struct.PyTreeNode):
    """Where it is on the wire, and how fast it slides."""

    position: Any  # ()
    speed: Any  # ()


class Model(struct.PyTreeNode):
    """Slides on, slower or faster."""

    actions: Any
    baseline: Any

    def control(self, action):
        return self.actions[action]

    def step(self, body, control):
        speed = jnp.clip(body.speed + control, -0.2, 0.2)
        return Bead(body.position + body.speed, speed)


class Gate(struct.PyTreeNode):
    """Slides towards either side, a step at a time; hit within .3."""

    horizon: int = struct.field(pytree_node=False, default=5)

    def draw(self, key, shape=()):
        return jax.random.bernoulli(key, 0.5, shape)

    def step(self, hazard, body, noise):
        return hazard + jnp.where(noise, 0.1, -0.1)

    def hits(self, body, hazard):
        return jnp.abs(hazard - body.position) < 0.3

    def in_reach(self, body, hazard):
        return jnp.abs(hazard - body.position) < REACH

    def features(self, body, hazard):
        return jnp.stack([hazard - body.position, body.speed])

    def sample(self, key, model):
        where, fast = jax.random.split(key)
        gap = jax.random.uniform(where, (), float, -REACH, REACH)
        return Bead(jnp.zeros(()), jax.random.choice(fast, SPEEDS)), gap

    def state_of(self, features):
        return Bead(jnp.zeros(()), features[1]), features[0]


class State(struct.PyTreeNode):
    """Bead and gate."""

    body: Any
    gate: Any
    time: Any


class Params(struct.PyTreeNode):
    """Build by `make_params`."""

    body: Any
    time_limit: Any


def make_params():
    table = jnp.asarray([-0.1, 0.0, 0.1])
    body = Model(table, ControlDistribution(table, jnp.asarray([0.25, 0.5, 0.25])))
    return Params(body, jnp.asarray(30, jnp.int32))


def reset(key, params):
    gap = jax.random.uniform(key, (), float, 0.5, 1.0)
    return State(Bead(jnp.zeros(()), jnp.zeros(())), gap, jnp.zeros((), jnp.int32))


def step(key, state, action, params):
    body = params.body.step(state.body, params.body.control(action))
    source = Gate()
    reached = State(body, source.step(state.gate, state.body, source.draw(key)), state.time + 1)
    hit = source.hits(reached.body, reached.gate)
    terminated, truncated = contract.ended(hit, reached.time, params.time_limit)
    danger = hit.astype(float)
    return reached, contract.Outcome(body.speed, danger, terminated, truncated, ~hit & False)


def observe(state, params):
    return jnp.stack([state.body.position, state.body.speed, state.gate])


def hazards(state, params):
    return {"gate": contract.Hazards(state.gate[None], jnp.ones(1, bool))}


def sub_rmdps(params):
    return {"gate": SubRMDP(params.body, Gate())}
