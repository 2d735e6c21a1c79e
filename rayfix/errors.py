"""Every error that rayfix raises on purpose.

::

    RayfixError                     root; ``str(error)`` is one line that names the cause and the remedy
    ├── SiteError                   the site file: unreadable, unknown key, value out of range
    ├── SceneError                  the mesh: missing, unreadable, empty, a station where none can be
    ├── BuildError                  the offline job: no space left, no ray came back
    ├── TableError                  a table file
    │   ├── NotATableError          not an HDF5 file, or another program's
    │   ├── FormatVersionError      written by an incompatible version of rayfix
    │   └── CorruptTableError       truncated, or a checksum does not match
    ├── ReportError                 a report that cannot be used; ``path`` names the field
    │   ├── MalformedJsonError      its JSON cannot be read
    │   ├── InvalidReportError      its JSON does not have the form of a report
    │   └── RefusedReportError      a service refused it; see below
    ├── FixStoppedError             a fix that its caller has stopped
    ├── SettingsError               a setting out of its range; a ValueError
    ├── MissingExtraError           an optional dependency is not installed; an ImportError
    ├── ClientError                 between a client and the service
    │   ├── UnreachableError        no connection, or no answer in time
    │   ├── AnswerError             an answer that is not one of this service
    │   └── ProblemError            a problem document (RFC 9457): kind, status, errors
    │       └── RefusedReportError  that of a report
    ├── ServiceError                ``rayfix serve`` cannot start with its settings
    ├── BrokerError                 ``rayfix mqtt``, ``serve --mqtt``: the broker
    ├── HubError                    the address of an omlox hub
    └── ViewError                   ``rayfix view``: the page cannot be written

Anything else that escapes is a defect of rayfix. All but two are exported by ``rayfix``: catch malformed and invalid
reports as :class:`ReportError`.
"""

from dataclasses import dataclass

from rayfix_tables.errors import (
    BuildError,
    CorruptTableError,
    FormatVersionError,
    NotATableError,
    RayfixError,
    ReportError,
    SceneError,
    SettingsError,
    SiteError,
    TableError,
)

__all__ = [
    "AnswerError",
    "BuildError",
    "ClientError",
    "CorruptTableError",
    "FormatVersionError",
    "MissingExtraError",
    "NotATableError",
    "ProblemError",
    "ProblemField",
    "RayfixError",
    "RefusedReportError",
    "ReportError",
    "SceneError",
    "SettingsError",
    "SiteError",
    "TableError",
    "UnreachableError",
    "ViewError",
]


class MissingExtraError(RayfixError, ImportError):
    """The dependencies of a part of rayfix are not installed."""


class ViewError(RayfixError):
    """The page of ``rayfix view`` cannot be written."""


class ClientError(RayfixError):
    """Base of the errors between the client and the service."""


class UnreachableError(ClientError):
    """The service cannot be reached, or does not answer in time."""


class AnswerError(ClientError):
    """The answer is not from a rayfix service: the address is wrong, or a proxy answered."""


@dataclass(frozen=True, kw_only=True)
class ProblemField:
    """One offending field.

    Attributes
    ----------
    path : str
        Such as ``measurements[0].azimuth_deg``; empty for the whole document.
    message : str
    """

    path: str
    message: str


class ProblemError(ClientError):
    """The service answered with a problem document.

    Parameters
    ----------
    detail : str
        The problem in this case and its remedy.
    kind : str
        URI of the kind of problem.
    status : int
        The HTTP status.
    errors : tuple of ProblemField
    """

    def __init__(self, detail: str, *, kind: str, status: int, errors: tuple[ProblemField, ...] = ()) -> None:
        super().__init__(detail)
        self.kind = kind
        self.status = status
        self.errors = errors


class RefusedReportError(ProblemError, ReportError):
    """A report that the service cannot use.

    ``path`` has one element: the first offending field, as the service writes it. ``errors`` has all fields.
    """

    def __init__(self, detail: str, *, kind: str, status: int, errors: tuple[ProblemField, ...] = ()) -> None:
        ProblemError.__init__(self, detail, kind=kind, status=status, errors=errors)
        self.path = (errors[0].path,) if errors and errors[0].path else ()
