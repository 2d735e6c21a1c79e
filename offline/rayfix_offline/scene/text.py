"""Decoding of scene files; the formats do not declare an encoding."""

import codecs

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def decode(content: bytes) -> str:
    """Decode a file: by its byte order mark, as UTF-8, or in the Western code page of Windows.

    Numbers and keywords are the same in all code pages. A name in another one is misspelt, but the same in all places.
    Bytes that the code page lacks are decoded as Latin-1.

    Raises
    ------
    UnicodeDecodeError
        When the text does not match its byte order mark.
    """
    for mark, encoding in _MARKS:
        if content.startswith(mark):
            return content.decode(encoding)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        pass
    try:
        return content.decode("cp1252")
    except UnicodeDecodeError:
        return content.decode("latin-1")
