import types

import numpy as np

from experiments import circuit, planning


def test_a_penalty_rises_from_its_first_value_and_is_there_half_way():
    pmdp = types.SimpleNamespace(penalty=np.asarray([5.0, 50.0]))
    pmdp.replace = lambda penalty: types.SimpleNamespace(penalty=penalty)
    assert planning.during(pmdp, 0.3, circuit.Config()) is pmdp
    rising = circuit.Config(learning_penalty_from=5.0)
    expected = {0.0: 5.0, 0.25: 27.5, 0.5: 50.0, 0.9: 50.0}
    for share, penalty in expected.items():
        found = planning.during(pmdp, share, rising).penalty
        np.testing.assert_allclose(found, [5.0, penalty])
