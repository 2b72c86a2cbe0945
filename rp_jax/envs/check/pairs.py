"""The functions of a kind of hazard, for many bodies and hazards at once."""

from typing import Any

import numpy as np
from jax import Array

from rp_jax.envs.check.batches import Batched, RandomDraws, typed
from rp_jax.hazards import is_static


class Pairs:
    """The functions of one kind of hazard, compiled for batches of (body, hazard) pairs."""

    def __init__(self, env: Any, params: Any, kind: str, draws: RandomDraws) -> None:
        """Prepares the functions; each is compiled when it is first called.

        Args:
            env: the environment.
            params: its parameters.
            kind: of hazard.
            draws: the random numbers.
        """
        self.params, self.kind, self.draws = params, kind, draws
        self.source = env.sub_rmdps(params)[kind].source
        self.static = bool(is_static(self.source))
        self.horizon = int(self.source.horizon)

        def sub(params: Any) -> Any:
            return env.sub_rmdps(params)[kind]

        def look(params: Any, body: Any, hazard: Any) -> tuple[Array, Array, Array]:
            source = sub(params).source
            hit, reach = source.hits(body, hazard), source.in_reach(body, hazard)
            return source.features(body, hazard), hit, reach

        def drift(params: Any, key: Any, hazard: Any, body: Any) -> Any:
            source = sub(params).source
            return source.step(hazard, body, source.draw(typed(key)))

        def sample(params: Any, key: Any) -> tuple[Any, Any]:
            return sub(params).source.sample(typed(key), sub(params).body)

        self._look, self._drift, self._sample = Batched(look), Batched(drift), Batched(sample)
        self._restore = Batched(lambda params, row: sub(params).source.state_of(row))
        self._mirror = Batched(lambda params, row: sub(params).source.mirrored(row))

    def look(self, bodies: Any, hazards: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns (features (n, F), hits (n,), in_reach (n,)) of pairs (n, ...).

        Args:
            bodies: states, leading axis (n,).
            hazards: states, leading axis (n,).
        """
        return self._look(self.params, bodies, hazards)

    def features(self, bodies: Any, hazards: Any) -> np.ndarray:
        """Returns the features (n, F) of pairs (n, ...).

        Args:
            bodies: states, leading axis (n,).
            hazards: states, leading axis (n,).
        """
        return self.look(bodies, hazards)[0]

    def drift(self, keys: np.ndarray, hazards: Any, bodies: Any) -> Any:
        """Returns where the source takes hazards (n, ...) in a step, with a random key each.

        Args:
            keys: (n, ...) data of random keys.
            hazards: states, leading axis (n,).
            bodies: states, leading axis (n,).
        """
        return self._drift(self.params, keys, hazards, bodies)

    def sample(self, count: int) -> tuple[Any, Any]:
        """Returns so many (body, hazard) pairs that the source draws.

        Args:
            count: how many.
        """
        return self._sample(self.params, self.draws.keys(count))

    def restore(self, features: np.ndarray) -> tuple[Any, Any]:
        """Returns pairs (n, ...) that `state_of` makes of features (n, F).

        Args:
            features: of the pairs.
        """
        return self._restore(self.params, features)

    def mirror(self, features: np.ndarray) -> np.ndarray:
        """Returns the mirrored features (n, F).

        Args:
            features: to be mirrored.
        """
        return self._mirror(self.params, features)
