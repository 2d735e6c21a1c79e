"""Conversion of NRPPa measurement results (3GPP TS 38.455) into a report."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rayfix_service.adapters.adapted import Adapted, Skipped, adapted_report, station_of
from rayfix_service.adapters.documents import check, one_of, too_much
from rayfix_service.adapters.nrppa_documents import (
    AdditionalPath,
    AngleQuality,
    GnbRxTx,
    LcsToGcs,
    LosInformation,
    LppTimingQuality,
    NrppaDocument,
    ResultItem,
    TimeChoice,
    TimingQuality,
    UeRxTx,
    UlAoa,
    UlRtoa,
    Zoa,
    unwrapped,
)
from rayfix_service.adapters.report_mapping import ANGLE_STEP, PATH_TC, Interval, angle_interval, time_interval
from rayfix_service.fusion.measurements.directions import to_scene
from rayfix_service.fusion.measurements.report import (
    Angle,
    MeasuredPath,
    Measurement,
    PathClock,
    Range,
    TimeOfArrival,
)
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits
from rayfix_tables.geometry.angles import wrap_one
from rayfix_tables.site import Station
from rayfix_tables.validation.problems import Path, path_text

_RESOLUTION_M = {"m0dot1": 0.1, "mdot1": 0.1, "m1": 1.0, "m10": 10.0, "m30": 30.0}

_TURN = 2.0 * math.pi
_LARGEST_STDEV_M = 1e6  # that a report takes

_BEYOND = "its value stands for everything beyond the range of the report mapping"
_NO_AZIMUTH = "a zenith angle without an azimuth cannot be used; report UL-AoA with both"
_NO_ZENITH = "an azimuth without a zenith angle cannot be turned by beta and gamma; report zenithAoA as well"
_ALONE = "a gNB's Rx-Tx time difference is a range only together with the UE's; give that in ue_rx_tx"
_POWER = "powers and phases are not used"
_MORE_ANGLES = "of an additional path one angle is used, with an azimuth; give that first"
_NO_INDICATION = "of several paths, which one is direct follows from the table"

_LISTS = ("TRP-MeasurementResponseList", "TRP-MeasurementReportList")


def parse_nrppa(
    message: Mapping[str, Any] | bytes,
    *,
    stations: Mapping[str, str] | None = None,
    limits: MessageLimits = USUAL_LIMITS,
) -> Adapted:
    """Turn an NRPPa measurement message into a report.

    UL-AoA becomes an angle in the frame "north", since azimuths of the global coordinate system count from
    geographic north, counter-clockwise (TS 38.215, clause 5.2.4); angles with a translation from a local coordinate
    system are rotated by it. UL-RTOA becomes a time of arrival: its reference time and the time of transmission are
    unknown, and the same for all TRPs. The Rx-Tx time differences of a gNB and of the UE add to the round trip, so that
    c / 2 times their sum is the path length (TS 38.305, clause 8.10). Where a message has additional paths, times of
    arrival become paths, and so do ranges with additional paths; a TRP's only angle is that of its first path then.

    Parameters
    ----------
    message : Mapping or bytes
        The message as :class:`NrppaDocument` describes it, or the whole PDU with it, or the JSON text of either.
    stations : Mapping, optional
        Stations by TRP-ID (as text), for those that the message's own map does not have. A TRP-ID in neither is
        itself a station's identifier.
    limits : MessageLimits, optional

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    InvalidReportError
        For a message that is not valid, or of which no measurement can be used.
    """
    document = check(
        NrppaDocument,
        message,
        what="the NRPPa message",
        limits=limits,
        check_counts=partial(_check_counts, limits.results),
        unwrap=unwrapped,
    )
    name = _LISTS[0] if document.response else _LISTS[1]
    ranges_to: dict[int, list[UeRxTx]] = {}
    for ue in document.ue_rx_tx:
        ranges_to.setdefault(ue.trp_id, []).append(ue)
    measurements: list[tuple[Path, Measurement]] = []
    skipped: list[Skipped] = []
    as_paths = any(_paths_of(item) for trp in document.response or document.report or () for item in trp.results)
    for i, trp in enumerate(document.response or document.report or ()):
        converter = _Converter(
            document=document,
            station_id=station_of(str(trp.trp_id), document.stations, stations),
            ue_rx_tx=ranges_to.get(trp.trp_id, []),
            as_paths=as_paths,
        )
        first = len(measurements)
        for k, item in enumerate(trp.results):
            path: Path = (name, i, "measurementResult", k)
            for place, outcome in converter.convert(item):
                if isinstance(outcome, str):
                    skipped.append(Skipped(path=(*path, *place), reason=outcome))
                else:
                    measurements.append(((*path, *place), _with_line_of_sight(outcome, item.los)))
            if item.los is not None and _paths_of(item):
                skipped.append(Skipped(path=(*path, "LoS-NLoSInformation"), reason=_NO_INDICATION))
            if len(measurements) + len(skipped) > 2 * limits.results:  # each may be one range for every ue_rx_tx
                most = 2 * limits.results
                text = f"ue_rx_tx makes more than {most} measurements of the message's; give one for each TRP"
                raise too_much(("ue_rx_tx",), text)
        measurements[first:] = _with_angle(measurements[first:]) if as_paths else measurements[first:]
    return adapted_report(
        measurements,
        skipped,
        target_id=document.target_id,
        timestamp=document.timestamp,
        height=None if document.height is None else document.height.height(),
        confidence=document.confidence,
        limits=limits,
    )


def _check_counts(most: int, message: Mapping[str, Any]) -> None:
    """Count the measurements of a message, which may be invalid.

    Raises
    ------
    InvalidReportError
        When there are too many.
    """
    num_results = 0
    for name in _LISTS:
        for trp in _array(message.get(name))[:64]:  # more are refused unread
            for item in _array(trp.get("measurementResult") if isinstance(trp, Mapping) else None):
                value = item.get("measuredResultsValue") if isinstance(item, Mapping) else None
                several = value.get("MultipleULAoA") if isinstance(value, Mapping) else None
                angles = several.get("multipleULAoA") if isinstance(several, Mapping) else None
                num_results += max(len(_array(angles)), 1)
                for time in ("uL-RTOA", "gNB-RxTxTimeDiff"):
                    measured = value.get(time) if isinstance(value, Mapping) else None
                    for paths in ("additionalPathList", "ExtendedAdditionalPathList"):
                        num_results += len(_array(measured.get(paths) if isinstance(measured, Mapping) else None))
                if num_results > most:
                    text = f"{path_text((name,))} has more than {most} measurements; give at most as many at once"
                    raise too_much((name,), text)


def _array(value: object) -> list[Any] | tuple[Any, ...]:
    return value if isinstance(value, list | tuple) else ()


@dataclass(frozen=True, kw_only=True)
class _Converter:
    """Conversion of one TRP's measurements: pairs of a path within the item, and a measurement or a reason."""

    document: NrppaDocument
    station_id: str
    ue_rx_tx: list[UeRxTx]
    as_paths: bool

    def convert(self, item: ResultItem) -> Iterator[tuple[Path, Angle | Range | TimeOfArrival | MeasuredPath | str]]:
        """Convert one item, which may hold several measurements or none."""
        name, value = one_of(item.value)
        path: Path = ("measuredResultsValue", name)
        angle = item.quality.angle if item.quality else None
        timing = item.quality.timing if item.quality else None
        match name:
            case "uL-AngleOfArrival":
                yield path, self._angle(value, angle)
            case "MultipleULAoA":
                for n, choice in enumerate(value.angles):
                    inner, one = one_of(choice)
                    yield (*path, "multipleULAoA", n, inner), self._angle(one, angle)
            case "ZoA":
                yield path, _NO_AZIMUTH
            case "uL-RTOA":
                yield from self._with_paths(path, value, self._arrival(value.time, timing))
            case "gNB-RxTxTimeDiff":
                for outcome in self._ranges(value.time, timing):
                    yield from self._with_paths(path, value, outcome)
            case _:
                yield path, _POWER

    def _angle(self, measured: UlAoa | Zoa, quality: AngleQuality | None) -> Angle | str:
        if isinstance(measured, Zoa):
            return _NO_AZIMUTH
        azimuth = angle_interval(measured.azimuth, zero=math.radians(self.document.azimuth_zero_deg))
        default = math.radians(self.document.angle_stdev_deg)
        azimuth_stdev = _angle_stdev(_steps(quality.azimuth) * ANGLE_STEP if quality else default, azimuth)
        if measured.zenith is None:
            if measured.translation is None:
                turn = 0.0
            elif measured.translation.beta == measured.translation.gamma == 0:
                turn = measured.translation.alpha * ANGLE_STEP
            else:
                return _NO_ZENITH
            return Angle(
                station_id=self.station_id,
                azimuth=wrap_one(azimuth.middle + turn),
                azimuth_stdev=azimuth_stdev,
                frame="north",
            )
        zenith = angle_interval(measured.zenith)
        known = quality.zenith if quality else None
        zenith_stdev = _angle_stdev(default if known is None else _steps(known) * ANGLE_STEP, zenith)
        angle = Angle(
            station_id=self.station_id,
            azimuth=wrap_one(azimuth.middle),
            zenith=zenith.middle,
            azimuth_stdev=azimuth_stdev,
            zenith_stdev=zenith_stdev,
            frame="north",
        )
        return angle if measured.translation is None else _to_global(measured.translation, angle)

    def _with_paths(
        self, path: Path, value: UlRtoa | GnbRxTx, first: TimeOfArrival | Range | str
    ) -> Iterator[tuple[Path, TimeOfArrival | Range | MeasuredPath | str]]:
        """Convert a time and those of additional paths, which count from it."""
        listed = _listed_paths(value)
        if isinstance(first, str) or not self.as_paths or (isinstance(first, Range) and not listed):
            yield path, first
            return
        clock: PathClock = "known" if isinstance(first, Range) else "ue"
        measured = MeasuredPath(station_id=self.station_id, length=first.path_length, stdev=first.stdev, clock=clock)
        yield path, measured
        for name, n, additional in listed:
            place = (*path, name, n)
            delay = time_interval(*additional.time.value_and_k(), PATH_TC)
            if delay is None:
                yield (*place, "relativeTimeOfPath"), _BEYOND
                continue
            timing = additional.quality.timing if additional.quality else None
            variance = self._time_variance(delay, timing)
            one = replace(
                measured,
                length=first.path_length + delay.middle,
                stdev=min(math.sqrt(variance), _LARGEST_STDEV_M),
                power_db=None if additional.power is None else float(additional.power.first),
            )
            angles = () if additional.angles is None else additional.angles.angles
            angle = self._angle(one_of(angles[0])[1], None) if angles else None
            if isinstance(angle, Angle):
                one = _directed(one, angle)
            yield place, one
            if isinstance(angle, str) or len(angles) > 1:
                yield (*place, "multipleULAoA"), _MORE_ANGLES

    def _arrival(self, time: TimeChoice, quality: TimingQuality | None) -> TimeOfArrival | str:
        measured = time_interval(*time.value_and_k())
        if measured is None:
            return _BEYOND
        return TimeOfArrival(
            station_id=self.station_id,
            path_length=measured.middle,
            stdev=min(math.sqrt(self._time_variance(measured, quality)), _LARGEST_STDEV_M),
        )

    def _ranges(self, time: TimeChoice, quality: TimingQuality | None) -> Iterator[Range | str]:
        mine = time_interval(*time.value_and_k())
        if not self.ue_rx_tx:
            yield _ALONE
        for ue in self.ue_rx_tx:
            theirs = time_interval(*ue.time.value_and_k())
            if mine is None or theirs is None:
                yield _BEYOND
                continue
            variance = self._time_variance(mine, quality) + self._time_variance(theirs, ue.quality)
            yield Range(
                station_id=self.station_id,
                path_length=0.5 * (mine.middle + theirs.middle),
                stdev=0.5 * math.sqrt(variance),
            )

    def _time_variance(self, measured: Interval, quality: TimingQuality | LppTimingQuality | None) -> float:
        """Variance of a time as a length, m2, including that of the quantisation."""
        if quality is None:
            return self.document.time_stdev_m**2 + measured.variance
        return (_steps(quality.value) * _RESOLUTION_M[quality.resolution]) ** 2 + measured.variance


