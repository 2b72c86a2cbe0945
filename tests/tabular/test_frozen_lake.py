import numpy as np
import pytest
from cases import jitted

from rp_jax.tabular import cmdp, exact, frozen_lake

CELLS = np.asarray([[*row] for row in frozen_lake.MAP_8X8])
LEFT, DOWN, RIGHT, UP = range(4)


def at(row, column):
    """The state of a cell counted from 1, as in figure 2."""
    return (row - 1) * 8 + column - 1


def test_the_lake_is_gymnasium_s():
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("FrozenLake8x8-v1").unwrapped
    theirs = cmdp.from_table(
        env.P,
        danger=(env.desc.ravel() == b"H").astype(float),
        start=env.initial_state_distrib,
        gamma=1.0,
        beta=1.0,
        horizon=100,
    )
    ours = frozen_lake.frozen_lake(holes="paper")
    for name in ("transition", "reward", "danger", "start"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-12)


def test_holes_end_the_episode_or_hold_for_its_rest():
    for holes, expected in (("paper", 1.0), ("released", 10.0)):
        lake = frozen_lake.frozen_lake(["SH", "FG"], holes=holes, horizon=10, slip=0.0)
        into = np.eye(4)[[RIGHT] * 5]
        assert float(exact.expected(lake, exact.threat(lake, into))) == expected
        assert float(exact.expected(lake, exact.returns(lake, into))) == 0
        around = np.eye(4)[[DOWN, DOWN, RIGHT, DOWN, DOWN]]
        assert float(exact.expected(lake, exact.threat(lake, around))) == 0
        assert float(exact.expected(lake, exact.returns(lake, around))) == 1  # once


def test_a_step_slips_to_either_side_and_edges_and_walls_stop_it():
    table, _ = frozen_lake.transition_table(["SF#", "FFF", "FFG"], slip=0.5)
    middle = {arrival: p for p, arrival, _, _ in table[4][RIGHT]}
    assert middle == pytest.approx({7: 0.25, 5: 0.5, 1: 0.25})
    corner = [(p, arrival) for p, arrival, _, _ in table[0][LEFT]]
    assert corner == [(0.25, 0), (0.5, 0), (0.25, 3)]  # up, left, down
    assert [arrival for _, arrival, _, _ in table[1][RIGHT]] == [4, 1, 1]  # the wall is ahead


def test_the_safe_path_is_the_paper_s():
    """Section 5.2: along the right column; at (6, 8) and (7, 8) only RIGHT is safe."""
    lake = frozen_lake.frozen_lake(holes="paper")
    found = np.asarray(jitted(exact.least_threat)(lake).action[0])
    for row in (6, 7):
        safe = np.flatnonzero(found[at(row, 8)] < 1e-12)
        assert safe.tolist() == [RIGHT]
    for row in range(1, 8):
        assert found[at(row, 8)].min() < 1e-12
    beside = found[at(5, 5)].min()  # between holes
    assert beside > 0.05
    assert found[at(1, 1)].max() == 0


@pytest.mark.parametrize(
    ("rows", "settings", "message"),
    [
        (["SF", "G"], {}, r"rows has rows of lengths \[2, 1\]; they must be alike"),
        ([], {}, "rows has rows of lengths"),
        ("SFG", {}, "rows is 'SFG'; it must be a list of strings"),
        ([1, 2], {}, r"rows is \[1, 2\]; it must be"),
        (["SX"], {}, "rows: letter is 'X'; it must be one of 'S', 'F', 'H', 'G', '#'"),
        (["FG"], {}, "rows has no S"),
        (["SG"], {"slip": 1.5}, "slip is 1.5; it must be"),
        (["SG"], {"holes": "deep"}, "holes is 'deep'; it must be one of 'released', 'paper'"),
        (["SG"], {"horizon": -1}, "horizon is -1; it must be"),
    ],
)
def test_what_is_wrong_is_named(rows, settings, message):
    with pytest.raises(ValueError, match=message):
        frozen_lake.frozen_lake(rows, **settings)
