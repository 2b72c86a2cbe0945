"""A corridor to try learners on: a coin at one end, a pit that pays better at the other.

The module satisfies `rp_jax.envs.Env`. Going for the pit earns most, unless danger counts.
"""

import jax
import jax.numpy as jnp
from flax import struct

from rp_jax.dynamics import Control, ControlDistribution, Vehicle, VehicleModel, make_vehicle
from rp_jax.envs import contract
from rp_jax.hazards import Reach, SubRMDP, WallPoint
from rp_jax.planning.pmdp import PMDP
from rp_jax.threat.model import ThreatModel, ThreatNetwork

LIDAR_BINS = 16
SCALE = (0.2, 0.1)  # of the cell, the time
STAY, LEFT, RIGHT = range(3)
COIN, PIT = 0.0, 6.0
STARTS = (2, 3, 4)


class Walker(VehicleModel):
    """Moves at once by what a control says."""

    def step(self, vehicle, control):
        way = jnp.stack([control.acceleration, jnp.zeros_like(control.acceleration)])
        return vehicle.replace(position=vehicle.position + way)


class State(struct.PyTreeNode):
    body: Vehicle
    time: jax.Array


class Params(struct.PyTreeNode):
    body: Walker
    pit: WallPoint
    slip: jax.Array  # probability of staying instead
    bait: jax.Array  # what the pit pays
    time_limit: jax.Array


def moves(ways):
    turn = jnp.tile(jnp.asarray([[1.0, 0.0]]), (len(ways), 1))
    return Control(acceleration=jnp.asarray(ways, float), rotation=turn)


def make_params(slip=0.1, bait=3.0, time_limit=12):
    idle = ControlDistribution(controls=moves([0.0]), probabilities=jnp.ones(1))
    body = Walker(moves([0.0, -1.0, 1.0]), idle, speeds=jnp.zeros(1), delayed=False)
    cells = jnp.asarray([-1.0, 1.0])  # a step
    straight = jnp.asarray([[1.0, 0.0], [1.0, 0.0]])
    reach = Reach(limits=cells, change=jnp.full(2, jnp.inf), swing=straight)
    return Params(
        body=body,
        pit=WallPoint(radius=jnp.asarray(0.5), reach=reach, horizon=2),
        slip=jnp.asarray(slip, float),
        bait=jnp.asarray(bait, float),
        time_limit=jnp.asarray(time_limit, jnp.int32),
    )


def start_at(cell):
    body = make_vehicle(jnp.stack([jnp.asarray(cell, float), jnp.zeros(())]), 0.0, 0.0)
    return State(body=body, time=jnp.asarray(0, jnp.int32))


def reset(key, params):
    return start_at(jax.random.choice(key, jnp.asarray(STARTS)))


def step(key, state, action, params):
    slips = jax.random.bernoulli(key, params.slip)
    action = jnp.where(slips, STAY, action)
    control = params.body.control(action)
    reached = State(body=params.body.step(state.body, control), time=state.time + 1)
    fell = collisions(reached, params)["pit"]
    goal = reached.body.position[0] <= COIN
    terminated, truncated = contract.ended(fell | goal, reached.time, params.time_limit)
    return reached, contract.Outcome(
        reward=jnp.where(goal, 1.0, 0.0) + jnp.where(fell, params.bait, 0.0),
        danger=fell.astype(float),
        terminated=terminated,
        truncated=truncated,
        goal=goal,
    )


def observe(state, params):
    """(18,) the cell as the one thing in sight, and as a number; the time."""
    cell = state.body.position[0]
    scan = jnp.where(jnp.arange(LIDAR_BINS) == jnp.round(cell), 0.25, 0.0)
    return jnp.concatenate([scan, jnp.stack([cell, state.time.astype(float)])])


def hazards(state, params):
    """The pit, and one that is not there: it would keep anyone from the coin."""
    places = jnp.asarray([[PIT, 0.0], [COIN, 0.0]])
    return {"pit": contract.Hazards(places, jnp.asarray([True, False]))}


def collisions(state, params):
    return {"pit": params.pit.hits(state.body, jnp.asarray([PIT, 0.0]))}


def sub_rmdps(params):
    return {"pit": SubRMDP(body=params.body, source=params.pit, beta=jnp.asarray(0.999))}


def num_actions(params):
    return 3


def threat_model(params):
    """Certain where an action leads into the pit, nothing elsewhere; weights made by hand."""
    kernel = jnp.tile(jnp.asarray([[-40.0], [0.0], [0.0]]), (1, 3))
    bias = jnp.asarray([20.0, 20.0, 60.0])  # stay, left, right: above 0 up to .5, .5, 1.5 away
    weights = {"params": {"Dense_0": {"kernel": kernel, "bias": bias}}}
    return ThreatModel(params.pit, weights, jnp.ones(3), jnp.zeros(()), ThreatNetwork((), 3))


def make_pmdp(env, params, x=0.5, penalty=0.0, models=None, pool=8, insecure_penalty=0.0):
    """The probe's P-MDP; the shield is off for x = inf, unless there are models."""
    shielded = models is not None or x != float("inf")
    if models is None:
        models = {"pit": threat_model(params)} if shielded else {}
    return PMDP(
        params=params,
        threats=models,
        x=jnp.asarray(x, jnp.float32),
        penalty=jnp.asarray(penalty, jnp.float32),
        insecure_penalty=jnp.asarray(insecure_penalty, jnp.float32),
        env=env,
        pool=pool,
        shielded=shielded,
    )