def _listed_paths(value: UlRtoa | GnbRxTx) -> list[tuple[str, int, AdditionalPath]]:
    """Additional paths of a time, with the name of their list and their place in it."""
    lists = (("additionalPathList", value.additional_paths), ("ExtendedAdditionalPathList", value.more_paths))
    return [(name, n, path) for name, paths in lists for n, path in enumerate(paths or ())]


def _paths_of(item: ResultItem) -> bool:
    """Whether an item is a time with additional paths."""
    value = one_of(item.value)[1]
    return isinstance(value, UlRtoa | GnbRxTx) and bool(_listed_paths(value))


def _directed(measured: MeasuredPath, angle: Angle) -> MeasuredPath:
    """Add a direction to a path; the errors of its angles count as independent."""
    return replace(
        measured,
        azimuth=angle.azimuth,
        azimuth_stdev=angle.azimuth_stdev,
        zenith=angle.zenith,
        zenith_stdev=angle.zenith_stdev,
        frame=angle.frame,
    )


def _with_angle(measurements: list[tuple[Path, Measurement]]) -> list[tuple[Path, Measurement]]:
    """Add the only angle of a TRP to the first of its paths, which it is of."""
    angles = [n for n, (_, measured) in enumerate(measurements) if isinstance(measured, Angle)]
    paths = [n for n, (_, measured) in enumerate(measurements) if isinstance(measured, MeasuredPath)]
    if len(angles) != 1 or not paths:
        return measurements
    place, first = measurements[paths[0]]
    angle = measurements[angles[0]][1]
    assert isinstance(first, MeasuredPath)
    assert isinstance(angle, Angle)
    joined = {paths[0]: (place, _directed(first, angle))}
    return [joined.get(n, each) for n, each in enumerate(measurements) if n != angles[0]]


