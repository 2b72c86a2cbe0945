"""Mutants of sound worlds, each with one thing wrong that the check of environments must name."""

import itertools
import pickle
import re
import types

import bead
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from quick import compile_soon  # noqa: F401

from examples.crossing import world as crossing
from examples.trolley import world as trolley
from rp_jax.dynamics import (
    ControlDistribution,
    VehicleModel,
    advance,
    angle_of,
    independent_controls,
    mirrored_actions,
)
from rp_jax.envs import circuit, contract, jam, patrol, point_gather
from rp_jax.envs.check import EnvError, check_contract, check_env, inspection
from rp_jax.envs.check.batches import RandomDraws
from rp_jax.envs.check.comparison import told_apart
from rp_jax.envs.check.problems import own_settings
from rp_jax.envs.check.purity import shared_memory
from rp_jax.envs.check.trial import Trial
from rp_jax.hazards import MovingObstacle, WallPoint
from rp_jax.runs.plan import make_pmdp
from rp_jax.threat.function import ThreatFunction

SOUND = {
    "crossing": (crossing, crossing.make_params),
    "jam": (jam, jam.make_params),
    "jam-plans": (jam, lambda: jam.make_params(baseline="plans")),
    "jam-paper": (jam, lambda: jam.make_params(3, fidelity="paper")),
    "circuit": (circuit, circuit.make_params),
    "circuit-plans": (circuit, lambda: circuit.make_params(baseline="plans")),
    "point_gather": (point_gather, point_gather.make_params),
    "patrol": (patrol, lambda: patrol.make_params(3)),
    "trolley": (trolley, trolley.make_params),
}
MUTANTS = {}  # by name: what makes (env, params), the check that must find it, the sentence


def mutant(check, sentence, slow=False):
    """Registers a mutant, with a pattern of the sentence that must name what is wrong."""

    def register(make):
        MUTANTS[make.__name__] = (make, check, sentence, slow)
        return make

    return register


def changed(module, leave_out=(), **members):
    """A module with other functions, or without some."""
    own = {name: value for name, value in vars(module).items() if not name.startswith("_")}
    own |= members
    return types.SimpleNamespace(**{k: v for k, v in own.items() if k not in leave_out})


def as_a(kind, node, **fields):
    """The fields of a node, in another class and with other values of some."""
    own = {name: getattr(node, name) for name in node.__dataclass_fields__}
    return kind(**(own | fields))


def with_step(module, change, make=None):
    """A world in which `change` is made to what a step returns."""

    def step(key, state, action, params):
        return change(state, action, params, *module.step(key, state, action, params))

    return changed(module, step=step), (make or module.make_params)()


def with_outcome(change):
    """The crossing with other outcomes: `change` gets the outcome, the state reached, params."""
    return with_step(
        crossing, lambda state, action, params, reached, o: (reached, change(o, reached, params))
    )


def with_pedestrian(kind, module=crossing):
    """The crossing with another source of pedestrians."""
    params = crossing.make_params()
    return module, params.replace(pedestrian=as_a(kind, params.pedestrian))


def with_body(kind):
    """The crossing with another model of the car."""
    params = crossing.make_params()
    return crossing, params.replace(body=as_a(kind, params.body))


# --- structure ---


@mutant("contract", r"the environment has no function `observe`; it must have observe\(state,")
def nothing_is_observed():
    return changed(crossing, leave_out=["observe"]), crossing.make_params()


@mutant("contract", r"clearance of the environment is 3.0; it must be a function")
def a_clearance_that_is_a_number():
    return changed(crossing, clearance=3.0), crossing.make_params()


@mutant("contract", r"no function `clearance` although params.body.baseline is Plans")
def plans_without_clearance():
    return changed(jam, leave_out=["clearance"]), jam.make_params(baseline="plans")


@mutant("contract", r"threshold\(state, x, least\) is int32\[\]; it must be \(\) floating")
def a_threshold_that_is_whole():
    return changed(crossing, threshold=lambda state, x, least: state.time), crossing.make_params()


@mutant("contract", r"threshold of the environment is 0.01; it must be a function")
def a_threshold_that_is_a_number():
    return changed(crossing, threshold=0.01), crossing.make_params()


@mutant("contract", r"SCALE is 2.0; it must be a tuple of numbers")
def a_scale_that_is_a_number():
    return changed(crossing, SCALE=2.0), crossing.make_params()


@mutant(
    "finite values", r"observe: value \d+ of the LIDAR is outside \[0, 1\] in .* states", slow=True
)
def a_scan_in_room_units():
    observe = lambda state, params: jam.observe(state, params).at[:360].multiply(3.0)  # noqa: E731
    return changed(jam, observe=observe), jam.make_params()


@mutant("contract", r"params has no field `time_limit`")
def no_time_limit():
    params = crossing.make_params()
    return crossing, types.SimpleNamespace(body=params.body)


@mutant("contract", r"params has no field `body`; it must have one")
def no_body():
    return crossing, types.SimpleNamespace(time_limit=3)


@mutant("contract", r"params.time_limit is 100.0; it must be a \(\) integer")
def a_time_limit_that_is_a_float():
    return crossing, crossing.make_params().replace(time_limit=100.0)


@mutant("contract", r"the state has no field `time`")
def no_time():
    class State(struct.PyTreeNode):
        body: object

    reset = lambda key, params: State(crossing.reset(key, params).body)  # noqa: E731
    return changed(crossing, reset=reset), crossing.make_params()


@mutant("contract", r"LIDAR_BINS is 12; it must be a multiple of 8")
def twelve_lidar_bins():
    return changed(crossing, LIDAR_BINS=12, SCALE=()), crossing.make_params()


