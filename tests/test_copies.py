import copy
from types import SimpleNamespace
from typing import NamedTuple

import jax
import numpy as np
import probe
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax.adapters import brax
from rp_jax.baselines.mpc import make_search
from rp_jax.copies import parts
from rp_jax.envs import circuit
from rp_jax.planning.loop import LoopConfig, make_network
from rp_jax.planning.wrapped import Wrapped
from rp_jax.runs.agents import Agents, Member
from rp_jax.runs.train import World
from rp_jax.threat.function import ThreatFunction

PMDP = probe.make_pmdp(probe, probe.make_params(), x=0.5)
NETWORK = make_network(LoopConfig(), PMDP)
STATES = jax.vmap(probe.reset, (0, None))(jax.random.split(jax.random.key(0), 3), PMDP.params)
AGENTS = Agents(
    PMDP,
    NETWORK,
    jax.vmap(NETWORK.init, (0, None))(
        jax.random.split(jax.random.key(1), 2), PMDP.perceive(STATES).encoded
    ),
    (Member(0, 0.5, 0.0), Member(1, 0.25, 0.0)),
    LoopConfig(),
)


def leaves_of(tree):
    return [leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, jax.Array)]


@pytest.mark.parametrize(
    "made",
    [
        PMDP,
        PMDP.replace(env=Wrapped(probe)),
        make_search(circuit, circuit.make_params(), 2, 200.0, 0.5),
        AGENTS[0],
    ],
    ids=lambda made: type(made).__name__,
)
def test_a_deep_copy_of_a_pytree_is_equal_and_shares_no_array(made):
    again = copy.deepcopy(made)
    assert again is not made
    assert jax.tree.structure(again) == jax.tree.structure(made)  # so programs are not made anew
    ours, theirs = leaves_of(made), leaves_of(again)
    assert len(ours) == len(theirs) > 3
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.unsafe_buffer_pointer() != b.unsafe_buffer_pointer()


def test_a_deep_copy_of_agents_acts_as_they_do():
    again = copy.deepcopy(AGENTS)
    assert again.members == AGENTS.members
    assert again.methods == AGENTS.methods
    assert again.pmdp.env is probe
    for one, other in zip(AGENTS, again, strict=True):
        np.testing.assert_array_equal(one.act(STATES), other.act(STATES))
    again.history.append({"loss": 1.0})
    assert AGENTS.history == []


def test_deep_copies_of_worlds_are_equal_and_independent():
    world = World("probe", probe, {"time_limit": 3}, {"long": {"time_limit": 9}})
    again = copy.deepcopy(world)
    assert type(again) is World
    assert again == world
    assert again.env is probe
    again.tests["long"]["time_limit"] = 1
    assert int(world.params("long").time_limit) == 9
    assert copy.deepcopy(Wrapped(probe)) == Wrapped(probe)


def test_a_deep_copy_of_a_brax_environment_steps_as_it_does():
    env = brax.wrap(brax.BraxEnv(circuit, circuit.make_params()), 10)
    again = copy.deepcopy(env)
    assert type(again) is type(env)
    assert again.unwrapped.env is circuit
    assert again.unwrapped.params is not env.unwrapped.params
    key = jax.random.key_data(jax.random.split(jax.random.key(0), 2))
    states = [jax.jit(one.reset)(key) for one in (env, again)]
    jax.tree.map(np.testing.assert_array_equal, *states)


class Pair(NamedTuple):
    module: object
    rest: object

    __reduce__ = parts


def test_what_is_met_twice_is_copied_once():
    one = [1]
    again = copy.deepcopy([Pair(probe, one), SimpleNamespace(inner=Pair(probe, one))])
    assert again[0].module is again[1].inner.module is probe
    assert again[0].rest is again[1].inner.rest == one
    assert again[0].rest is not one


def test_a_deep_copy_of_a_threat_function_is_equal_and_independent():
    threat = ThreatFunction({}, circuit.sub_rmdps(circuit.make_params()), {"sums": {}})
    again = copy.deepcopy(threat)
    assert again.checksum == threat.checksum
    again.about["sums"]["wall"] = 1
    assert threat.about == {"sums": {}}
