"""A service's packets from an MQTT broker, located as requests are. Needs the extra ``rayfix[mqtt]``."""

import asyncio
from collections.abc import Mapping
from typing import Any

from rayfix_service.adapters.adapted import Adapted, check_stations, with_confidence
from rayfix_service.adapters.mqtt.session import MqttSession, angle_stream, check_settings
from rayfix_service.adapters.mqtt.settings import MqttSource
from rayfix_service.http.answering.broker_state import BrokerState
from rayfix_service.http.answering.locating import Answerer, foreign
from rayfix_service.http.answering.response_options import ResponseOptions
from rayfix_service.http.answering.served_tables import ServedTable, Tables
from rayfix_service.http.errors import ServiceError
from rayfix_service.http.problems import ProblemError
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo

_AGAIN_SECONDS = 1.0


def check_source(source: MqttSource, tables: Mapping[str, ServedTable]) -> None:
    """Check the settings of a broker against the tables, before there is a connection.

    Raises
    ------
    BrokerError
        When a setting is out of range.
    ServiceError
        When it is open which table answers, or there is none of that name.
    ReportError
        When the map of stations names one that the table does not have.
    """
    check_settings(source.settings)
    name = source.table
    if name is None:
        name = next(iter(tables)) if len(tables) == 1 else "default"
    if name not in tables:
        raise ServiceError(
            f"packets of the MQTT broker need a table and there is no {name!r}; give --mqtt-table, one of "
            f"{', '.join(tables)}"
        )
    check_stations(source.settings.stations, tables[name].locator.table.parts)


async def listen(source: MqttSource, state: BrokerState, tables: Tables, answerer: Answerer) -> None:
    """Locate the packets of a broker until cancelled, once a table answers and no other worker does.

    Parameters
    ----------
    source : MqttSource
    state : BrokerState
        Of that broker, to be kept.
    tables : Tables
        Each packet is answered from the table that is served then.
    answerer : Answerer
    """
    metrics, settings = answerer.metrics, source.settings
    options = ResponseOptions(output=settings.output, track=settings.track)
    metrics.broker_connected(state.address, False)
    await tables.became_ready.wait()
    async with state.turn():

        async def answer(adapted: Adapted) -> dict[str, Any]:
            try:
                with metrics.reports.timed("mqtt"):
                    table = tables.named(source.table)
                    incoming = foreign(with_confidence(adapted, settings.confidence))
                    return await answerer.answer(table, incoming, options)
            except ProblemError as error:  # too busy, too slow, or the table is gone
                raise ReportError(str(error)) from None

        def connection_changed(connected: bool) -> None:
            state.set(connected)
            metrics.broker_connected(state.address, connected)

        def site() -> SiteInfo:
            try:
                return tables.named(source.table).site
            except ProblemError:  # the answer to a packet says so
                return first

        first = await _site(source, tables)
        session = MqttSession(
            settings=settings,
            stream=angle_stream(first, settings),
            answer=answer,
            on_message=metrics.broker_message,
            site=site,
        )
        try:
            await session.run(source.broker, on_connection=connection_changed, patient=True)
        finally:
            connection_changed(False)


async def _site(source: MqttSource, tables: Tables) -> SiteInfo:
    """Wait for the table of a broker, whose file may be gone for a moment, and return its site."""
    while True:
        try:
            return tables.named(source.table).site
        except ProblemError:
            await asyncio.sleep(_AGAIN_SECONDS)