@mutant("contract", r"LIDAR_BINS is 400; .* at most the length of the observation, which is 396")
def more_lidar_bins_than_values():
    return changed(jam, LIDAR_BINS=400), jam.make_params(1)


@mutant("contract", r"SCALE has the length 20; it must be 21, the length of the observation \(21\)")
def a_short_scale():
    return changed(crossing, SCALE=crossing.SCALE[1:]), crossing.make_params()


@mutant("contract", r"observe returns float32\[7, 3\]; it must return a flat array of floats")
def an_observation_that_is_not_flat():
    observe = lambda state, params: crossing.observe(state, params).reshape(7, 3)  # noqa: E731
    return changed(crossing, observe=observe), crossing.make_params()


@mutant("contract", r"step changes the state's .*state.time is float32\[\]; it must be int32\[\]")
def time_that_becomes_a_float():
    return with_step(
        crossing, lambda s, a, p, reached, o: (reached.replace(time=reached.time + 0.0), o)
    )


@mutant(
    "contract", r"step changes the state's .*state has state.body and lacks state.body.position"
)
def a_state_that_becomes_another():
    return with_step(
        crossing, lambda s, a, p, reached, o: (reached.replace(body=reached.body.position), o)
    )


@mutant("contract", r"outcome.reward of step is float32\[1\]; it must be \(\) floating")
def a_reward_with_an_axis():
    return with_outcome(lambda o, reached, params: o.replace(reward=o.reward[None]))


@mutant("contract", r"outcome.danger of step is bool\[\]; it must be \(\) floating")
def a_danger_that_is_bool():
    return with_outcome(lambda o, reached, params: o.replace(danger=o.danger > 0))


@mutant("contract", r"outcome.terminated of step is float32\[\]; it must be \(\) bool")
def an_end_that_is_a_float():
    # As a product, since floats have no `|`.
    class Outcome(contract.Outcome):
        @property
        def done(self):
            return (self.terminated > 0) | self.truncated

    return with_outcome(lambda o, reached, params: as_a(Outcome, o, terminated=o.terminated + 0.0))


@mutant("contract", r"num_actions\(params\) is 8; it must be 9, the number of rows of params.body")
def too_few_actions():
    return changed(crossing, num_actions=lambda params: 8), crossing.make_params()


@mutant("contract", r"step cannot be traced by jax.eval_shape: TracerBoolConversionError")
def a_step_that_branches():
    def change(state, action, params, reached, outcome):
        return (reached, outcome) if action > 0 else (state, outcome)

    return with_step(crossing, change)


@mutant("contract", r"has the kinds \['cars', 'pedestrian'\] and .* \['parked', 'pedestrian'\]")
def hazards_of_another_kind():
    def hazards(state, params):
        found = crossing.hazards(state, params)
        return {"pedestrian": found["pedestrian"], "cars": found["parked"]}

    return changed(crossing, hazards=hazards), crossing.make_params()


def with_group(change):
    def hazards(state, params):
        found = crossing.hazards(state, params)
        return found | {"pedestrian": change(found["pedestrian"])}

    return changed(crossing, hazards=hazards), crossing.make_params()


@mutant("contract", r"\['pedestrian'\].present is float32\[6\]; it must be bool\[6\]")
def presence_that_is_a_float():
    return with_group(lambda group: group._replace(present=jnp.ones(6)))


@mutant("contract", r"\['pedestrian'\].state holds float32\[6, 2\], float32\[5, 2\]; all must have")
def hazards_of_different_numbers():
    short = lambda walkers: walkers.replace(way=walkers.way[1:])  # noqa: E731
    return with_group(lambda group: group._replace(state=short(group.state)))


@mutant("contract", r"features of the source of 'pedestrian' are float32\[1, 5\]; .* \(F,\) floats")
def features_with_two_axes():
    class Pedestrian(crossing.Pedestrian):
        def features(self, body, hazard):
            return super().features(body, hazard)[None]

    return with_pedestrian(Pedestrian)


@mutant("contract", r"hits of the source of 'pedestrian' is float32\[\]; it must be \(\) bool")
def hits_that_are_distances():
    class Pedestrian(crossing.Pedestrian):
        def hits(self, body, hazard):
            return jnp.sum(jnp.square(hazard.position - body.position))

    return changed(crossing, leave_out=["collisions"], step=crossing_step_without_hits), (
        with_pedestrian(Pedestrian)[1]
    )


def crossing_step_without_hits(key, state, action, params):
    return crossing.step(key, state, action, crossing.make_params())


@mutant("contract", r"in_reach of the source of 'pedestrian' is bool\[1\]; it must be \(\) bool")
def reach_with_an_axis():
    class Pedestrian(crossing.Pedestrian):
        def in_reach(self, body, hazard):
            return super().in_reach(body, hazard)[None]

    return with_pedestrian(Pedestrian)


@mutant("contract", r"horizon of the source of 'pedestrian' is 0; it must be an integer of at")
def no_horizon():
    params = crossing.make_params()
    return crossing, params.replace(pedestrian=params.pedestrian.replace(horizon=0))


@mutant(
    "contract", r"draw of the source of 'pedestrian'\(key, \(3,\)\) is float32\[2, 3\]; .*\[3, 2\]"
)
def draws_with_their_axes_exchanged():
    class Pedestrian(crossing.Pedestrian):
        def draw(self, key, shape=()):
            return jax.random.uniform(key, (2, *shape))

    return with_pedestrian(Pedestrian)


@mutant("contract", r"source of 'pedestrian' has no method `state_of`; it must have state_of\(")
def no_state_of():
    class Pedestrian(crossing.Pedestrian):
        state_of = None

    return with_pedestrian(Pedestrian)


