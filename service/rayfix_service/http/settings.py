"""How the service is to behave, apart from which tables it serves."""

from dataclasses import dataclass, field
from pathlib import Path

from rayfix_service.adapters.omlox_hub import HubSettings


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
    api_keys : pathlib.Path, optional
        File of the API keys; without it, none is asked for.
    reports_per_second : float, optional
        Reports that each key may send a second, on average over ``burst_seconds``.
    burst_seconds : float
    cors_origins : tuple of str
        Origins such as ``https://maps.example.com`` whose pages may call the service from a browser.
    quick_fix_seconds : float
        A fix that takes no longer than this, by an estimate from its report, is made on the event loop; the others, the
        slow ones, are made in threads.
    fix_seconds : float
        Time limit of a slow fix.
    slow_fix_threads, slow_fixes_waiting : int
        Slow fixes that are computed at a time, and that may wait for it.
    watch_seconds : float
        Time between two looks at the files of the tables and keys.
    track : bool
        Whether targets are followed where a request does not say.
    hub : HubSettings, optional
        Omlox hub that is told of all positions.
    simulation : bool
        Whether ``POST /v1/simulations`` answers.
    own_process : bool
        Whether the process does nothing else. Its garbage collector then leaves alone what is there once it is ready,
        so that requests wait less for it.
    runtime_folder : pathlib.Path, optional
        Folder that the workers of one service share; none for a single process.
    """

    body_limits: BodyLimits = field(default_factory=BodyLimits)
    api_keys: Path | None = None
    reports_per_second: float | None = None
    burst_seconds: float = 2.0
    cors_origins: tuple[str, ...] = ()
    quick_fix_seconds: float = 0.005
    fix_seconds: float = 10.0
    slow_fix_threads: int = 2
    slow_fixes_waiting: int = 32
    watch_seconds: float = 2.0
    track: bool = False
    hub: HubSettings | None = None
    simulation: bool = False
    own_process: bool = False
    runtime_folder: Path | None = None
