"""Names are data: one way to write a name of a target, station or locator for each kind of output.

A name may hold any character: it comes from a client, a broker or a site file.
"""

import re
from urllib.parse import quote

from rayfix_tables.errors import ReportError

MAX_NAME = 256
"""Characters of a target's name."""

_NO_TOPIC = re.compile(r"[%/+#\x00-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]|^\$")
"""Characters with a meaning in an MQTT topic, those that a broker may refuse, and the escape character."""


def path_segment(name: str) -> str:
    """Write a name as one segment of a URL's path.

    Raises
    ------
    ReportError
        For ``.`` and ``..``, which mean other paths however they are written, no name, and what is no Unicode text.
    """
    try:
        segment = quote(name, safe="")
    except UnicodeEncodeError:
        segment = ""
    if segment in ("", ".", ".."):
        raise ReportError(f"target_id '{in_log(name)}' cannot be part of an address; give the target another name")
    return segment


def topic_level(name: str) -> str:
    """Write a name as one level of an MQTT topic.

    What means something there or that brokers refuse, and ``%``, becomes ``%`` and the hexadecimal digits of its UTF-8.
    """
    return _NO_TOPIC.sub(
        lambda found: "".join(f"%{byte:02X}" for byte in found[0].encode("utf-8", "surrogatepass")), name
    )


def in_log(name: str, *, most: int = 100) -> str:
    """Write a name, or a text with names, within one line of a log: control characters as escapes, and not too long."""
    text = name if len(name) <= most else f"{name[:most]}..."
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode() for character in text
    )
