"""A trolley under the roof carries a swinging load over a floor on which carts drive about.

The trolley and its load are a body of brax's: forces push the trolley, inertia swings the load.
The load must not meet a cart, and has to be brought to the far corner.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax import arrays
from rp_jax.adapters.physics import BraxBody, JointState
from rp_jax.dynamics import (
    ControlDistribution,
    Vehicle,
    advance,
    independent_controls,
    make_vehicle,
    squared_distance,
)
from rp_jax.envs import contract
from rp_jax.hazards import SubRMDP, Window
from rp_jax.validate import number, positive

FASTEST = 0.6  # metres / second that the trolley is asked for
# Lengths in metres, a step takes a tenth of a second. The motors push with up to 1.5 N to reach
# the speed that they are asked for; the rope is a rod of .8 m on two hinges.
MODEL = f"""
<mujoco>
  <option timestep="0.1" gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <geom type="sphere" size="0.05" mass="1" contype="0" conaffinity="0"/>
      <body>
        <joint name="swing_x" type="hinge" axis="1 0 0" damping="0.1"/>
        <joint name="swing_y" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="sphere" pos="0 0 -0.8" size="0.1" mass="0.5" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="x" kv="5" ctrlrange="-{FASTEST} {FASTEST}" forcerange="-1.5 1.5"/>
    <velocity joint="y" kv="5" ctrlrange="-{FASTEST} {FASTEST}" forcerange="-1.5 1.5"/>
  </actuator>
