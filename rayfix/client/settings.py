"""Address of the service and options of requests, for both clients."""

from dataclasses import dataclass, field
from urllib.parse import urlencode, urlsplit

from rayfix.client.retries import RetryPolicy
from rayfix.errors import ClientError


@dataclass(frozen=True, kw_only=True)
class ClientSettings:
    """Settings of a client.

    Attributes
    ----------
    url : str
        Address of the service, such as ``http://localhost:8000``.
    api_key : str or None
        Sent as ``Authorization: Bearer``.
    table : str or None
        Name of the table, if the service has several.
    track : bool or None
        Whether to track targets; None for the service's default.
    timeout : float, s
        Time limit for connecting and for each read.
    retries : RetryPolicy
    """

    url: str
    api_key: str | None = field(default=None, repr=False)
    table: str | None = None
    track: bool | None = None
    timeout: float = 30.0
    retries: RetryPolicy = field(default_factory=RetryPolicy)

    def __post_init__(self) -> None:
        """Refuse what is not an address."""
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.netloc or parts.query or parts.fragment:
            raise ClientError(f"url {self.url!r} is not the address of a service; give e.g. http://localhost:8000")

    @property
    def base(self) -> str:
        """Address without the slash at its end."""
        return self.url.rstrip("/")

    @property
    def headers(self) -> dict[str, str]:
        """Headers of every request."""
        return {} if self.api_key is None else {"authorization": f"Bearer {self.api_key}"}

    @property
    def table_query(self) -> dict[str, str]:
        """Query of requests about a table."""
        return {} if self.table is None else {"table": self.table}

    @property
    def position_query(self) -> dict[str, str]:
        """Query of reports."""
        return self.table_query | ({} if self.track is None else {"track": str(self.track).lower()})

    @property
    def stream_url(self) -> str:
        """Address of the web socket."""
        query = urlencode(self.position_query)
        return "ws" + self.base.removeprefix("http") + "/v1/stream" + (query and "?") + query

    def feed_query(self, target_id: str | None) -> dict[str, str]:
        """Query of the feed of fixes."""
        return self.table_query | ({} if target_id is None else {"target_id": target_id})
