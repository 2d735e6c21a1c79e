"""How the service is to behave, apart from which tables it serves."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class BodyLimits:
    """How long a request may be, bytes."""

    report: int = 1 << 20
    batch: int = 16 << 20


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """Settings of one application.

    Attributes
    ----------
    body_limits : BodyLimits
    watch_seconds : float
        Time between two looks at the files of the tables.
    simulation : bool
        Whether ``POST /v1/simulations`` answers.
    runtime_folder : pathlib.Path, optional
        Folder that the workers of one service share; none for a single process.
    """

    body_limits: BodyLimits = field(default_factory=BodyLimits)
    watch_seconds: float = 2.0
    simulation: bool = False
    runtime_folder: Path | None = None
