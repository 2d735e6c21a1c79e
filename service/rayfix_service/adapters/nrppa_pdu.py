"""The measurement lists of a whole NRPPa PDU (3GPP TS 38.455, clause 9.3.3), as JSON encoding rules write it."""

from collections.abc import Mapping
from typing import Any

from rayfix_service.wire import FieldProblem, InvalidReportError

OUTCOMES = ("initiatingMessage", "successfulOutcome")
FAILURE = "unsuccessfulOutcome"
MESSAGES = ("MeasurementResponse", "MeasurementReport")
ELEMENTS = (
    "TRP-MeasurementResponseList",
    "TRP-MeasurementReportList",
    "LMF-Measurement-ID",
    "RAN-Measurement-ID",
)
"""Information elements that the conversion reads or knows; others are passed over, as keys without use are."""


def unwrapped(message: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a message with the information elements of its PDU beside the keys that stand beside the PDU.

    A message that is no PDU stays as it is.

    Raises
    ------
    InvalidReportError
        For a PDU that tells of a failure, or holds another message.
    """
    if FAILURE in message:
        raise _invalid(FAILURE, "tells that the measurement failed; give a MEASUREMENT RESPONSE or MEASUREMENT REPORT")
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
