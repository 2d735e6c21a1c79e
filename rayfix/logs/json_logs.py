"""Logs of JSON: a report a line, one report, an array, or an object with the key reports."""

import json
from collections.abc import Iterator

from rayfix.logs.entries import Entry, Place, Problem
from rayfix.logs.files import LONGEST, LogFile

_CHUNK = 1 << 18
_BOM = b"\xef\xbb\xbf"
_SPACE = " \t\r\n"


def json_elements(log: LogFile) -> Iterator[tuple[Place, bytes] | Problem]:
    """Give the JSON text of each report or message of a log; whether it is one is for others to find out.

    The layout follows from the beginning of the file. Of an array that is broken, all elements before the break are
    given. No more than an element and a chunk is in memory.
    """
    text = log.head().removeprefix(_BOM).lstrip()
    if text.startswith(b"[") or _begins_with_reports(text):
        yield from _array(log)
        return
    first_line = text.split(b"\n", 1)[0].strip()
    if text.startswith(b"{") and not _is_whole(first_line) and b"\n" in text:
        yield from _one_document(log)
        return
    for number, line in log.lines():
        content = line.removeprefix(_BOM).strip() if number == 1 else line.strip()
        if not content:
            continue
        if len(line) > LONGEST:
            yield Problem(place=Place(log.name, number), text=f"the line has more than {LONGEST} bytes; split it")
            continue
        yield Place(log.name, number), content


def native_entries(log: LogFile) -> Iterator[Entry | Problem]:
    """Give the reports of a log of this project's own JSON, unread."""
    for found in json_elements(log):
        if isinstance(found, Problem):
            yield found
        else:
            place, text = found
            yield Entry(place=place, report=text)


def _begins_with_reports(text: bytes) -> bool:
    """Whether an object begins with its reports, as a batch does."""
    return text.startswith(b"{") and text[1:].lstrip().startswith(b'"reports"')


def _is_whole(line: bytes) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def _one_document(log: LogFile) -> Iterator[tuple[Place, bytes] | Problem]:
    """Give the one report of a file of several lines; if there is more than one, the file is no log."""
    text = log.read(LONGEST + 1).removeprefix(_BOM).strip()
    place = Place(log.name, 1)
    if len(text) > LONGEST or not _is_whole(text):
        yield Problem(
            place=place,
            text="the file is neither one report a line, nor an array, nor one report; write each report in one line",
        )
    else:
        yield place, text


def _array(log: LogFile) -> Iterator[tuple[Place, bytes] | Problem]:
    """Give the elements of an array, or of the one with the key reports."""
    reader = _Text(log)
    reader.skip("{")
    if reader.skip('"reports"'):
        reader.skip(":")
    reader.skip("[")
    number = 0
    while not reader.skip("]"):
        number += 1
        place = Place(log.name, number)
        try:
            element = reader.value()
        except ValueError as error:
            yield Problem(place=place, text=f"the array is broken here ({error}); what follows is not read")
            return
        yield place, element
        if not reader.skip(",") and not reader.at("]"):
            yield Problem(place=place, text="no comma follows this element; what follows is not read")
            return
    reader.skip("}")
    if rest := reader.rest():
        yield Problem(place=Place(log.name, number), text=f"after the reports stands {rest!r}, which is not read")


class _Text:
    """Text of a JSON document, of which only the part that is being read is in memory."""

    def __init__(self, log: LogFile) -> None:
        self._log = log
        self._buffer, self._position, self._ended = "", 0, False
        self._decoder = json.JSONDecoder()
        self._incomplete = b""

    def at(self, mark: str) -> bool:
        """Whether a mark comes next, after spaces."""
        while True:
            while self._position < len(self._buffer) and self._buffer[self._position] in _SPACE:
                self._position += 1
            if len(self._buffer) - self._position >= len(mark) or not self._more():
                return self._buffer.startswith(mark, self._position)

    def skip(self, mark: str) -> bool:
        """Pass a mark, if it comes next."""
        found = self.at(mark)
        if found:
            self._position += len(mark)
        return found

    def value(self) -> bytes:
        """Read the next value.

        Raises
        ------
        ValueError
            When there is none.
        """
        if self.at("]") or self.at(","):
            raise ValueError("a value is missing")
        while True:
            try:
                _, end = self._decoder.raw_decode(self._buffer, self._position)
            except (ValueError, RecursionError) as error:
                if len(self._buffer) - self._position > LONGEST or not self._more():
                    reason = getattr(error, "msg", None) or "it is nested too deeply"
                    raise ValueError(f"{reason}, or the element has more than {LONGEST} bytes") from None
                continue
            if end == len(self._buffer) and self._more():
                continue  # a number may go on
            text = self._buffer[self._position : end]
            self._position = end
            return text.encode()

    def rest(self) -> str:
        """Return the beginning of what follows, without spaces around it."""
        self.at("x")
        return self._buffer[self._position : self._position + 40].strip()

    def _more(self) -> bool:
        """Read another chunk; False at the end."""
        if self._ended:
            return False
        chunk = self._incomplete + self._log.read(_CHUNK)
        self._ended = len(chunk) == len(self._incomplete)
        first = not self._buffer and self._position == 0
        text = chunk.removeprefix(_BOM) if first else chunk
        # A character may be cut in two.
        cut = 0 if self._ended else _cut(text)
        self._incomplete = text[len(text) - cut :]
        self._buffer = self._buffer[self._position :] + text[: len(text) - cut].decode("utf-8", "replace")
        self._position = 0
        return not self._ended


def _cut(text: bytes) -> int:
    """Bytes at the end that are the beginning of a character."""
    for back in range(1, min(4, len(text)) + 1):
        byte = text[-back]
        if byte & 0xC0 != 0x80:
            needed = (
                1 if byte < 0x80 else 2 if byte >> 5 == 6 else 3 if byte >> 4 == 14 else 4 if byte >> 3 == 30 else 1
            )
            return back if needed > back else 0
    return 0
