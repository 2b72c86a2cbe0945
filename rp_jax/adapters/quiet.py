"""Imports of libraries that print and warn while they are imported."""

import contextlib
import io
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Silences the prints and warnings of brax, about missing engines and old versions.

    Raises:
        ImportError: a module imported inside is missing; the message says what to install.
    """
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except ImportError as error:
            raise ImportError("rp_jax.adapters needs brax (pip install brax)") from error
