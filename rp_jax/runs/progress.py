"""How jobs tell how far they are: callbacks that a caller gives."""

from collections.abc import Callable, Mapping
from typing import Any

# (stage, done, total, note): called when something of a stage is done. `print` will do.
OnProgress = Callable[[str, int, int, str], None]
# A row of facts, such as one of metrics.jsonl: `wandb.log` or `print` will do.
OnMetrics = Callable[[Mapping[str, Any]], None]


def silent(*_: Any) -> None:
    """Does nothing, in place of a callback.

    Args:
        *_: not used.
    """
