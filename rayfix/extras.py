"""One clear message for a missing optional dependency."""

from collections.abc import Iterator
from contextlib import contextmanager

from rayfix.errors import MissingExtraError


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Raise an error that names the extra to install, if an import in the context fails.

    Raises
    ------
    MissingExtraError
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in {
            "rayfix",
            "rayfix_evaluation",
            "rayfix_offline",
            "rayfix_service",
            "rayfix_tables",
        }:
            raise
        raise MissingExtraError(
            f"the module '{error.name}' is not installed; install it with: pip install 'rayfix[{extra}]'"
        ) from error
