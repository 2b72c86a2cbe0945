import re
from pathlib import Path

import jax
from quick import compile_soon  # noqa: F401

TEXT = (Path(__file__).parents[2] / "docs" / "adapters.md").read_text()


def test_what_the_docs_show_runs():
    snippets = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert len(snippets) == 5
    with jax.numpy_rank_promotion("allow"):
        exec("\n".join(snippets), {})
