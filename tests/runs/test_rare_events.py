import functools
import types

import jax
import numpy as np
import pytest

from examples.drone import world as drone
from rp_jax import storage
from rp_jax.envs import circuit, jam, optional
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


def test_worst_starts_serve_in_another_precision(tmp_path):
    pmdp = types.SimpleNamespace(env=jam, params=jam.make_params(3))
    about = {"env": "jam", "variant": "N=3"}
    one = jax.tree.map(lambda a: a[None], jam.reset(jax.random.key(0), pmdp.params))
    storage.save(tmp_path, rare_events.STARTS, one, about | {"count": 1})
    with jax.enable_x64(True):
        double = types.SimpleNamespace(env=jam, params=jam.make_params(3))
        with pytest.warns(storage.PrecisionWarning, match="saved with jax_enable_x64=False"):
            found = rare_events.load_starts(tmp_path, double, about)
        assert found.body.position.dtype == np.float64
        np.testing.assert_array_equal(found.body.position, one.body.position)


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


def test_children_differ_from_their_parent_in_some_obstacles():
    params = jam.make_params(8)
    keys = jax.random.split(jax.random.key(2), 200)
    parent, fresh = (jam.reset(jax.random.key(i), params) for i in (0, 1))
    child = jax.vmap(lambda key: optional.mixed_start(jam, key, parent, fresh))(keys)
    place, *places = (np.asarray(s.obstacles.position) for s in (child, parent, fresh))
    same, other = ((place == known).all(axis=-1) for known in places)
    assert (same ^ other).all()
    assert 0.15 < other.mean() < 0.25  # 1,600 draws of .2
    assert (other.any(axis=1) & same.any(axis=1)).mean() > 0.7  # 1 - .2^8 - .8^8 = .83


def test_children_in_a_world_without_such_parts_are_one_start_or_the_other():
    keys = jax.random.split(jax.random.key(3), 400)
    for env in (circuit, drone):  # the drone has obstacles of three kinds, and does not say
        params = env.make_params()
        first, second = (env.reset(jax.random.key(i), params) for i in (0, 1))
        mixed = jax.vmap(functools.partial(optional.mixed_start, env), (0, None, None))
        found = mixed(keys, first, second)
        rows = [
            jax.tree.map(lambda a, b: (a == b[None]).reshape(400, -1).all(axis=1), found, start)
            for start in (first, second)
        ]
        of_first, of_second = (np.all(jax.tree.leaves(of), axis=0) for of in rows)
        assert (of_first ^ of_second).all()
        assert 0.12 < of_second.mean() < 0.28


def test_worst_starts_are_found_in_a_world_of_ones_own():
    params = drone.make_params()
    stage = lambda key, paths, pmdp, level: paths._replace(  # noqa: E731
        crashed=paths.states.body.position[:, 0] > 0
    )
    subject = Subject(types.SimpleNamespace(env=drone, params=params, x=np.float32(0)), None, stage)
    config = RareConfig(generations=2, population=10, tries=1, kept=3, checks=1)
    found = rare_events.worst_starts(jax.random.key(1), subject, None, config)
    assert found.time.shape == (3,)
