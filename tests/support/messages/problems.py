"""Problem documents of the service."""

from typing import Any

import httpx

from rayfix_service.http.problems import KINDS


def problem_of(response: httpx.Response, status: int) -> dict[str, Any]:
    """Check that a response is a problem document of that status, and return it."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = response.json()
    assert list(document) == ["type", "title", "status", "detail", "errors"]
    (kind,) = (kind for kind in KINDS if kind.uri == document["type"])
    assert (document["title"], document["status"]) == (kind.title, status)
    assert kind.status == status
    assert document["detail"]
    assert "\n" not in document["detail"]
    for error in document["errors"]:
        assert list(error) == ["path", "message"]
        assert error["message"]
    return document
