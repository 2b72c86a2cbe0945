"""Whole runs of the experiments, as small as they get."""

from contextlib import contextmanager

import jax
import pytest
from quick import unoptimised

from experiments import circuit, jam, point_gather
from rp_jax.cli import experiment

MODULES = {"circuit": circuit, "jam": jam, "point_gather": point_gather}
KINDS = {"circuit": ["wall"], "jam": ["wall", "obstacle"], "point_gather": ["bomb"]}
TINY_FIT = "--{0}.fit.steps 40 --{0}.fit.batch 64 --{0}.fit.hidden 16"
TINY_THREAT = "--{0}.states 200 --{0}.paths 4 --{0}.test-states 200 --{0}.test-paths 8 " + TINY_FIT
TINY = (
    "--planning.steps 480 --planning.num-envs 8 --planning.batch 32 --planning.replay 512 "
    "--planning.replay-start 64 --planning.n-step 2 --episodes 16 --seeds 2 --x 0.9"
)


@contextmanager
def moment():
    """Programs that run for a moment need no optimising; flashbax needs rank promotion."""
    with unoptimised(), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(autouse=True, scope="module")
def programs_of_a_moment():
    """For all tests of a module that imports this."""
    with moment():
        yield


def go(name, out, *options):
    module = MODULES[name]
    argv = " ".join([TINY, *(TINY_THREAT.format(kind) for kind in KINDS[name]), *options]).split()
    argv += ["--out", str(out)]
    assert experiment.run(module.EXPERIMENT, argv) == out
    return out