</mujoco>
"""
ROPE = 0.8
SIDE = 3.0  # of the floor
GOAL, NEAR = (2.7, 2.7), 0.3  # the load is to come this near
SWING, RATE = 0.6, 2.0  # radians, radians / second: greatest that threats are learned for
SPEEDS = (0.0, 0.01, 0.02, 0.03)  # of carts, metres / step
SEEN = 4  # carts observed
SCALE: tuple[float, ...] = (0.5, 0.5, 3.0, 3.0, 2.0, 2.0, 1.0, 1.0) + (1.0, 1.0, 20.0, 20.0) * SEEN


def make_agent() -> BraxBody:
    """Nine velocities to ask for; while threats are measured, mostly that of standing still."""
    ways = (-FASTEST, 0.0, FASTEST)
    table = jnp.asarray([(x, y) for x in ways for y in ways])
    still = jnp.where(jnp.all(table == 0, axis=-1), 0.6, 0.05)
    return BraxBody(table, ControlDistribution(table, still), MODEL, mirror=(1, -1))


def load_of(body: JointState) -> Array:
    """(2,) where the load hangs, seen from above."""
    x, y = body.q[2], body.q[3]  # about the x axis first, then about the turned y axis
    return body.q[:2] + ROPE * jnp.stack([-jnp.sin(y), jnp.cos(y) * jnp.sin(x)])


class Cart(struct.PyTreeNode):
    """A vehicle that drives at random; a `rp_jax.hazards.HazardSource` for any `JointState`."""

    distance: Array  # () from the load's middle to the cart's, at which they meet
    speeds: Array  # (S,) that it reaches, ascending
    behaviour: ControlDistribution
    window: Window
    horizon: int = struct.field(pytree_node=False, default=12)
    static: bool = struct.field(pytree_node=False, default=False)

    def draw(self, key: Array, shape: tuple[int, ...] = ()):
        """Its controls."""
        return self.behaviour.draw(key, shape)

    def step(self, hazard: Vehicle, body: JointState, noise) -> Vehicle:
        """It drives on, regardless of the load."""
        return advance(hazard, noise, self.speeds)

    def hits(self, body: JointState, hazard: Vehicle) -> Array:
        """The load is nearer than `distance`."""
        return squared_distance(hazard.position, load_of(body)) < jnp.square(self.distance)

    def in_reach(self, body: JointState, hazard: Vehicle) -> Array:
        """In the window."""
        return self.window.contains(hazard.position - load_of(body))

    def features(self, body: JointState, hazard: Vehicle) -> Array:
        """(11,) position from the load (2), heading (2), speed; angles of swing (2); rates (4)."""
        relative = hazard.position - load_of(body)
        rest = [hazard.speed[None], body.q[2:], body.qd]
        return jnp.concatenate([relative, hazard.heading, *rest])

    def mirrored(self, features: Array) -> Array:
        """At the x axis: what turns about it turns the other way."""
        signs = [1, -1, 1, -1, 1, -1, 1, 1, -1, -1, 1]
        return features * jnp.broadcast_to(jnp.asarray(signs, features.dtype), features.shape)

    def sample(self, key: Array, model: BraxBody) -> tuple[JointState, Vehicle]:
        """Any swing of the load and any speed, and a cart anywhere in the window."""
        swing, move, rate, where, turn, fast = jax.random.split(key, 6)
        draw = lambda key, most: jax.random.uniform(key, (2,), float, -most, most)  # noqa: E731
        body = JointState(
            q=jnp.concatenate([jnp.zeros(2), draw(swing, SWING)]),
            qd=jnp.concatenate([draw(move, 1.2 * FASTEST), draw(rate, RATE)]),
        )
        angle = jax.random.uniform(turn, (), float, -jnp.pi, jnp.pi)
        position = load_of(body) + self.window.sample(where)
        return body, make_vehicle(position, angle, jax.random.choice(fast, self.speeds))

    def state_of(self, features: Array) -> tuple[JointState, Vehicle]:
        """The inverse of `features`, the trolley at the origin."""
        body = JointState(q=jnp.concatenate([jnp.zeros(2), features[5:7]]), qd=features[7:])
        heading = features[2:4] / jnp.linalg.norm(features[2:4])
        return body, Vehicle(load_of(body) + features[:2], heading, features[4])


class State(struct.PyTreeNode):
    """The body and the carts."""

    body: JointState
    carts: Vehicle  # leading axis (N,)
    time: Array  # () int32


class Params(struct.PyTreeNode):
    """Build by `make_params`."""

    body: BraxBody
    cart: Cart
    time_limit: Array  # () int32, steps
    beta: Array  # () discount of danger
    carts: int = struct.field(pytree_node=False, default=6)


def make_params(carts: int = 6, *, time_limit: int = 150, horizon: int = 12) -> Params:
    """The task's parameters, checked.

    Args:
        carts: on the floor.
        time_limit: steps of an episode.
        horizon: steps after which the threat of a cart is cut.

    Raises:
        ValueError: a value is out of range.
    """
    number("carts", carts, least=1, most=50, integer=True)
    positive("time_limit", time_limit, most=10**9, integer=True)
    positive("horizon", horizon, most=100, integer=True)
    distance = 0.25
    # The trolley's way, the load's swing from side to side, the cart's way.
    far = jnp.full(2, horizon * (0.12 * FASTEST + SPEEDS[-1]) + 2 * ROPE * SWING + distance)
    turns = (-0.15, -0.05, 0.0, 0.05, 0.15)
    return Params(
        body=make_agent(),
        cart=Cart(
            distance=jnp.asarray(distance, float),
            speeds=jnp.asarray(SPEEDS, float),
            behaviour=independent_controls((-0.01, 0.0, 0.01), (0.2, 0.6, 0.2), turns, (0.2,) * 5),
            window=Window(-far, far),
            horizon=horizon,
        ),
        time_limit=jnp.asarray(time_limit, jnp.int32),
        beta=jnp.asarray(0.999, float),
        carts=carts,
    )


def reset(key: Array, params: Params) -> State:
    """The load swings a little in the near corner; carts are at least 1.3 m from it."""
    swing, where, turn, fast = jax.random.split(key, 4)
    body = JointState(
        q=jnp.concatenate([jnp.full(2, 0.3), 0.1 * jax.random.normal(swing, (2,))]),
        qd=jnp.zeros(4),
    )
    # Uniform in polar coordinates about the near corner, then brought onto the floor.
    count = params.carts
    radius, angle = jax.random.uniform(where, (2, count))
    radius, angle = 1.3 + radius * (SIDE - 1.3), angle * jnp.pi / 2
    position = radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    heading = jax.random.uniform(turn, (count,), float, -jnp.pi, jnp.pi)
    speed = jax.random.choice(fast, params.cart.speeds, (count,))
    carts = jax.vmap(make_vehicle)(position, heading, speed)
    return State(body=body, carts=carts, time=jnp.asarray(0, jnp.int32))


def _way_left(body: JointState) -> Array:
    return jnp.sqrt(squared_distance(load_of(body), jnp.asarray(GOAL)))


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, contract.Outcome]:
    """All move; 10 for each metre nearer to the goal, -.05 a step, 5 at the goal."""
    source = params.cart

    def drive(n: Array, cart: Vehicle) -> Vehicle:
        moved = source.step(cart, state.body, source.draw(jax.random.fold_in(key, n)))
        inward = jnp.where(moved.position < 0, 1.0, -1.0) * jnp.abs(moved.heading)
        outside = (moved.position < 0) | (moved.position > SIDE)
        return moved.replace(heading=jnp.where(outside, inward, moved.heading))

    reached = State(
        body=params.body.step(state.body, params.body.control(action)),
        carts=jax.vmap(drive)(jnp.arange(params.carts), state.carts),
        time=state.time + 1,
    )
    crashed = contract.hits(sub_rmdps(params), reached.body, hazards(reached, params))["cart"]
    left = _way_left(reached.body)
    goal = (left < NEAR) & ~crashed
    terminated, truncated = contract.ended(crashed | goal, reached.time, params.time_limit)
    return reached, contract.Outcome(
        reward=10.0 * (_way_left(state.body) - left) - 0.05 + jnp.where(goal, 5.0, 0.0),
        danger=crashed.astype(left.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=goal,
    )


def observe(state: State, params: Params) -> Array:
    """(24,) from the load to the goal (2), angles of swing (2), rates (4); of the 4 nearest carts,
    position from the load and velocity, at (3, 0) where there are fewer."""
    body, carts, n = state.body, state.carts, params.carts
    relative = carts.position - load_of(body)[None]
    rows = jnp.concatenate([relative, carts.heading * carts.speed[:, None]], axis=-1)
    order = arrays.ranks(squared_distance(relative, jnp.zeros((1, 2))))
    blank = jnp.tile(jnp.asarray([[3.0, 0.0, 0.0, 0.0]], rows.dtype), (max(n, SEEN), 1))
    nearest = blank.at[order].set(rows)[:SEEN]
    own = [jnp.asarray(GOAL) - load_of(body), body.q[2:], body.qd]
    return jnp.concatenate([*own, nearest.reshape(-1)])


def hazards(state: State, params: Params) -> dict[str, contract.Hazards]:
    """All carts."""
    return {"cart": contract.Hazards(state.carts, jnp.ones(params.carts, bool))}


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """The body and one cart, on a floor without end."""
    return {"cart": SubRMDP(body=params.body, source=params.cart, beta=params.beta)}