@mutant("contract", r"the hazard from sample of the source of 'pedestrian'.way is float32\[1\]")
def samples_of_another_shape():
    class Pedestrian(crossing.Pedestrian):
        def sample(self, key, model):
            body, hazard = super().sample(key, model)
            return body, hazard.replace(way=hazard.way[:1])

    return with_pedestrian(Pedestrian)


@mutant("contract", r"beta of 'pedestrian' is .*; it must be above 0 and at most 1")
def a_discount_above_one():
    return crossing, crossing.make_params().replace(beta=jnp.asarray(1.5))


@mutant("contract", r"mirrored_threats\(\) is \[0, 0, .*; it must be a permutation of 0, ..., 8")
def mirror_images_that_are_no_permutation():
    class Body(VehicleModel):
        def mirrored_threats(self):
            return np.zeros(9, int)

    return with_body(Body)


@mutant("contract", r"mirrored_threats\(\) takes 0 to 1 and that to 2; the mirror image of a")
def mirror_images_that_go_round():
    class Body(VehicleModel):
        def mirrored_threats(self):
            return np.roll(np.arange(9), -1)

    return with_body(Body)


@mutant(
    "contract", r"params.body has no `mirrored_threats` although a hazard source has `mirrored`"
)
def mirrored_features_only():
    class Body(struct.PyTreeNode):
        actions: object
        baseline: object
        speeds: object
        room: object
        delayed: bool = struct.field(pytree_node=False)
        control, step = VehicleModel.control, VehicleModel.step

    return with_body(Body)


@mutant("contract", r"params.body has `mirrored_threats` although no hazard source has `mirrored`")
def mirrored_actions_only():
    class Body(VehicleModel):
        def mirrored_threats(self):
            return super().mirrored_threats()

    class Cars(WallPoint):
        @property
        def mirrored(self):
            raise AttributeError("mirrored")

    class Pedestrian(crossing.Pedestrian):
        @property
        def mirrored(self):
            raise AttributeError("mirrored")

    world, params = with_body(Body)
    cars, pedestrian = as_a(Cars, params.parked), as_a(Pedestrian, params.pedestrian)
    return world, params.replace(parked=cars, pedestrian=pedestrian)


@mutant("contract", r"mirrored_threats raises ValueError: actions: the table holds no mirror image")
def actions_that_turn_left_only():
    params = crossing.make_params()
    table = crossing.control_table((-0.02, 0.02), (0.1, 0.2))
    return crossing, params.replace(body=params.body.replace(actions=table))


def with_baseline(baseline):
    params = crossing.make_params()
    return crossing, params.replace(body=params.body.replace(baseline=baseline))


@mutant("contract", r"probabilities sum to 0.9 .*; they must be at least 0 and sum to 1")
def probabilities_that_do_not_sum_to_one():
    base = crossing.make_params().body.baseline
    return with_baseline(base.replace(probabilities=0.9 * base.probabilities))


@mutant(
    "contract", r"baseline.act\(body, noise\).acceleration is float32\[1\]; it must be float32\[\]"
)
def a_control_of_another_shape():
    class Policy(ControlDistribution):
        def act(self, body, noise):
            return noise.replace(acceleration=noise.acceleration[None])

    return with_baseline(as_a(Policy, crossing.make_params().body.baseline))


# --- 1. purity ---


@mutant(
    "purity", r"step is not pure: for the same key, state and action, outcome.reward is", slow=True
)
def a_step_that_counts_its_calls():
    calls = itertools.count()
    return with_outcome(lambda o, s, p: o.replace(reward=o.reward + 0.01 * next(calls)))


@mutant("purity", r"reset is not pure: for the same key, state.body.speed is", slow=True)
def a_reset_that_counts_its_calls():
    calls = itertools.count()

    def reset(key, params):
        state = crossing.reset(key, params)
        return state.replace(body=state.body.replace(speed=0.001 * next(calls) + jnp.zeros(())))

    return changed(crossing, reset=reset), crossing.make_params()


class Notes(struct.PyTreeNode):
    """A state of the crossing that holds what can be changed in place."""

    body: object
    walkers: object
    time: object
    notes: dict


@mutant("purity", r"step changes the state that it is given: state.notes\['seen'\] is", slow=True)
def a_state_that_is_changed_in_place():
    def reset(key, params):
        return as_notes(crossing.reset(key, params), {"seen": jnp.zeros(())})

    def step(key, state, action, params):
        reached, outcome = crossing.step(key, bare(state), action, params)
        state.notes["seen"] = state.notes["seen"] + 1.0
        return as_notes(reached, dict(state.notes)), outcome

    return changed(crossing, reset=reset, step=step), crossing.make_params()


@mutant("purity", r"reset: state.notes\['limit'\] and params.time_limit are one array", slow=True)
def a_reset_that_hands_out_the_parameters():
    def reset(key, params):
        return as_notes(crossing.reset(key, params), {"limit": params.time_limit})

    def step(key, state, action, params):
        reached, outcome = crossing.step(key, bare(state), action, params)
        return as_notes(reached, dict(state.notes)), outcome

    return changed(crossing, reset=reset, step=step), crossing.make_params()


def as_notes(state, notes):
    return Notes(state.body, state.walkers, state.time, notes)


def bare(state):
    return crossing.State(state.body, state.walkers, state.time)


@mutant("purity", r"step gives something else when it is compiled: outcome.reward is", slow=True)
def a_step_that_knows_whether_it_is_compiled():
    bonus = lambda o: 1.0 if isinstance(o.reward, jax.core.Tracer) else 0.0  # noqa: E731
    return with_outcome(lambda o, s, p: o.replace(reward=o.reward + bonus(o)))


# --- 2. finite values ---


