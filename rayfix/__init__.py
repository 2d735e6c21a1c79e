"""rayfix: indoor position fixes from angles and times of arrival, fused with a digital twin.

>>> import rayfix
>>> table = rayfix.build("site.toml")                # or rayfix.Table.open("site.h5")
>>> fix = rayfix.Locator(table).locate(report)       # a rayfix.Report or a dict of the HTTP interface's JSON

The offline half needs the extra ``rayfix[offline]``, the fusion ``rayfix[service]``, asking a service over the network
``rayfix[client]``; reading tables needs none.
"""

from typing import TYPE_CHECKING, Any

from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table
from rayfix_tables.version import software_version

if TYPE_CHECKING:
    from rayfix.api import Locator as Locator
    from rayfix.api import Tracker as Tracker
    from rayfix.api import build as build
    from rayfix.client import AsyncClient as AsyncClient
    from rayfix.client import Client as Client
    from rayfix_service.fusion.measurements.report import Report as Report
    from rayfix_service.fusion.posterior.fix import Fix as Fix
    from rayfix_service.fusion.posterior.posterior import Posterior as Posterior
    from rayfix_service.measuring.impulse_response import range_from_impulse_response as range_from_impulse_response
    from rayfix_service.measuring.ranging import range_from_round_trip as range_from_round_trip
    from rayfix_service.measuring.ranging import range_from_rssi as range_from_rssi
    from rayfix_service.measuring.ranging import range_from_times as range_from_times

__version__ = software_version()

__all__ = [
    "AsyncClient",
    "Client",
    "Fix",
    "Locator",
    "Posterior",
    "RayfixError",
    "Report",
    "Table",
    "Tracker",
    "__version__",
    "build",
    "range_from_impulse_response",
    "range_from_round_trip",
    "range_from_rssi",
    "range_from_times",
]


def __getattr__(name: str) -> Any:
    """Import what needs an extra when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'rayfix' has no attribute '{name}'")
    if name in ("AsyncClient", "Client"):
        from rayfix import client

        return getattr(client, name)
    from rayfix import api

    return getattr(api, name)
