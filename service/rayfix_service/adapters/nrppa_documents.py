"""NRPPa measurement results as JSON, with the names and ranges of the ASN.1 in 3GPP TS 38.455 V18.6.0, clause 9.3.5.

A SEQUENCE is an object, a SEQUENCE OF an array, a CHOICE an object with one key. Elements of ASN.1 extension containers
(ZoA, MultipleULAoA, ReportingGranularitykminus1, LoS-NLoSInformation) have the name of their type as key. Keys that the
conversion does not use, such as timeStamp, may have any value.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from rayfix_service.adapters.documents import KnownHeight, Stations, TargetId, Timestamp, integer, not_used, one_of
from rayfix_service.adapters.report_mapping import PATH_TC, largest_time_value
from rayfix_service.fusion.measurements.report import CONFIDENCE
from rayfix_service.wire import MAX_MEASUREMENTS, MAX_REPORTS, FieldProblem, InvalidReportError, WireModel
from rayfix_service.wire.fields import Confidence, misfit

_Tenths = integer(3599, "an angle in 0.1 deg")
_Azimuth = integer(3599, "an azimuth in 0.1 deg")
_Zenith = integer(1799, "a zenith angle in 0.1 deg")


class ChoiceModel(WireModel):
    """Base of a CHOICE: exactly one of the keys."""

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        one_of(self)
        return self


class LcsToGcs(WireModel):
    """LCS-to-GCS-Translation: bearing, downtilt and slant of TR 38.901, clause 7.1.3."""

    model_config = ConfigDict(title="LCS-to-GCS-Translation")

    alpha: Annotated[int, _Tenths]
    beta: Annotated[int, _Tenths]
    gamma: Annotated[int, _Tenths]
    extensions: Any = not_used("iE-Extensions")


class UlAoa(WireModel):
    """UL-AoA (TS 38.455, 9.2.38)."""

    model_config = ConfigDict(title="UL-AoA")

    azimuth: Annotated[int, _Azimuth] = Field(alias="azimuthAoA")
    zenith: Annotated[int, _Zenith] | None = Field(default=None, alias="zenithAoA")
    translation: LcsToGcs | None = Field(default=None, alias="lCS-to-GCS-Translation")
    extensions: Any = not_used("iE-extensions")


class Zoa(WireModel):
    """ZoA: a zenith angle without an azimuth."""

    model_config = ConfigDict(title="ZoA")

    zenith: Annotated[int, _Zenith] = Field(alias="zenithAoA")
    translation: LcsToGcs | None = Field(default=None, alias="lCS-to-GCS-Translation")
    extensions: Any = not_used("iE-extensions")


class MultipleUlAoaItem(ChoiceModel):
    """MultipleULAoA-Item."""

    model_config = ConfigDict(title="MultipleULAoA-Item")

    ul_aoa: UlAoa | None = Field(default=None, alias="uL-AoA")
    ul_zoa: Zoa | None = Field(default=None, alias="ul-ZoA")


class MultipleUlAoa(WireModel):
    """MultipleULAoA: up to 8 angles, each of a different path."""

    model_config = ConfigDict(title="MultipleULAoA")

    angles: list[MultipleUlAoaItem] = Field(
        alias="multipleULAoA", min_length=1, max_length=8, description="an array of 1 to 8 angles"
    )
    extensions: Any = not_used("iE-Extensions")


def _time(k: int) -> Any:
    return integer(largest_time_value(k), f"a time in steps of Tc * 2^{k}")


class TimeChoice(ChoiceModel):
    """ULRTOAMeas and GNBRxTxTimeDiffMeas, which have the same form: the step is Tc 2^k."""

    model_config = ConfigDict(title="ULRTOAMeas")

    k0: Annotated[int, _time(0)] | None = None
    k1: Annotated[int, _time(1)] | None = None
    k2: Annotated[int, _time(2)] | None = None
    k3: Annotated[int, _time(3)] | None = None
    k4: Annotated[int, _time(4)] | None = None
    k5: Annotated[int, _time(5)] | None = None
    minus1: Annotated[int, _time(-1)] | None = Field(default=None, alias="ReportingGranularitykminus1")
    minus2: Annotated[int, _time(-2)] | None = Field(default=None, alias="ReportingGranularitykminus2")
    minus3: Annotated[int, _time(-3)] | None = Field(default=None, alias="ReportingGranularitykminus3")
    minus4: Annotated[int, _time(-4)] | None = Field(default=None, alias="ReportingGranularitykminus4")
    minus5: Annotated[int, _time(-5)] | None = Field(default=None, alias="ReportingGranularitykminus5")
    minus6: Annotated[int, _time(-6)] | None = Field(default=None, alias="ReportingGranularitykminus6")

    def value_and_k(self) -> tuple[int, int]:
        """Return the reported integer and the exponent of its step."""
        name, value = one_of(self)
        return value, int(name.removeprefix("k")) if name.startswith("k") else -int(name[-1])


def _path_time(k: int) -> Any:
    return integer(largest_time_value(k, PATH_TC), f"a time after the first path in steps of Tc * 2^{k}")


class RelativePathDelay(ChoiceModel):
    """RelativePathDelay: how much later than the first a path arrives, in steps of Tc 2^k."""

    model_config = ConfigDict(title="RelativePathDelay")

    k0: Annotated[int, _path_time(0)] | None = None
    k1: Annotated[int, _path_time(1)] | None = None
    k2: Annotated[int, _path_time(2)] | None = None
    k3: Annotated[int, _path_time(3)] | None = None
    k4: Annotated[int, _path_time(4)] | None = None
    k5: Annotated[int, _path_time(5)] | None = None

    def value_and_k(self) -> tuple[int, int]:
        """Return the reported integer and the exponent of its step."""
        name, value = one_of(self)
        return value, int(name[1])


class PathPower(WireModel):
    """UL-SRS-RSRPP: the power of a path, in steps of 1 dB."""

    model_config = ConfigDict(title="UL-SRS-RSRPP")

    first: Annotated[int, integer(126, "a power in dB")] = Field(alias="firstPathRSRPP")
    extensions: Any = not_used("iE-extensions")


class TimingQuality(WireModel):
    """TrpMeasurementTimingQuality: an uncertainty in steps of the resolution."""

    model_config = ConfigDict(title="TrpMeasurementTimingQuality")

    value: Annotated[int, integer(31, "an uncertainty in steps of the resolution")] = Field(alias="measurementQuality")
    resolution: Literal["m0dot1", "m1", "m10", "m30"]
    extensions: Any = not_used("iE-extensions")


class AngleQuality(WireModel):
    """TrpMeasurementAngleQuality: uncertainties in steps of the resolution."""

    model_config = ConfigDict(title="TrpMeasurementAngleQuality")

    azimuth: Annotated[int, integer(255, "an uncertainty in 0.1 deg")] = Field(alias="azimuthQuality")
    zenith: Annotated[int, integer(255, "an uncertainty in 0.1 deg")] | None = Field(
        default=None, alias="zenithQuality"
    )
    resolution: Literal["deg0dot1"]
    extensions: Any = not_used("iE-extensions")


class Quality(ChoiceModel):
    """TrpMeasurementQuality."""

    model_config = ConfigDict(title="TrpMeasurementQuality")

    timing: TimingQuality | None = Field(default=None, alias="timingMeasQuality")
    angle: AngleQuality | None = Field(default=None, alias="angleMeasQuality")
    phase: Any = not_used("TRPPhaseQuality")


class AdditionalPath(WireModel):
    """AdditionalPathListItem and ExtendedAdditionalPathList-Item, which has angles and power as elements of its own."""

    model_config = ConfigDict(title="AdditionalPathListItem")

    time: RelativePathDelay = Field(alias="relativeTimeOfPath")
    quality: Quality | None = Field(default=None, alias="pathQuality")
    angles: MultipleUlAoa | None = Field(default=None, alias="multipleULAoA")
    power: PathPower | None = Field(default=None, alias="pathPower")
    extensions: Any = not_used("iE-Extensions")


class TimeOfPaths(WireModel):
    """A time measurement that may have further paths."""

    additional_paths: list[AdditionalPath] | None = Field(
        default=None, alias="additionalPathList", min_length=1, max_length=2, description="an array of 1 or 2 paths"
    )
    more_paths: list[AdditionalPath] | None = Field(
        default=None,
        alias="ExtendedAdditionalPathList",
        min_length=1,
        max_length=8,
        description="an array of 1 to 8 paths",
    )


class UlRtoa(TimeOfPaths):
    """UL-RTOAMeasurement."""

    model_config = ConfigDict(title="UL-RTOAMeasurement")

    time: TimeChoice = Field(alias="uLRTOAmeas")
    timing_group: Any = not_used("TRP-Rx-TEGInformation")
    extensions: Any = not_used("iE-extensions")


class GnbRxTx(TimeOfPaths):
    """GNB-RxTxTimeDiff."""

    model_config = ConfigDict(title="GNB-RxTxTimeDiff")

    time: TimeChoice = Field(alias="rxTxTimeDiff")
    timing_group: Any = not_used("TRPTEGInformation")
    extensions: Any = not_used("iE-Extensions")


class MeasuredResultsValue(ChoiceModel):
    """TrpMeasuredResultsValue."""

    model_config = ConfigDict(title="TrpMeasuredResultsValue")

    aoa: UlAoa | None = Field(default=None, alias="uL-AngleOfArrival")
    rsrp: Any = not_used("uL-SRS-RSRP")
    rtoa: UlRtoa | None = Field(default=None, alias="uL-RTOA")
    rx_tx: GnbRxTx | None = Field(default=None, alias="gNB-RxTxTimeDiff")
    zoa: Zoa | None = Field(default=None, alias="ZoA")
    multiple_aoa: MultipleUlAoa | None = Field(default=None, alias="MultipleULAoA")
    rsrpp: Any = not_used("UL-SRS-RSRPP")
    rscp: Any = not_used("UL-RSCPMeas")


class LosInformation(ChoiceModel):
    """LoS-NLoSInformation: how likely the path is a direct one."""

    model_config = ConfigDict(title="LoS-NLoSInformation")

    soft: Annotated[int, integer(10, "the probability of a direct path in steps of 0.1")] | None = Field(
        default=None, alias="loS-NLoSIndicatorSoft"
    )
    hard: Literal["nlos", "los"] | None = Field(default=None, alias="loS-NLoSIndicatorHard")


class ResultItem(WireModel):
    """TrpMeasurementResultItem: one measurement of a TRP."""

    model_config = ConfigDict(title="TrpMeasurementResultItem")

    value: MeasuredResultsValue = Field(alias="measuredResultsValue")
    quality: Quality | None = Field(default=None, alias="measurementQuality")
    los: LosInformation | None = Field(default=None, alias="LoS-NLoSInformation")
    time_stamp: Any = not_used("timeStamp")
    beam: Any = not_used("measurementBeamInfo")
    extensions: Any = not_used("iE-Extensions")
    srs_type: Any = not_used("SRSResourcetype")
    arp_id: Any = not_used("ARP-ID")
    trp_location: Any = not_used("Mobile-TRP-LocationInformation")


_TrpId = integer(65535, "a TRP-ID", low=1)


class ResponseItem(WireModel):
    """TRP-MeasurementResponseItem: all measurements of a TRP."""

    model_config = ConfigDict(title="TRP-MeasurementResponseItem")

    trp_id: Annotated[int, _TrpId] = Field(alias="tRP-ID")
    results: list[ResultItem] = Field(
        alias="measurementResult",
        min_length=1,
        max_length=MAX_MEASUREMENTS,
        description=f"an array of 1 to {MAX_MEASUREMENTS} measurements",
    )
    cell_id: Any = not_used("Cell-ID")
    extensions: Any = not_used("iE-extensions")


class LppTimeChoice(ChoiceModel):
    """nr-UE-RxTxTimeDiff-r16 of TS 37.355."""

    model_config = ConfigDict(title="nr-UE-RxTxTimeDiff-r16")

    k0: Annotated[int, _time(0)] | None = Field(default=None, alias="k0-r16")
    k1: Annotated[int, _time(1)] | None = Field(default=None, alias="k1-r16")
    k2: Annotated[int, _time(2)] | None = Field(default=None, alias="k2-r16")
    k3: Annotated[int, _time(3)] | None = Field(default=None, alias="k3-r16")
    k4: Annotated[int, _time(4)] | None = Field(default=None, alias="k4-r16")
    k5: Annotated[int, _time(5)] | None = Field(default=None, alias="k5-r16")

    def value_and_k(self) -> tuple[int, int]:
        """Return the reported integer and the exponent of its step."""
        name, value = one_of(self)
        return value, int(name[1])


class LppTimingQuality(WireModel):
    """NR-TimingQuality-r16 of TS 37.355: an uncertainty in steps of the resolution."""

    model_config = ConfigDict(title="NR-TimingQuality-r16")

    value: Annotated[int, integer(31, "an uncertainty in steps of the resolution")] = Field(
        alias="timingQualityValue-r16"
    )
    resolution: Literal["mdot1", "m1", "m10", "m30"] = Field(alias="timingQualityResolution-r16")


class UeRxTx(WireModel):
    """The UE's Rx-Tx time difference to one TRP, from an element of LPP's NR-Multi-RTT-MeasList-r16 (TS 37.355).

    LPP names the TRP by its DL-PRS ID; the LMF knows which TRP-ID that is.
    """

    model_config = ConfigDict(title="UeRxTx")

    trp_id: Annotated[int, _TrpId] = Field(alias="tRP-ID")
    time: LppTimeChoice = Field(alias="nr-UE-RxTxTimeDiff-r16")
    quality: LppTimingQuality | None = Field(default=None, alias="nr-TimingQuality-r16")


_List = Field(min_length=1, max_length=64, description="an array of 1 to 64 objects, each of one TRP")


class NrppaDocument(WireModel):
    """A MEASUREMENT RESPONSE or MEASUREMENT REPORT (TS 38.455, 9.1.4), and what only the LMF knows."""

    model_config = ConfigDict(
        title="NrppaReport",
        json_schema_extra={
            "oneOf": [{"required": ["TRP-MeasurementResponseList"]}, {"required": ["TRP-MeasurementReportList"]}]
        },
    )

    response: Annotated[list[ResponseItem], _List] | None = Field(default=None, alias="TRP-MeasurementResponseList")
    report: Annotated[list[ResponseItem], _List] | None = Field(default=None, alias="TRP-MeasurementReportList")
    lmf_id: Any = not_used("LMF-Measurement-ID")
    ran_id: Any = not_used("RAN-Measurement-ID")
    ue_rx_tx: list[UeRxTx] = Field(default=[], max_length=64, description="an array of at most 64 objects")
    target_id: TargetId = None
    timestamp: Timestamp = None
    stations: Stations = None
    height: KnownHeight = None
    confidence: Confidence = CONFIDENCE
    azimuth_zero_deg: Literal[0, -180] = Field(
        default=0, description="0 or -180, the azimuth in degrees at which azimuthAoA = 0 begins"
    )
    angle_stdev_deg: float = Field(
        default=1.0, ge=1e-6, le=360, description="a standard deviation for angles without quality, 1e-06 to 360"
    )
    time_stdev_m: float = Field(
        default=1.0, ge=1e-6, le=1e6, description="a standard deviation for times without quality, 1e-06 to 1e+06"
    )

    @model_validator(mode="after")
    def _one_list(self) -> Self:
        if (self.response is None) == (self.report is None):
            text = "has both lists" if self.response else "has no measurements"
            text += "; give exactly one of TRP-MeasurementResponseList and TRP-MeasurementReportList"
            raise misfit(None, text)
        return self


class NrppaBatchDocument(WireModel):
    """Many messages, answered in their order; each is validated separately."""

    model_config = ConfigDict(title="NrppaBatch")

    reports: list[NrppaDocument] = Field(
        max_length=MAX_REPORTS, description=f"an array of at most {MAX_REPORTS} messages"
    )


OUTCOMES = ("initiatingMessage", "successfulOutcome")
FAILURE = "unsuccessfulOutcome"
MESSAGES = ("MeasurementResponse", "MeasurementReport")
ELEMENTS = (
    "TRP-MeasurementResponseList",
    "TRP-MeasurementReportList",
    "LMF-Measurement-ID",
    "RAN-Measurement-ID",
)
"""Information elements that the conversion reads or accepts; others are ignored, like unused keys."""


def unwrapped(message: Mapping[str, Any]) -> Mapping[str, Any]:
    """Take the information elements out of a whole PDU (TS 38.455, clause 9.3.3).

    They are merged with the keys next to the PDU. A message that is not a PDU is returned unchanged.

    Raises
    ------
    InvalidReportError
        For a PDU that reports a failure, or holds another message.
    """
    if FAILURE in message:
        raise _invalid(
            FAILURE, "reports that the measurement failed; give a MEASUREMENT RESPONSE or MEASUREMENT REPORT"
        )
    outcome = next((name for name in OUTCOMES if name in message), None)
    if outcome is None:
        return message
    value = message[outcome]
    value = value.get("value") if isinstance(value, Mapping) else None
    if isinstance(value, Mapping) and "protocolIEs" not in value:
        name = next((name for name in MESSAGES if name in value), None)
        if name is None:
            others = ", ".join(str(key)[:60] for key in list(value)[:3]) or "nothing"
            raise _invalid(outcome, f"holds {others}; give one with {' or '.join(MESSAGES)}")
        value = value[name]
    elements = value.get("protocolIEs") if isinstance(value, Mapping) else None
    if not isinstance(elements, list):
        raise _invalid(outcome, "has no array protocolIEs; give the whole PDU, or its measurement list alone")
    found = {key: content for key, content in message.items() if key != outcome}
    for element in elements:
        content = element.get("value") if isinstance(element, Mapping) else None
        if isinstance(content, Mapping):
            found.update({name: content[name] for name in ELEMENTS if name in content})
    return found


def _invalid(key: str, text: str) -> InvalidReportError:
    return InvalidReportError((FieldProblem(path=(key,), message=f"{key} {text}"),))