@mutant("finite values", r"observe: value 4 of the observation is not finite in .* states")
def an_observation_of_nan():
    def observe(state, params):
        seen = crossing.observe(state, params)
        return seen.at[4].set(seen[4] * seen[4] / seen[4])

    return changed(crossing, observe=observe), crossing.make_params()


@mutant("finite values", r"step: reward is -inf in .* steps; it must be finite", slow=True)
def a_reward_of_minus_infinity():
    return with_outcome(lambda o, s, p: o.replace(reward=jnp.where(o.danger > 0, -jnp.inf, 1.0)))


@mutant("finite values", r"step: danger is nan in .* steps; it must be finite", slow=True)
def a_danger_of_nan():
    return with_outcome(lambda o, s, p: o.replace(danger=o.danger * 0.0 / s.body.speed))


@mutant("finite values", r"features of the source of 'pedestrian' are not finite in", slow=True)
def features_of_nan():
    class Pedestrian(crossing.Pedestrian):
        def features(self, body, hazard):
            return super().features(body, hazard) * (body.speed / body.speed)

    return with_pedestrian(Pedestrian)


# --- 3. dangers, times, ends ---


@mutant("ends of episodes", r"step: danger is -0.5 \(in .* steps\); it must be at least 0")
def a_negative_danger():
    return with_outcome(lambda o, s, p: o.replace(danger=o.danger - 0.5 * (s.body.speed > 0.05)))


@mutant("ends of episodes", r"terminated and truncated are both true at time 100", slow=True)
def a_limit_that_hides_the_end():
    return with_outcome(lambda o, s, p: o.replace(truncated=s.time >= p.time_limit))


@mutant("ends of episodes", r"truncated is true after step 99 .* before the time limit,", slow=True)
def a_limit_that_comes_too_soon():
    return with_outcome(
        lambda o, s, p: o.replace(truncated=(s.time >= p.time_limit - 1) & ~o.terminated)
    )


@mutant("ends of episodes", r"truncated is false after step 100 .* at the time limit", slow=True)
def a_limit_that_comes_too_late():
    return with_outcome(
        lambda o, s, p: o.replace(truncated=(s.time > p.time_limit) & ~o.terminated)
    )


@mutant("ends of episodes", r"the episode goes on after step 103 .*; it must end at any time from")
def an_episode_that_goes_on():
    return with_outcome(
        lambda o, s, p: o.replace(truncated=(s.time == p.time_limit) & ~o.terminated)
    )


@mutant("ends of episodes", r"time goes from 0 to 2 .*; it must count up by 1", slow=True)
def time_that_counts_by_two():
    return with_step(
        crossing, lambda s, a, p, reached, o: (reached.replace(time=reached.time + 1), o)
    )


@mutant("ends of episodes", r"reset: time is 3 where an episode begins .*; it must be 0", slow=True)
def an_episode_that_does_not_begin_anew():
    reset = lambda key, p: crossing.reset(key, p).replace(time=jnp.asarray(3, jnp.int32))  # noqa: E731
    return changed(crossing, reset=reset), crossing.make_params()


@mutant("ends of episodes", r"step: done is False at time .*; it must be true where", slow=True)
def an_end_that_is_not_done():
    class Outcome(contract.Outcome):
        @property
        def done(self):
            return self.terminated & self.truncated

    return with_outcome(lambda o, s, p: as_a(Outcome, o))


# --- 4. the body ---


@mutant("moves of the body", r"reached.body differs from params.body.step\(.*with action 5\)")
def a_car_that_slips_in_a_turn():
    def change(state, action, params, reached, outcome):
        slip = jnp.where(action == 5, 0.99, 1.0)
        return reached.replace(body=reached.body.replace(speed=reached.body.speed * slip)), outcome

    return with_step(crossing, change)


@mutant("moves of the body", r"reached.body differs from params.body.step", slow=True)
def a_car_that_the_kerb_stops():
    def change(state, action, params, reached, outcome):
        place = reached.body.position.at[1].set(jnp.clip(reached.body.position[1], -0.28, 0.28))
        return reached.replace(body=reached.body.replace(position=place)), outcome

    return with_step(crossing, change)


@mutant("moves of the body", r"differs from sub_rmdps\(params\)\['parked'\].body.step", slow=True)
def a_threat_of_another_car():
    def sub_rmdps(params):
        subs = crossing.sub_rmdps(params)
        slow = params.body.replace(speeds=0.5 * params.body.speeds)
        return subs | {"parked": subs["parked"].replace(body=slow)}

    return changed(crossing, sub_rmdps=sub_rmdps), crossing.make_params()


@mutant("moves of the body", r"reached.body differs from params.body.step\(", slow=True)
def a_trolley_that_is_pushed():
    def change(state, action, params, reached, outcome):
        return reached.replace(body=reached.body.replace(q=reached.body.q + 0.003)), outcome

    return with_step(trolley, change)


# --- 5. hazards that move ---


@mutant(
    "moves of hazards",
    r"step moves hazards of kind 'pedestrian' otherwise than their source",
    slow=True,
)
def pedestrians_that_hurry():
    def change(state, action, params, reached, outcome):
        way = reached.walkers.position - state.walkers.position
        walkers = reached.walkers.replace(position=reached.walkers.position + 0.5 * way)
        return reached.replace(walkers=walkers), outcome

    return with_step(crossing, change)


@mutant(
    "moves of hazards", r"step moves hazards of kind 'obstacle' otherwise than their", slow=True
)
def obstacles_that_brake_in_the_source_only():
    params = jam.make_params()
    slower = independent_controls(
        jam.ACCELERATIONS, (0.6, 0.2, 0.2), jam.OBSTACLE_TURNS, (0.2, 0.2, 0.2, 0.2, 0.2)
    )

    def sub_rmdps(params):
        subs = jam.sub_rmdps(params)
        source = subs["obstacle"].source.replace(behaviour=slower)
        return subs | {"obstacle": subs["obstacle"].replace(source=source)}

    return changed(jam, sub_rmdps=sub_rmdps), params


