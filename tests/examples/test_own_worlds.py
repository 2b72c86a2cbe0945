import functools
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401
from tiny import TINY, TINY_THREAT, moment

from examples.crossing import run as crossing
from examples.trolley import run as trolley
from examples.trolley import world
from rp_jax.adapters import physics
from rp_jax.cli import experiment, main
from rp_jax.recon import labels, sampling

ROOT = Path(__file__).parents[2]


def flush_left(text):
    """Without indentation and empty lines."""
    return re.sub(r"^\s+", "", text, flags=re.MULTILINE)


def test_the_page_shows_the_code_that_is_tested():
    text = (ROOT / "docs" / "own_environment.md").read_text()
    files = [ROOT / "examples" / "crossing" / name for name in ("world.py", "run.py")]
    code = flush_left("".join(file.read_text() for file in files))
    snippets = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(snippets) == 6
    assert all(flush_left(snippet) in code for snippet in snippets)


@pytest.mark.parametrize(
    ("module", "kinds", "options", "variants"),
    [
        (crossing, ["pedestrian", "parked"], "", 2),
        (trolley, ["cart"], "--test-carts 6", 1),  # minutes to compile each
    ],
)
@pytest.mark.slow
def test_a_world_of_ones_own_goes_all_the_way(module, kinds, options, variants, tmp_path):
    out = tmp_path / "results"
    argv = " ".join([TINY, "--seeds 1", options, *map(TINY_THREAT.format, kinds)]).split()
    with moment():
        experiment.run(module.EXPERIMENT, [*argv, "--out", str(out)])
    rows = json.loads((out / "table.json").read_text())
    assert len({row["variant"] for row in rows}) == variants
    assert len(rows) == variants * 5  # at random twice, two DQNs, RP
    assert {row["x"] for row in rows} == {"inf", 0.9}
    assert all(set(row["collisions"]) == set(kinds) for row in rows)
    assert (out / "learning_curves.png").stat().st_size > 1000
    with moment():  # and its agents are loaded and tested by the commands
        main.main(["certify", "--run", str(out), "--c", "0.95", "--expected", "0.5"])


@functools.cache
def bodies():
    """64 bodies in any state, and carts."""
    sub = world.sub_rmdps(world.make_params(horizon=3))["cart"]
    draw = lambda key: jax.vmap(sub.source.state_of)(sampling.uniform(key, sub, 64))  # noqa: E731
    return sub, jax.jit(draw)(jax.random.key(0))


@pytest.mark.slow
def test_a_body_takes_the_steps_of_the_pipeline_from_any_state():
    sub, (body, _) = bodies()
    system, controls = physics.load(world.MODEL), jnp.tile(sub.body.actions[:8], (8, 1))
    pushed = jax.jit(jax.vmap(sub.body.step))(body, controls)

    def expected(body, control):
        with physics.quietly():
            start = physics.pipeline.init(system, body.q, body.qd)
            return physics.pipeline.step(system, start, control)

    there = jax.jit(jax.vmap(expected))(body, controls)
    np.testing.assert_allclose(pushed.q, there.q, atol=1e-5)
    np.testing.assert_allclose(pushed.qd, there.qd, atol=1e-4)
    assert (pushed.q[0, 2:] != body.q[0, 2:]).any()  # the load swings on


def test_the_load_hangs_where_kinematics_say():
    from brax import math  # quiet by now

    _, (body, _) = bodies()

    def rod(body):
        where = physics.kinematics.forward(physics.load(world.MODEL), body.q, body.qd)[0]
        return where.pos[1] + math.rotate(jnp.asarray([0.0, 0.0, -world.ROPE]), where.rot[1])

    there = jax.jit(jax.vmap(rod))(body)
    np.testing.assert_allclose(jax.vmap(world.load_of)(body), there[:, :2], atol=1e-6)


def test_features_of_a_cart_say_all_and_mirror_with_the_actions():
    sub, (body, cart) = bodies()
    seen = jax.vmap(sub.source.features)(body, cart)
    again = jax.vmap(sub.source.features)(*jax.vmap(sub.source.state_of)(seen))
    np.testing.assert_allclose(again, seen, atol=1e-5)
    # A step under the mirrored action from the mirrored state is the mirrored step.
    mirror = sub.body.mirrored_threats()
    image, _ = jax.vmap(sub.source.state_of)(sub.source.mirrored(seen))
    step = jax.jit(jax.vmap(sub.body.step))
    actions = jnp.arange(64) % sub.body.num_threats
    here = step(body, sub.body.actions[actions])
    there = step(image, sub.body.actions[mirror[actions]])
    np.testing.assert_allclose(there.q * jnp.asarray([[1, -1, -1, 1]]), here.q, atol=1e-4)


@pytest.mark.slow
def test_threats_of_a_body_depend_on_where_it_swings_to():
    sub, _ = bodies()
    swing = jnp.asarray([[0.0] * 4, [0.0] * 4])
    rates = jnp.asarray([[0.0, 0.0, 0.0, -2.0], [0.0, 0.0, 0.0, 2.0]])
    body = physics.JointState(q=swing, qd=rates)
    ahead = jnp.asarray([[0.45, 0.0]] * 2)
    cart = jax.vmap(world.make_vehicle)(ahead, jnp.zeros(2), jnp.zeros(2))
    estimator = labels.best_estimator(sub, 64)
    towards, away = labels.label(jax.random.key(0), body, cart, sub, estimator).threat
    assert (towards >= away).all()
    assert towards.max() > 0.1 > away.max()


def test_a_body_without_symmetry_and_a_lopsided_one_are_refused():
    body = world.make_agent()
    with pytest.raises(ValueError, match="mirror is None; it must be given where a hazard"):
        body.replace(mirror=None).mirrored_threats()
    with pytest.raises(ValueError, match="actions: the table holds no mirror image"):
        body.replace(actions=body.actions[1:]).mirrored_threats()