def _with_line_of_sight(
    measurement: Angle | Range | TimeOfArrival | MeasuredPath, los: LosInformation | None
) -> Measurement:
    """Add the TRP's line-of-sight indicator; a hard one is a probability of 0 or 1."""
    if los is None or isinstance(measurement, MeasuredPath):
        return measurement
    name, value = one_of(los)
    return replace(measurement, los_probability=value / 10.0 if name.endswith("Soft") else float(value == "los"))


def _angle_stdev(stdev: float, measured: Interval) -> float:
    """Add the quantisation's variance to a standard deviation; a report takes a full turn at most."""
    return min(math.sqrt(stdev**2 + measured.variance), _TURN)


def _steps(quality: int) -> float:
    """Uncertainty in steps; 0 stands for less than half a step."""
    return max(float(quality), 0.5)


def _to_global(translation: LcsToGcs, angle: Angle) -> Angle:
    """Rotate an angle of a local coordinate system, and its covariance, by TR 38.901, equation (7.1-2)."""
    orientation = (
        translation.alpha * ANGLE_STEP,
        translation.beta * ANGLE_STEP,
        translation.gamma * ANGLE_STEP,
    )
    trp = Station(id=angle.station_id, position=(0.0, 0.0, 0.0), orientation=orientation)
    turned = to_scene(replace(angle, frame="lcs"), trp, 0.0)
    assert turned.azimuth is not None
    stdev = np.sqrt(np.diag(turned.cov))
    return replace(
        angle,
        azimuth=turned.azimuth,
        zenith=turned.zenith,
        # A standard deviation beyond a full turn means that the azimuth is unknown, as it is at the zenith.
        azimuth_stdev=min(float(stdev[0]), _TURN),
        zenith_stdev=min(float(stdev[1]), _TURN),
        correlation=float(np.clip(turned.cov[0, 1] / (stdev[0] * stdev[1]), -0.999, 0.999)),
    )
