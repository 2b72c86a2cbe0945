import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import counterexample_2, jitted, random_cmdp

from rp_jax.tabular import exact, oracle

least_of = jitted(exact.least_threat)


def dangers_and_returns(cmdp):
    """Of every deterministic time-indexed policy."""
    horizon, states, actions = cmdp.shape
    choices = list(itertools.product(range(actions), repeat=horizon * states))
    policies = jax.nn.one_hot(np.reshape(choices, (-1, horizon, states)), actions)
    each = jax.vmap(
        lambda policy: (
            exact.expected(cmdp, exact.threat(cmdp, policy)),
            exact.expected(cmdp, exact.returns(cmdp, policy)),
        )
    )
    return map(np.asarray, jax.jit(each)(policies))


@pytest.mark.parametrize(("gamma", "beta"), [(0.9, 0.6), (1.0, 1.0), (0.3, 1.0)])
def test_the_program_and_the_lagrangian_curve_are_the_best_of_all_policies(gamma, beta):
    for seed in range(4):
        cmdp = random_cmdp(seed, states=3, actions=2, horizon=3, gamma=gamma, beta=beta)
        dangers, values = dangers_and_returns(cmdp)
        vertices = oracle.frontier(cmdp)
        assert vertices[0].danger == pytest.approx(dangers.min(), abs=1e-12)
        assert vertices[-1].value == pytest.approx(values.max(), abs=1e-12)
        for c in np.quantile(dangers, [0, 0.01, 0.1, 0.4, 1]):
            # The best mixture of two policies, over all pairs.
            within, over = dangers <= c + 1e-12, dangers > c + 1e-12
            best = values[within].max()
            if over.any():
                share = (c - dangers[within][:, None]) / (dangers[over] - dangers[within][:, None])
                mixed = (1 - share) * values[within][:, None] + share * values[over]
                best = max(best, mixed.max())
            assert oracle.mixed(vertices, c) == pytest.approx(best, abs=1e-8)
            found = oracle.optimum(cmdp, c)
            assert found.value == pytest.approx(best, abs=1e-8)
            assert found.danger <= c + 1e-8


@pytest.mark.parametrize("horizon", [6, None])
def test_the_program_s_policy_does_what_it_says(horizon):
    for seed in range(5):
        cmdp = random_cmdp(seed, horizon=horizon, gamma=0.9, beta=0.9)
        least = float(exact.expected(cmdp, exact.least_threat(cmdp)))
        c = least + 0.2
        found = oracle.optimum(cmdp, c)
        assert found.policy.shape == cmdp.shape
        np.testing.assert_allclose(found.policy.sum(-1), 1)
        policy = jnp.asarray(found.policy)
        assert exact.expected(cmdp, exact.threat(cmdp, policy)) == pytest.approx(
            found.danger, abs=1e-7
        )
        assert exact.expected(cmdp, exact.returns(cmdp, policy)) == pytest.approx(
            found.value, abs=1e-7
        )
        assert oracle.mixed(oracle.frontier(cmdp), c) == pytest.approx(found.value, abs=1e-7)


def test_of_equally_dangerous_policies_the_best_is_the_optimum():
    """Two of three actions cost the same: dangers are alike but for rounding, returns are not."""
    for seed in range(30):
        cmdp = random_cmdp(seed, states=4, actions=3)
        cmdp = cmdp.replace(danger=jnp.zeros((4, 3)).at[:, :2].set(0.1).at[:, 2].set(0.7))
        vertices = oracle.frontier(cmdp)
        least = float(exact.expected(cmdp, least_of(cmdp)))
        best = oracle.optimum(cmdp, least + 1e-9).value
        assert oracle.mixed(vertices, least) == pytest.approx(best, abs=1e-6)
        assert oracle.unmixed(vertices, least).value == pytest.approx(best, abs=1e-6)


def test_vertices_rise_ever_less_and_are_their_policies():
    cmdp = random_cmdp(3, states=5, horizon=8)
    vertices = oracle.frontier(cmdp)
    assert len(vertices) > 5
    slopes = [(b.value - a.value) / (b.danger - a.danger) for a, b in itertools.pairwise(vertices)]
    assert all(later < earlier for earlier, later in itertools.pairwise(slopes))
    assert slopes[-1] > 0
    evaluate = jitted(oracle._point)
    for vertex in vertices:
        danger, value = evaluate(cmdp, vertex.policy)
        assert (float(danger), float(value)) == pytest.approx((vertex.danger, vertex.value))
    part = oracle.frontier(cmdp, upto=vertices[2].danger)
    assert oracle.mixed(part, vertices[2].danger) == pytest.approx(vertices[2].value)
    assert len(part) < len(vertices)


