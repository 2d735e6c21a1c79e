"""rayfix: indoor position fixes from angles and times of arrival, fused with a digital twin.

>>> import rayfix
>>> table = rayfix.build("site.toml")                # or rayfix.Table.open("site.h5")
>>> fix = rayfix.Locator(table).locate(report)       # a rayfix.Report or a dict of the HTTP interface's JSON

The public API consists of the names in ``__all__`` of this package and of :mod:`rayfix.client`. Everything else,
including the packages ``rayfix_*``, may change without notice. The names are

- the table: ``build``, ``Table``;
- a report and its parts: ``Report``, ``Angle``, ``Range``, ``LogRange``, ``TimeOfArrival``, ``TimeDifference``,
  ``MeasuredPath`` (``Measurement`` is any of them), ``Height``, ``ErrorModel``, ``GAUSSIAN``, ``HEAVY_TAILED``,
  ``Frame``, and the functions ``range_from_...`` and ``paths_from_impulse_response`` with their results
  ``RangeEstimate``, ``LogRangeEstimate`` and ``PathEstimate``;
- the fusion and its answer: ``Locator``, ``FusionSettings``, ``Fix``, ``Status``, ``Candidate``, ``Outcome``,
  ``CredibleRegions``, ``Posterior``, ``Fused``; ``Stop`` ends a fix early, by ``FixStoppedError``;
- tracks: ``Tracker``, ``TrackingSettings``, ``MotionModel``, ``DriftModel``, ``TrackedPosition``, ``TrackState``,
  ``Estimate``;
- a service over the network: ``Client``, ``AsyncClient``, ``RetryPolicy``;
- the errors, drawn as a tree in :mod:`rayfix.errors`.

Builds need the extra ``rayfix[offline]``, the fusion ``rayfix[service]``, and the clients ``rayfix[client]``. Tables,
reports and errors need no extra.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rayfix.errors import (
    AnswerError,
    BuildError,
    ClientError,
    CorruptTableError,
    FormatVersionError,
    MissingExtraError,
    NotATableError,
    ProblemError,
    ProblemField,
    RayfixError,
    RefusedReportError,
    ReportError,
    SceneError,
    SettingsError,
    SiteError,
    TableError,
    UnreachableError,
    ViewError,
)
from rayfix.extras import needs_extra
from rayfix_tables.table import Table
from rayfix_tables.version import software_version

if TYPE_CHECKING:
    from rayfix.api import build as build
    from rayfix.client import AsyncClient as AsyncClient
    from rayfix.client import Client as Client
    from rayfix.client import RetryPolicy as RetryPolicy
    from rayfix_service.adapters.mqtt.settings import BrokerError as BrokerError
    from rayfix_service.adapters.omlox_hub import HubError as HubError
    from rayfix_service.fusion.measurements.report import GAUSSIAN as GAUSSIAN
    from rayfix_service.fusion.measurements.report import HEAVY_TAILED as HEAVY_TAILED
    from rayfix_service.fusion.measurements.report import Angle as Angle
    from rayfix_service.fusion.measurements.report import ErrorModel as ErrorModel
    from rayfix_service.fusion.measurements.report import Frame as Frame
    from rayfix_service.fusion.measurements.report import Height as Height
    from rayfix_service.fusion.measurements.report import LogRange as LogRange
    from rayfix_service.fusion.measurements.report import MeasuredPath as MeasuredPath
    from rayfix_service.fusion.measurements.report import Measurement as Measurement
    from rayfix_service.fusion.measurements.report import Range as Range
    from rayfix_service.fusion.measurements.report import Report as Report
    from rayfix_service.fusion.measurements.report import TimeDifference as TimeDifference
    from rayfix_service.fusion.measurements.report import TimeOfArrival as TimeOfArrival
    from rayfix_service.fusion.posterior.credible import CredibleRegions as CredibleRegions
    from rayfix_service.fusion.posterior.fix import Candidate as Candidate
    from rayfix_service.fusion.posterior.fix import Fix as Fix
    from rayfix_service.fusion.posterior.fix import Outcome as Outcome
    from rayfix_service.fusion.posterior.fix import Status as Status
    from rayfix_service.fusion.posterior.fused import Fused as Fused
    from rayfix_service.fusion.posterior.posterior import Posterior as Posterior
    from rayfix_service.fusion.settings import FusionSettings as FusionSettings
    from rayfix_service.fusion.stopping import FixStoppedError as FixStoppedError
    from rayfix_service.fusion.stopping import Stop as Stop
    from rayfix_service.http.errors import ServiceError as ServiceError
    from rayfix_service.locator import Locator as Locator
    from rayfix_service.measuring.impulse_response import PathEstimate as PathEstimate
    from rayfix_service.measuring.impulse_response import paths_from_impulse_response as paths_from_impulse_response
    from rayfix_service.measuring.impulse_response import range_from_impulse_response as range_from_impulse_response
    from rayfix_service.measuring.ranging import LogRangeEstimate as LogRangeEstimate
    from rayfix_service.measuring.ranging import RangeEstimate as RangeEstimate
    from rayfix_service.measuring.ranging import range_from_round_trip as range_from_round_trip
    from rayfix_service.measuring.ranging import range_from_rssi as range_from_rssi
    from rayfix_service.measuring.ranging import range_from_times as range_from_times
    from rayfix_service.tracking.drift import DriftModel as DriftModel
    from rayfix_service.tracking.motion import MotionModel as MotionModel
    from rayfix_service.tracking.settings import TrackingSettings as TrackingSettings
    from rayfix_service.tracking.track import Estimate as Estimate
    from rayfix_service.tracking.track import TrackedPosition as TrackedPosition
    from rayfix_service.tracking.track import TrackState as TrackState
    from rayfix_service.tracking.tracker import Tracker as Tracker

__version__ = software_version()

__all__ = [
    "GAUSSIAN",
    "HEAVY_TAILED",
    "Angle",
    "AnswerError",
    "AsyncClient",
    "BrokerError",
    "BuildError",
    "Candidate",
    "Client",
    "ClientError",
    "CorruptTableError",
    "CredibleRegions",
    "DriftModel",
    "ErrorModel",
    "Estimate",
    "Fix",
    "FixStoppedError",
    "FormatVersionError",
    "Frame",
    "Fused",
    "FusionSettings",
    "Height",
    "HubError",
    "Locator",
    "LogRange",
    "LogRangeEstimate",
    "MeasuredPath",
    "Measurement",
    "MissingExtraError",
    "MotionModel",
    "NotATableError",
    "Outcome",
    "PathEstimate",
    "Posterior",
    "ProblemError",
    "ProblemField",
    "Range",
    "RangeEstimate",
    "RayfixError",
    "RefusedReportError",
    "Report",
    "ReportError",
    "RetryPolicy",
    "SceneError",
    "ServiceError",
    "SettingsError",
    "SiteError",
    "Status",
    "Stop",
    "Table",
    "TableError",
    "TimeDifference",
    "TimeOfArrival",
    "TrackState",
    "TrackedPosition",
    "Tracker",
    "TrackingSettings",
    "UnreachableError",
    "ViewError",
    "__version__",
    "build",
    "paths_from_impulse_response",
    "range_from_impulse_response",
    "range_from_round_trip",
    "range_from_rssi",
    "range_from_times",
]

_LAZY = {
    ("rayfix_service.fusion.measurements.report", "service"): (
        "GAUSSIAN",
        "HEAVY_TAILED",
        "Angle",
        "ErrorModel",
        "Frame",
        "Height",
        "LogRange",
        "MeasuredPath",
        "Measurement",
        "Range",
        "Report",
        "TimeDifference",
        "TimeOfArrival",
    ),
    ("rayfix_service.fusion.settings", "service"): ("FusionSettings",),
    ("rayfix_service.fusion.stopping", "service"): ("FixStoppedError", "Stop"),
    ("rayfix_service.fusion.posterior.fix", "service"): ("Candidate", "Fix", "Outcome", "Status"),
    ("rayfix_service.fusion.posterior.credible", "service"): ("CredibleRegions",),
    ("rayfix_service.fusion.posterior.posterior", "service"): ("Posterior",),
    ("rayfix_service.fusion.posterior.fused", "service"): ("Fused",),
    ("rayfix_service.locator", "service"): ("Locator",),
    ("rayfix_service.tracking.drift", "service"): ("DriftModel",),
    ("rayfix_service.tracking.motion", "service"): ("MotionModel",),
    ("rayfix_service.tracking.settings", "service"): ("TrackingSettings",),
    ("rayfix_service.tracking.track", "service"): ("Estimate", "TrackState", "TrackedPosition"),
    ("rayfix_service.tracking.tracker", "service"): ("Tracker",),
    ("rayfix_service.measuring.ranging", "service"): (
        "LogRangeEstimate",
        "RangeEstimate",
        "range_from_round_trip",
        "range_from_rssi",
        "range_from_times",
    ),
    ("rayfix_service.measuring.impulse_response", "service"): (
        "PathEstimate",
        "paths_from_impulse_response",
        "range_from_impulse_response",
    ),
    ("rayfix_service.http.errors", "service"): ("ServiceError",),
    ("rayfix_service.adapters.mqtt.settings", "mqtt"): ("BrokerError",),
    ("rayfix_service.adapters.omlox_hub", "mqtt"): ("HubError",),
    ("rayfix.api", "offline"): ("build",),
    ("rayfix.client", "client"): ("AsyncClient", "Client", "RetryPolicy"),
}
"""Names by module and the extra that the module needs; a module is imported when one of its names is first used."""

_HOMES = {name: home for home, names in _LAZY.items() for name in names}

if not TYPE_CHECKING:  # for type checkers, names that are not imported above must not exist

    def __getattr__(name: str) -> Any:
        """Import a name that needs an extra when it is first used."""
        if name not in _HOMES:
            raise AttributeError(f"module 'rayfix' has no attribute '{name}'")
        module, extra = _HOMES[name]
        with needs_extra(extra):
            value = getattr(import_module(module), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        """Names for completion."""
        return sorted({*globals(), *__all__})
