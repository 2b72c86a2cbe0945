import types

import jax
import numpy as np
import pytest

from rp_jax import storage
from rp_jax.envs import circuit, jam
from rp_jax.envs.tracks import circle_plan
from rp_jax.runs import rare_events
from rp_jax.runs.rare_events import RareConfig, Subject


def test_worst_starts_of_another_task_or_in_no_number_are_refused(tmp_path):
    pmdp = types.SimpleNamespace(env=jam, params=jam.make_params(3))
    about = {"env": "jam", "variant": "N=3"}
    one = jax.tree.map(lambda a: a[None], jam.reset(jax.random.key(0), pmdp.params))
    storage.save(tmp_path / "set", rare_events.STARTS, one, about | {"count": 1})
    jax.tree.map(
        np.testing.assert_array_equal, rare_events.load_starts(tmp_path / "set", pmdp, about), one
    )
    with pytest.raises(ValueError, match="variant is 'N=3'; it must be one of 'N=8'"):
        rare_events.load_starts(tmp_path / "set", pmdp, about | {"variant": "N=8"})
    for count in (0, 1.5, None, 2):
        storage.save(tmp_path / "set", rare_events.STARTS, one, about | {"count": count})
        with pytest.raises(ValueError, match=r"set.*it must be"):
            rare_events.load_starts(tmp_path / "set", pmdp, about)


def test_the_search_for_worst_starts_descends_from_many_and_keeps_none_twice():
    params = jam.make_params(3)
    keys = jax.random.split(jax.random.key(0), 6)
    starts = jax.vmap(jam.reset, (0, None))(keys, params)
    often = np.asarray([4, 0, 4, 1, 1, 5])
    once = rare_events.distinct(jax.tree.map(lambda a: a[often], starts))
    first = jax.tree.map(lambda a: a[np.asarray([4, 0, 1, 5])], starts)
    jax.tree.map(np.testing.assert_array_equal, once, first)

    played = []

    def stage(key, paths, pmdp, level):
        played.append(paths.states)
        return paths._replace(crashed=paths.states.body.position[:, 0] > 0)

    pmdp = types.SimpleNamespace(env=jam, params=params, x=np.float32(0))
    subject = Subject(pmdp, None, stage)
    sizes = {"generations": 2, "population": 10, "tries": 1, "kept": 3}
    config = RareConfig(checks=1, **sizes)
    known = jax.tree.map(lambda a: jax.numpy.repeat(a[:2], 50, axis=0), starts)
    found = rare_events.worst_starts(jax.random.key(1), subject, known, config)
    assert found.time.shape == (3,)
    assert rare_events.distinct(found).time.shape == (3,)
    begun = np.asarray(played[0].obstacles.position)
    for start in np.asarray(starts.obstacles.position[:2]):  # both, and fresh ones beside them
        assert (begun == start).all(axis=(1, 2)).sum() == 1
    assert len(begun) == 10


def test_offspring_differ_from_their_parent_in_some_obstacles():
    params = jam.make_params(8)
    parent = jam.reset(jax.random.key(0), params)
    fresh = jam.reset(jax.random.key(1), params)
    child = rare_events.offspring(jax.random.key(2), parent, fresh, 0.5)
    same = np.asarray((child.obstacles.position == parent.obstacles.position).all(-1))
    other = np.asarray((child.obstacles.position == fresh.obstacles.position).all(-1))
    assert (same ^ other).all()
    assert same.any()
    assert other.any()
    alone = circuit.make_params(circle_plan())
    first, second = (circuit.reset(jax.random.key(i), alone) for i in (0, 1))
    for share, wanted in ((0.0, first), (1.0, second)):
        jax.tree.map(
            np.testing.assert_array_equal,
            rare_events.offspring(jax.random.key(3), first, second, share),
            wanted,
        )
