"""Which MQTT broker is read, and how; needs no extra."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from rayfix_service.adapters.formats import OutputFormat
from rayfix_service.adapters.omlox_hub import HubSettings
from rayfix_service.adapters.silabs_stream import PAYLOAD_BYTES
from rayfix_service.fusion.measurements.report import Frame, Height
from rayfix_tables.errors import RayfixError


class BrokerError(RayfixError):
    """The MQTT broker cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Broker:
    """Address of the broker, and the credentials for it."""

    host: str
    port: int = 1883
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: bool = False

    @property
    def address(self) -> str:
        """Host and port."""
        return f"{self.host}:{self.port}"


@dataclass(frozen=True, kw_only=True)
class MqttSettings:
    """What is read, how it is joined, and what is published.

    Attributes
    ----------
    topic : str
        Topic filter of locators' angles; topics must end in ``<locator>/<tag>``.
    publish : str
        Topic of positions; ``{target_id}`` stands for the tag.
    output : {"native", "3gpp", "omlox"}
        Format of positions.
    window : float, s
        How long a packet waits for more locators.
    stations : Mapping
        Stations by locator, for those that are not stations' identifiers.
    frame : {"lcs", "scene", "north"}
        Frame of the angles.
    height : Height or None
        What is known of the height of all tags.
    confidence : float or None
        Probability with which the accuracies of positions are to hold; None for 0.68.
    track : bool
        Whether tags are followed from packet to packet.
    hub : HubSettings or None
        Omlox hub that all positions are sent to as well.
    payload_bytes : int
        Longest message that is read.
    """

    topic: str = "silabs/aoa/angle/+/+"
    publish: str = "rayfix/position/{target_id}"
    output: OutputFormat = "native"
    window: float = 0.5
    stations: Mapping[str, str] = field(default_factory=dict)
    frame: Frame = "lcs"
    height: Height | None = None
    confidence: float | None = None
    track: bool = False
    hub: HubSettings | None = None
    payload_bytes: int = PAYLOAD_BYTES


@dataclass(frozen=True, kw_only=True)
class MqttSource:
    """A broker that a service reads.

    Attributes
    ----------
    broker : Broker
    settings : MqttSettings
        Its hub is not asked: the service has one.
    table : str or None
        Name of the table that answers; None for the only one, or that named ``default``.
    """

    broker: Broker
    settings: MqttSettings = field(default_factory=MqttSettings)
    table: str | None = None


def parse_broker(text: str, *, tls: bool = False, username: str | None = None, password: str | None = None) -> Broker:
    """Read ``HOST`` or ``HOST:PORT``; the port is 1883, or 8883 with TLS, unless given.

    Raises
    ------
    BrokerError
        For anything else.
    """
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or parts.path or parts.query or parts.fragment or "@" in text:
        raise BrokerError(f"broker {text!r} is not an address; give HOST or HOST:PORT, e.g. localhost:1883")
    return Broker(host=host, port=port or (8883 if tls else 1883), username=username, password=password, tls=tls)
