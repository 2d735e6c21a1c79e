"""What can go wrong between a client and the service.

::

    RayfixError                     (rayfix_tables.errors)
    └── ClientError
        ├── UnreachableError        no connection, no answer in time, or the service said so until patience ended
        ├── AnswerError             an answer that is not one of this service
        └── ProblemError            a problem document (RFC 9457)
            └── RefusedReportError  that of a report, which is a ReportError, too: ``path`` names the field
"""

from dataclasses import dataclass

from rayfix_tables.errors import RayfixError, ReportError


class ClientError(RayfixError):
    """Something went wrong between the client and the service."""


class UnreachableError(ClientError):
    """The service cannot be reached, or does not answer in time."""


class AnswerError(ClientError):
    """The answer is not one of this service: the address is another's, or a proxy's answered."""


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
        What is wrong this time, and what to do about it.
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

    ``path`` has one element, the first offending field as the service writes it; ``errors`` has all.
    """

    def __init__(self, detail: str, *, kind: str, status: int, errors: tuple[ProblemField, ...] = ()) -> None:
        ProblemError.__init__(self, detail, kind=kind, status=status, errors=errors)
        self.path = (errors[0].path,) if errors and errors[0].path else ()
