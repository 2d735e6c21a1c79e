"""Locate from an MQTT broker until a signal."""

import asyncio
import logging
import signal
from pathlib import Path

from rayfix_service.adapters.adapted import check_stations
from rayfix_service.adapters.mqtt.session import check_settings, run_mqtt
from rayfix_service.adapters.mqtt.settings import Broker, MqttSettings
from rayfix_service.locator import Locator
from rayfix_service.process_wide import logged_to_stderr
from rayfix_tables.checked import open_checked

_log = logging.getLogger(__name__)


@logged_to_stderr()
def serve_mqtt(table_path: Path, broker: Broker, settings: MqttSettings) -> None:
    """Locate from a broker until the process receives SIGINT or SIGTERM.

    Raises
    ------
    TableError
        When the table is missing, of another format, or damaged.
    ReportError
        When the map of stations names one that the table does not have.
    BrokerError
        When a setting is out of range, or the broker cannot be used.
    """
    check_settings(settings)
    table = open_checked(table_path)
    check_stations(settings.stations, table.parts)
    _log.info("loading %s", table_path)
    locator = Locator(table)
    locator.warm_up()
    asyncio.run(_until_signalled(locator, broker, settings))


async def _until_signalled(locator: Locator, broker: Broker, settings: MqttSettings) -> None:
    loop = asyncio.get_running_loop()
    work = asyncio.ensure_future(run_mqtt(locator, broker, settings))
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, work.cancel)
    try:
        await work
    except asyncio.CancelledError:
        _log.info("ending after a signal")
