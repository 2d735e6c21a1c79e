"""Files that cannot be used."""

from collections.abc import Callable
from pathlib import Path

import pytest


def refusal(kind: type[Exception], read: Callable[[Path], object], path: Path) -> str:
    """Check that reading a file is refused with an error of exactly this kind, in one line that names the file.

    Returns that line.
    """
    with pytest.raises(kind) as caught:
        read(path)
    assert type(caught.value) is kind
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message
