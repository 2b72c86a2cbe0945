"""Imports of a library that is noisy about it."""

import contextlib
import io
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """For brax: it prints which of its engines are missing, and warns of its and others' age.

    Raises:
        ImportError: what is imported inside is not there; the message says what to install.
    """
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except ImportError as error:
            raise ImportError("rp_jax.adapters needs brax (pip install brax)") from error