@mutant("moves of hazards", r"step moves hazards of kind 'cart' otherwise than their", slow=True)
def carts_that_chase_the_load():
    def change(state, action, params, reached, outcome):
        gap = trolley.load_of(reached.body)[None] - reached.carts.position
        near = gap / jnp.linalg.norm(gap, axis=-1, keepdims=True)
        return reached.replace(carts=reached.carts.replace(heading=near)), outcome

    return with_step(trolley, change)


# --- 6. features and states ---


class SwappedSpeeds(MovingObstacle):
    """Takes one speed for the other."""

    def state_of(self, features):
        body, hazard = super().state_of(features)
        return body.replace(speed=hazard.speed), hazard.replace(speed=body.speed)


@mutant("features", r"state_of of the source of 'obstacle' does not invert `features`", slow=True)
def swapped_speeds():
    params = jam.make_params()
    return jam, params.replace(obstacle=as_a(SwappedSpeeds, params.obstacle))


@mutant("features", r"state_of of the source of 'cart' does not invert `features`", slow=True)
def swapped_rates_of_the_swing():
    class Cart(trolley.Cart):
        def state_of(self, features):
            body, hazard = super().state_of(features)
            return body.replace(qd=body.qd[jnp.asarray([0, 1, 3, 2])]), hazard

    params = trolley.make_params()
    return trolley, params.replace(cart=as_a(Cart, params.cart))


@mutant(
    "features", r"features of the source of 'pedestrian' do not say all: in .* pairs", slow=True
)
def features_without_the_way():
    class Pedestrian(crossing.Pedestrian):
        def features(self, body, hazard):
            return super().features(body, hazard).at[2:4].set(jnp.asarray([1.0, 0.0]))

    return with_pedestrian(Pedestrian)


@mutant(
    "samples",
    r"sample of the source of 'pedestrian' draws .* pairs for which in_reach is False",
    slow=True,
)
def samples_out_of_reach():
    class Pedestrian(crossing.Pedestrian):
        def sample(self, key, model):
            body, hazard = super().sample(key, model)
            return body, hazard.replace(position=2.0 * hazard.position)

    return with_pedestrian(Pedestrian)


@mutant(
    "samples",
    r"in_reach of the source of 'pedestrian' is False in .* that `hits` says are hit",
    slow=True,
)
def hits_from_behind_that_are_not_in_reach():
    class Pedestrian(crossing.Pedestrian):
        def in_reach(self, body, hazard):
            return super().in_reach(body, hazard) & (self.features(body, hazard)[0] > -0.05)

    return with_pedestrian(Pedestrian)


# --- 7. mirror images ---


class Straight(VehicleModel):
    """Says that actions are their own mirror images."""

    def mirrored_threats(self):
        return np.arange(9)


@mutant("mirror images", r"'pedestrian' and params.body.mirrored_threats do not fit together in")
def actions_that_are_not_mirrored():
    return with_body(Straight)


class Unmirrored(crossing.Pedestrian):
    """Says that situations are their own mirror images."""

    def mirrored(self, features):
        return features


@mutant("mirror images", r"'pedestrian' and params.body.mirrored_threats do not fit together in")
def features_that_are_not_mirrored():
    return with_pedestrian(Unmirrored)


@mutant("mirror images", r"mirrored of the source of 'pedestrian' takes the features .* twice")
def a_mirror_image_that_is_shifted():
    class Pedestrian(crossing.Pedestrian):
        def mirrored(self, features):
            return super().mirrored(features) + 0.1

    return with_pedestrian(Pedestrian)


@mutant(
    "mirror images", r"mirrored of the source of 'pedestrian' gives features that no", slow=True
)
def a_mirror_image_that_is_stretched():
    class Pedestrian(crossing.Pedestrian):
        def mirrored(self, features):
            image = super().mirrored(features)
            doubled = jnp.linalg.norm(image[..., 2:4], axis=-1, keepdims=True) < 1.5
            way = image[..., 2:4] * jnp.where(doubled, 2.0, 0.5)  # no unit vector
            return jnp.concatenate([image[..., :2], way, image[..., 4:]], axis=-1)

    return with_pedestrian(Pedestrian)


@mutant("mirror images", r"mirrored of the source of 'pedestrian' takes hits to situations without")
def hits_on_the_left_only():
    class Pedestrian(crossing.Pedestrian):
        def hits(self, body, hazard):
            return super().hits(body, hazard) & (self.features(body, hazard)[1] > -0.03)

    return with_pedestrian(Pedestrian)


@mutant("mirror images", r"does not hold of what is random: in .* steps of the hazard and of the")
def a_baseline_that_turns_left():
    return with_baseline(
        independent_controls(
            crossing.ACCELERATIONS, (0.7, 0.2, 0.1), crossing.TURNS, (0.0, 0.3, 0.7)
        )
    )


class UnmirroredPlans(VehicleModel):
    """Takes each plan for its own mirror image."""

    def mirrored_threats(self):
        actions = mirrored_actions(self.actions)
        plans = np.arange(len(self.baseline.target))
        return (plans[:, None] * len(actions) + actions[None]).ravel()


@mutant("mirror images", r"'obstacle' and params.body.mirrored_threats do not fit", slow=True)
def plans_that_are_not_mirrored():
    params = jam.make_params(baseline="plans")
    return jam, params.replace(body=as_a(UnmirroredPlans, params.body))