def test_one_multiplier_reaches_vertices_only():
    cmdp = random_cmdp(3, states=5, horizon=8)
    vertices = oracle.frontier(cmdp)
    between = (vertices[1].danger + vertices[2].danger) / 2
    assert oracle.unmixed(vertices, between) == vertices[1]
    assert vertices[1].value < oracle.mixed(vertices, between) < vertices[2].value
    assert oracle.unmixed(vertices, vertices[0].danger - 1e-6) is None
    assert np.isnan(oracle.mixed(vertices, vertices[0].danger - 1e-6))
    assert oracle.mixed(vertices, 1e9) == vertices[-1].value


def test_no_bound_is_no_constraint():
    cmdp = random_cmdp(4)
    assert oracle.optimum(cmdp, np.inf).value == pytest.approx(oracle.frontier(cmdp)[-1].value)


def test_corollary_3_feasible_exactly_from_the_least_threat_on():
    cmdp = counterexample_2()
    assert oracle.optimum(cmdp, 0.4 + 1e-7).danger == pytest.approx(0.4, abs=1e-6)
    with pytest.raises(ValueError, match=r"c is 0.39; it must be at least the least danger"):
        oracle.optimum(cmdp, 0.39)


def test_what_cannot_be_solved_is_named():
    with pytest.raises(ValueError, match=r"c is -1\.0; it must be"):
        oracle.optimum(random_cmdp(0), -1)
    assert oracle.optimum(random_cmdp(0), jnp.asarray(9.0)).danger <= 9
    apart = random_cmdp(0, horizon=None, gamma=0.9, beta=0.8)
    for solve in (lambda: oracle.optimum(apart, 1.0), lambda: oracle.frontier(apart)):
        with pytest.raises(ValueError, match=r"beta is 0.8; it must be gamma, 0.9"):
            solve()


def as_prism(cmdp):
    """The infinite-horizon CMDP in PRISM's language: discounting is leaving for a sink."""
    states, actions = cmdp.danger.shape
    lines, rewards = [], {"danger": [], "gain": []}
    for s, a in np.ndindex(states, actions):
        chances = [*(float(cmdp.gamma) * np.asarray(cmdp.transition[s, a])), 1 - float(cmdp.gamma)]
        moves = " + ".join(f"{p:.17g}:(s'={z})" for z, p in enumerate(chances) if p > 0)
        lines.append(f"[a{a}] s={s} -> {moves};")
        for name, values in (("danger", cmdp.danger), ("gain", cmdp.reward)):
            rewards[name].append(f"[a{a}] s={s}: {float(values[s, a]):.17g};")
    lines.append(f"[end] s={states} -> true;")
    body = "\n".join(lines)
    text = f"mdp\nmodule one\ns:[0..{states}] init 0;\n{body}\nendmodule\n"
    for name, each in rewards.items():
        text += f'rewards "{name}"\n' + "\n".join(each) + "\nendrewards\n"
    return text


def test_another_solver_agrees(tmp_path):
    """Least danger and greatest return, by a probabilistic model checker."""
    stormpy = pytest.importorskip("stormpy")
    cmdp = random_cmdp(1, states=4, horizon=None, gamma=0.9, beta=0.9)
    cmdp = cmdp.replace(reward=cmdp.reward - cmdp.reward.min(), start=jnp.eye(4)[0])
    (tmp_path / "model.prism").write_text(as_prism(cmdp))
    program = stormpy.parse_prism_program(str(tmp_path / "model.prism"))
    queries = 'R{"danger"}min=? [F s=4]; R{"gain"}max=? [F s=4]'
    properties = stormpy.parse_properties(queries, program)
    model = stormpy.build_model(program, properties)
    found = [stormpy.model_checking(model, query) for query in properties]
    start = model.initial_states[0]
    # The method is named `at` before version 2.
    least, best = (getattr(one, "get_value", getattr(one, "at", None))(start) for one in found)
    assert least == pytest.approx(float(exact.least_threat(cmdp).state[0, 0]), abs=1e-4)
    assert best == pytest.approx(oracle.optimum(cmdp, np.inf).value, abs=1e-4)
