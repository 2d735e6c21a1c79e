"""What one application has while it runs, for its routes."""

from dataclasses import dataclass

from starlette.datastructures import State
from starlette.requests import HTTPConnection

from rayfix_service.http.answering.broker_state import BrokerState
from rayfix_service.http.answering.feed import FixFeed
from rayfix_service.http.answering.feed_relay import FeedRelay
from rayfix_service.http.answering.locating import Answerer
from rayfix_service.http.answering.served_tables import Tables
from rayfix_service.http.answering.slow_work import SlowWork
from rayfix_service.http.answering.table_cache import TableCache
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.http.telemetry.metrics import Metrics


@dataclass(frozen=True, kw_only=True)
class Services:
    """The parts of a running application that routes use.

    Attributes
    ----------
    settings : ServiceSettings
    metrics : Metrics
    tables : Tables
        Those that are served, ready or not.
    answerer : Answerer
        Locates reports.
    slow_work : SlowWork
        Threads for what takes longer than the event loop may be held.
    table_cache : TableCache
        Results that follow from a table alone.
    feed : FixFeed
        Tells listeners of fixes.
    relay : FeedRelay or None
        Passes fixes between the workers of one service; None for a single process.
    broker : BrokerState or None
        Whether the MQTT broker is connected; None for a service that reads none.
    """

    settings: ServiceSettings
    metrics: Metrics
    tables: Tables
    answerer: Answerer
    slow_work: SlowWork
    table_cache: TableCache
    feed: FixFeed
    relay: FeedRelay | None
    broker: BrokerState | None = None


def set_services(state: State, services: Services) -> None:
    """Put the services where :func:`services_of` finds them."""
    state.services = services


def services_in(state: State) -> Services:
    """Return the services of an application by its state."""
    services: Services = state.services
    return services


def services_of(connection: HTTPConnection) -> Services:
    """Return the services of the application that serves a connection."""
    return services_in(connection.app.state)