@mutant("mirror images", r"'cart' and params.body.mirrored_threats do not fit together", slow=True)
def a_swing_that_is_not_mirrored():
    class Cart(trolley.Cart):
        def mirrored(self, features):
            signs = jnp.asarray([1, -1, 1, -1, 1, 1, 1, 1, -1, 1, 1], features.dtype)
            return features * jnp.broadcast_to(signs, features.shape)

    params = trolley.make_params()
    return trolley, params.replace(cart=as_a(Cart, params.cart))


# --- 8. windows ---


@mutant(
    "samples",
    r"sample of the source of 'pedestrian' leaves out states .* feature 4 is in \[0, 0.03",
)
def samples_of_slow_cars_alone():
    class Pedestrian(crossing.Pedestrian):
        def sample(self, key, model):
            car, walker = super().sample(key, model)
            return car.replace(speed=0.3 * car.speed), walker

    return with_pedestrian(Pedestrian)


@mutant(
    "samples",
    r"sample of the source of 'pedestrian' leaves out states .* feature 1 is in \[0",
    slow=True,
)
def samples_of_one_side():
    class Pedestrian(crossing.Pedestrian):
        def sample(self, key, model):
            car, walker = super().sample(key, model)
            return car, walker.replace(position=walker.position.at[1].apply(jnp.abs))

    return with_pedestrian(Pedestrian)


@mutant("reach", r"in_reach of the source of 'pedestrian' is too narrow: within 8 steps .* hit in")
def a_window_that_forgets_the_pace():
    params = crossing.make_params()
    window = crossing.padded_window(params.body, 8, 0.15)
    return crossing, params.replace(pedestrian=params.pedestrian.replace(window=window))


@mutant("reach", r"in_reach of the source of 'wall' is too narrow: within 5 steps", slow=True)
def a_window_of_fewer_steps():
    params = jam.make_params()
    short = WallPoint.create(params.body, horizon=3)
    return jam, params.replace(wall=short.replace(horizon=5))


@mutant("reach", r"in_reach of the source of 'cart' is too narrow: within 12 steps", slow=True)
def a_window_without_the_swing():
    params = trolley.make_params()
    half = jax.tree.map(lambda a: 0.4 * a, params.cart.window)
    return trolley, params.replace(cart=params.cart.replace(window=half))


# --- delayed controls and plans ---


@mutant(
    "delayed controls", r"delayed is True, but a control decides at once whether a hazard is hit"
)
def controls_that_act_at_once():
    class Agile(VehicleModel):
        def step(self, vehicle, control):
            return advance(vehicle, control, self.speeds, False)

    world, params = with_body(Agile)
    fast = params.body.replace(speeds=params.body.speeds * 2)
    return world, params.replace(body=fast)


@mutant(
    "plans", r"plan \d+ still moves after its horizon of 4 steps, by 0\.\d+ in a step", slow=True
)
def plans_that_are_cut_off():
    params = jam.make_params(baseline="plans")
    plans = params.body.baseline.replace(horizon=4)
    return jam, params.replace(body=params.body.replace(baseline=plans))


@mutant("plans", r"plan \d+ takes a control that is none of params\.body\.actions")
def plans_with_a_turn_of_their_own():
    params = jam.make_params(baseline="plans")
    plans = params.body.baseline
    half = 0.5 * angle_of(plans.rotation)
    plans = plans.replace(rotation=jnp.stack([jnp.cos(half), jnp.sin(half)], axis=-1))
    return jam, params.replace(body=params.body.replace(baseline=plans))


@mutant("plans", r"plan \d+ takes a control that is none of params\.body\.actions", slow=True)
def plans_that_brake_harder_than_the_agent_can():
    params = circuit.make_params(baseline="plans")
    plans = params.body.baseline.replace(max_acceleration=jnp.asarray(0.04))
    return circuit, params.replace(body=params.body.replace(baseline=plans))


# --- 9. dangers ---


@mutant("dangers", r"step: danger is 0 in .* steps in which `hits` of the source of 'pedestrian'")
def no_danger_at_low_speed():
    return with_outcome(lambda o, s, p: o.replace(danger=o.danger * (s.body.speed > 0.05)))


@mutant("dangers", r"step: danger is above 0 in .* in which no hazard that is present is hit;")
def a_danger_from_nowhere():
    pit = lambda s: (s.body.position[0] > 0.5) & (s.body.position[0] < 0.7)  # noqa: E731
    return with_outcome(lambda o, s, p: o.replace(danger=jnp.maximum(o.danger, 1.0 * pit(s))))


@mutant("dangers", r"collisions: 'parked' is False in .* steps in which `hits`", slow=True)
def collisions_of_pedestrians_only():
    def collisions(state, params):
        return crossing.collisions(state, params) | {"parked": jnp.asarray(False)}

    return changed(crossing, collisions=collisions), crossing.make_params()


@mutant(
    "dangers", r"collisions: 'pedestrian' is True in .* no hazard of that kind is hit", slow=True
)
def collisions_of_any_kind():
    def collisions(state, params):
        hit = crossing.collisions(state, params)
        return {"pedestrian": hit["pedestrian"] | hit["parked"], "parked": hit["parked"]}

    return changed(crossing, collisions=collisions), crossing.make_params()


@mutant("dangers", r"no hazard that is present is hit and the clearance is above 0; all", slow=True)
def a_clearance_that_is_too_large():
    clearance = lambda position, params: jam.clearance(position, params) + 0.05  # noqa: E731
    return changed(jam, clearance=clearance), jam.make_params(baseline="plans")


@mutant(
    "dangers", r"step: danger is above 0 in .* in which no hazard that is present is", slow=True
)
def obstacles_that_are_not_listed():
    def hazards(state, params):
        found = jam.hazards(state, params)
        few = jnp.arange(params.num_obstacles) < 4
        return found | {"obstacle": found["obstacle"]._replace(present=state.present & few)}

    return changed(jam, hazards=hazards, leave_out=["collisions"]), jam.make_params()


