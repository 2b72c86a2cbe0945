import types

import numpy as np

from rp_jax.runs.plan import Training


def test_a_penalty_rises_from_its_first_value_and_is_there_half_way():
    pmdp = types.SimpleNamespace(penalty=np.asarray([5.0, 50.0]))
    pmdp.replace = lambda penalty: types.SimpleNamespace(penalty=penalty)
    constant = Training(pmdp, (), None, 0.0, None, None, None, None)
    assert constant.during(pmdp, 0.3) is pmdp
    rising = constant._replace(learning_penalty_from=5.0)
    expected = {0.0: 5.0, 0.25: 27.5, 0.5: 50.0, 0.9: 50.0}
    for share, penalty in expected.items():
        np.testing.assert_allclose(rising.during(pmdp, share).penalty, [5.0, penalty])
