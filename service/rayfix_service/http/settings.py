"""How the service is to behave, apart from which tables it serves."""

from dataclasses import dataclass, field
from pathlib import Path

from rayfix_service.adapters.mqtt.settings import MqttSource
from rayfix_service.adapters.omlox_hub import HubSettings
from rayfix_service.wire.limits import MessageLimits
from rayfix_tables.checked import CheckLimits


@dataclass(frozen=True, kw_only=True)
class BodyLimits:
    """How long a request may be, bytes."""

    report: int = 1 << 20
    batch: int = 16 << 20


@dataclass(frozen=True, kw_only=True)
class ConnectionLimits:
    """What a connection may cost, whoever opened it.

    Attributes
    ----------
    connections : int
        Open connections of a worker, web sockets among them. With more, the one that has waited longest for a request
        is closed; where none waits, only ``/livez`` answers. Fewer where the process may not open that many files.
    head_bytes, head_fields : int
        Longest head of a request, request line and header fields, and most fields.
    head_seconds, body_seconds : float
        Time for a head, from the first byte or the begin of the connection, and for the body after it.
    idle_seconds : float
        Time between two requests.
    unread_seconds : float
        Time that a client may leave an answer unread, all buffers being full.
    """

    connections: int = 1000
    head_bytes: int = 32 << 10
    head_fields: int = 100
    head_seconds: float = 10.0
    body_seconds: float = 60.0
    idle_seconds: float = 5.0
    unread_seconds: float = 30.0


@dataclass(frozen=True, kw_only=True)
class FeedLimits:
    """What the listeners of the feed of fixes may cost a worker.

    Attributes
    ----------
    listeners : int
        At a time; more are refused.
    backlog_bytes : int
        Fixes that wait for one listener; the oldest are dropped beyond it.
    """

    listeners: int = 100
    backlog_bytes: int = 2 << 20


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """Settings of one application.

    Attributes
    ----------
    body_limits : BodyLimits
    message_limits : MessageLimits
    connection_limits : ConnectionLimits
    feed_limits : FeedLimits
    api_keys : pathlib.Path, optional
        File of the API keys; without it, none is required.
    reports_per_second : float, optional
        Reports that each key may send a second, on average over ``burst_seconds``.
    burst_seconds : float
    cors_origins : tuple of str
        Origins such as ``https://maps.example.com`` whose pages may call the service from a browser.
    hosts : tuple of str
        Names by which a service without keys may be called, besides loopback addresses; empty where any will do.
    root_path : str
        Path below which a proxy offers the service, such as ``/rayfix``; empty for none.
    trust_forwarded_prefix : bool
        Whether the header ``X-Forwarded-Prefix`` names that path. Only for services that a proxy alone can reach.
    quick_fix_seconds : float
        A fix that takes no longer than this, by an estimate from its report, is made on the event loop; the others, the
        slow ones, are made in threads. One that takes over twice as long on the event loop is stopped there, and made
        anew in a thread.
    fix_seconds : float
        Time limit of a slow fix.
    slow_fix_threads, slow_fixes_waiting : int
        Slow fixes that are computed at a time, and that may wait for it.
    watch_seconds : float
        Time between two looks at the files of the tables and keys.
    table_check : CheckLimits
        Time and memory that the check of a table may take.
    track : bool
        Whether targets are followed by default, where the request has no parameter for it.
    hub : HubSettings, optional
        Omlox hub that all positions are sent to.
    mqtt : MqttSource, optional
        MQTT broker whose packets are located, by one of the workers.
    simulation : bool
        Whether ``POST /v1/simulations`` answers.
    own_process : bool
        Whether the process does nothing else. Its garbage collector then leaves alone what is there once it is ready,
        so that requests wait less for it.
    runtime_folder : pathlib.Path, optional
        Common folder of the workers of one service; none for a single process.
    """

    body_limits: BodyLimits = field(default_factory=BodyLimits)
    message_limits: MessageLimits = field(default_factory=MessageLimits)
    connection_limits: ConnectionLimits = field(default_factory=ConnectionLimits)
    feed_limits: FeedLimits = field(default_factory=FeedLimits)
    api_keys: Path | None = None
    reports_per_second: float | None = None
    burst_seconds: float = 2.0
    cors_origins: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    root_path: str = ""
    trust_forwarded_prefix: bool = False
    quick_fix_seconds: float = 0.005
    fix_seconds: float = 10.0
    slow_fix_threads: int = 2
    slow_fixes_waiting: int = 32
    watch_seconds: float = 2.0
    table_check: CheckLimits = field(default_factory=CheckLimits)
    track: bool = False
    hub: HubSettings | None = None
    mqtt: MqttSource | None = None
    simulation: bool = False
    own_process: bool = False
    runtime_folder: Path | None = None

    @property
    def has_several_workers(self) -> bool:
        """Whether the process is one of several that answer for one service."""
        return self.runtime_folder is not None