# --- 10. static hazards ---


@mutant(
    "static hazards",
    r"step of the source of 'pedestrian' moves the hazard in .* `static` is",
    slow=True,
)
def pedestrians_that_are_said_to_stand():
    class Pedestrian(crossing.Pedestrian):
        static = True

    return with_pedestrian(Pedestrian)


@mutant("static hazards", r"step moves hazards of kind 'parked', or takes them away, in")
def parked_cars_that_roll():
    def hazards(state, params):
        found = crossing.hazards(state, params)
        rolled = found["parked"].state + 0.01 * state.time
        return found | {"parked": found["parked"]._replace(state=rolled)}

    return changed(crossing, hazards=hazards), crossing.make_params()


# --- 11. the baseline policy ---


@mutant("the baseline policy", r"params.body.baseline.act gives the control \[nan, nan, nan\] in")
def a_baseline_that_fails_at_rest():
    class Policy(ControlDistribution):
        def act(self, body, noise):
            return jax.tree.map(lambda a: a * body.speed / body.speed, noise)

    return with_baseline(as_a(Policy, crossing.make_params().body.baseline))


@mutant("the baseline policy", r"params.body.step leads to .*nan.*; it must be finite", slow=True)
def a_body_that_fails_at_full_speed():
    class Body(VehicleModel):
        def step(self, vehicle, control):
            moved = super().step(vehicle, control)
            return moved.replace(speed=jnp.where(vehicle.speed > 0.0999, jnp.nan, moved.speed))

    return with_body(Body)


# --- tests ---


def found_by(check, env, params, seed=0):
    with own_settings():
        return inspection.CHECKS[check](Trial(env, params, seed))


def names(of_contract):
    return [
        pytest.param(name, marks=[pytest.mark.slow] * slow)
        for name, (_, check, _, slow) in MUTANTS.items()
        if (check == "contract") == of_contract
    ]


@pytest.mark.parametrize("name", names(of_contract=True))
def test_what_is_wrong_with_the_structure_is_named_without_simulation(name):
    make, _, sentence, _ = MUTANTS[name]
    with pytest.raises(EnvError) as error:
        check_contract(*make())
    assert any(re.search(sentence, problem) for problem in error.value.problems), error.value


@pytest.mark.parametrize("name", names(of_contract=False))
def test_its_check_names_what_is_wrong_with_a_mutant(name):
    make, check, sentence, _ = MUTANTS[name]
    env, params = make()
    check_contract(env, params)  # which simulation alone can tell
    problems = found_by(check, env, params)
    assert any(re.search(sentence, problem) for problem in problems), problems


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTANTS)
def test_the_whole_check_names_what_is_wrong_with_a_mutant(name):
    make, _, sentence, _ = MUTANTS[name]
    with pytest.raises(EnvError) as error:
        check_env(*make())
    assert any(re.search(sentence, problem) for problem in error.value.problems), error.value
    assert len(error.value.problems) < 10
    assert not any("could not be" in problem for problem in error.value.problems)


each_sound = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "crossing")) for name in SOUND]
)


@each_sound
def test_a_sound_world_passes(name):
    env, make = SOUND[name]
    assert check_env(env, make()) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", SOUND)
def test_there_is_no_false_alarm_over_twenty_seeds(name):
    env, make = SOUND[name]
    with own_settings():
        trial = Trial(env, make(), 0)
        for seed in range(20):
            vars(trial.draws).update(
                vars(RandomDraws(jax.random.key(seed)))
            )  # compiles nothing again
            for made in ("steps", "placed"):
                vars(trial).pop(made, None)
            for what, check in inspection.CHECKS.items():
                if what != "purity":  # which compiles for a long time, each time
                    assert check(trial) == [], (seed, what)


@pytest.mark.parametrize("name", ["jam", "jam-plans", "circuit-plans", "point_gather"])
def test_a_sound_world_has_a_sound_structure(name):
    env, make = SOUND[name]
    assert check_contract(env, make()) is None


def test_who_shares_memory_is_told_by_name():
    params = crossing.make_params()
    state = crossing.reset(jax.random.key(0), params)
    assert shared_memory("reset", state, params) == []
    (problem,) = shared_memory("reset", state, params.replace(time_limit=state.time))
    assert problem.startswith("reset: state.time and params.time_limit are one array; state.time ")
    kept = state.replace(time=state.time + 1)  # such as an array of the module's
    (problem,) = shared_memory("reset", kept, params, state)
    assert problem.startswith("reset: state.body.position and another state.body.position are one")
    twice = state.replace(body=state.body.replace(heading=state.body.position))
    (problem,) = shared_memory("step", twice, params)
    assert problem.startswith("step: state.body.heading and state.body.position are one array")


class World:
    """The crossing as an object, without all that may be left out, and its own way of adding."""

    def __init__(self, order=False):
        self.order = order

    def reset(self, key, params):
        return crossing.reset(key, params)

    def step(self, key, state, action, params):
        reached, outcome = crossing.step(key, state, action, params)
        promoted = jnp.ones((2, 3)) * jnp.ones(3)  # an error where rank promotion is one
        return reached, outcome.replace(reward=outcome.reward + promoted[0, 0] - 1.0)

    def observe(self, state, params):
        return crossing.observe(state, params)

    def hazards(self, state, params):
        """Nearest first, if wanted."""
        found = crossing.hazards(state, params)
        walkers = found["pedestrian"].state
        gap = jnp.sum(jnp.square(walkers.position - state.body.position), axis=-1)
        order = jnp.argsort(gap) if self.order else jnp.arange(len(gap))
        rows = jax.tree.map(lambda a: a[order], walkers)
        return found | {"pedestrian": found["pedestrian"]._replace(state=rows)}

    def sub_rmdps(self, params):
        return crossing.sub_rmdps(params)


def test_what_may_be_left_out_is_not_missed_and_settings_of_jax_are_left_alone():
    assert jax.config.jax_numpy_rank_promotion == "raise"
    assert check_contract(World(), crossing.make_params()) is None
    assert jax.config.jax_numpy_rank_promotion == "raise"


@pytest.mark.slow
@pytest.mark.parametrize("order", [False, True])
def test_an_object_passes_without_what_may_be_left_out_in_any_order_of_hazards(order):
    assert check_env(World(order), crossing.make_params()) is None


class Viewed(struct.PyTreeNode):
    """A state of the crossing that holds the simulator's, and computes body and time from it."""

    inner: object

    @property
    def body(self):
        return self.inner.body

    @property
    def time(self):
        return self.inner.time


@pytest.mark.slow
def test_body_and_time_of_a_state_may_be_computed():
    def step(key, state, action, params):
        reached, outcome = crossing.step(key, state.inner, action, params)
        return Viewed(reached), outcome

    world = changed(
        crossing,
        reset=lambda key, params: Viewed(crossing.reset(key, params)),
        step=step,
        observe=lambda state, params: crossing.observe(state.inner, params),
        hazards=lambda state, params: crossing.hazards(state.inner, params),
    )
    assert problems_of(world, crossing.make_params()) == ()


@pytest.mark.slow
def test_positions_may_have_one_axis():
    assert problems_of(bead, bead.make_params()) == ()


def test_a_world_may_have_no_hazards():
    world = changed(
        crossing, hazards=lambda state, params: {}, sub_rmdps=lambda params: {}, leave_out=["step"]
    )

    def step(key, state, action, params):
        reached, outcome = crossing.step(key, state, action, params)
        fine = jnp.zeros_like(outcome.terminated)
        ended = contract.ended(fine, reached.time, params.time_limit)
        calm = outcome.replace(danger=0 * outcome.danger, terminated=ended[0], truncated=ended[1])
        return reached, calm

    world.step = step
    params = crossing.make_params()
    assert check_contract(world, params) is None
    pmdp = make_pmdp(world, params, ThreatFunction({}, {}))
    states = jax.vmap(world.reset, (0, None))(jax.random.split(jax.random.key(0), 3), params)
    np.testing.assert_array_equal(pmdp.threat(states), np.zeros((3, 9)))


class Keyed(struct.PyTreeNode):
    """A state of the crossing with a random key of its own."""

    body: object
    walkers: object
    time: object
    key: object


@pytest.mark.slow
def test_a_state_may_hold_a_random_key():
    def reset(key, params):
        return keyed(crossing.reset(key, params), key)

    def step(key, state, action, params):
        here, onward = jax.random.split(state.key)
        reached, outcome = crossing.step(here, bare(state), action, params)
        return keyed(reached, jax.random.fold_in(onward, jax.random.bits(key))), outcome

    def keyed(state, key):
        return Keyed(state.body, state.walkers, state.time, key)

    world = changed(crossing, reset=reset, step=step)
    problems = problems_of(world, crossing.make_params())
    # Its hazards move by its own key: from one state there is one way only.
    assert all("moves hazards of kind 'pedestrian' otherwise" in problem for problem in problems)


def problems_of(env, params):
    try:
        check_env(env, params)
    except EnvError as error:
        return error.problems
    return ()


def test_all_problems_are_listed_in_one_error():
    with pytest.raises(EnvError, match="3 problems were found") as error:
        check_contract(
            changed(crossing, SCALE=(1.0,), num_actions=lambda params: 3),
            crossing.make_params().replace(time_limit=jnp.asarray(0, jnp.int32)),
        )
    problems = error.value.problems
    assert isinstance(error.value, ValueError)
    assert len(problems) == 3
    assert all(problem in str(error.value) for problem in problems)
    assert pickle.loads(pickle.dumps(error.value)).problems == problems
    assert str(EnvError(["One."])) == "One."


@pytest.mark.parametrize("seed", [-1, 0.5, None])
def test_the_seed_must_be_an_integer(seed):
    with pytest.raises(ValueError, match=r"seed is .*; it must be an integer, at least 0"):
        check_env(crossing, crossing.make_params(), seed=seed)


def test_an_exception_in_a_check_is_a_problem():
    class Pedestrian(crossing.Pedestrian):
        def mirrored(self, features):
            if features.ndim == 1 and features.shape[0] != 5:
                raise RuntimeError("five are needed")
            return super().mirrored(features)[..., :4]

    with pytest.raises(EnvError, match="mirrored of the source of 'pedestrian'"):
        check_contract(*with_pedestrian(Pedestrian))


@pytest.mark.parametrize("kind", ["normal", "discrete"])
def test_samples_of_one_distribution_are_told_apart_as_rarely_as_promised(kind):
    rng, level = np.random.default_rng(0), 0.05
    draw = {
        "normal": lambda: rng.normal(size=(200, 2)),
        "discrete": lambda: rng.integers(3, size=(200, 2)) + rng.normal(size=(200, 2)) * 1e-7,
    }[kind]
    tolerance = np.full(2, 1e-5)
    alarms = sum(told_apart(draw(), draw(), tolerance, level) for _ in range(400))
    assert alarms <= 0.05 * 400
    assert told_apart(draw(), draw() + 1.0, tolerance, level)
    assert not told_apart(np.zeros((50, 2)), np.full((50, 2), 0.9e-5), tolerance, level)
    assert told_apart(np.zeros((50, 2)), np.full((50, 2), 1.1e-5), tolerance, level)
