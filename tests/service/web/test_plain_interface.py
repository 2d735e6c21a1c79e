"""The page of the HTTP interface without the built one: every route and schema, and nothing that runs."""

import json
from html.parser import HTMLParser

from rayfix_service.web.plain_interface import plain_interface
from tests.support.checkout import ROOT


class Page(HTMLParser):
    """Text, identifiers and links of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.ids: set[str] = set()
        self.links: set[str] = set()
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take in an element."""
        self.tags.add(tag)
        self.ids |= {value for name, value in attrs if name == "id" and value}
        self.links |= {value for name, value in attrs if name == "href" and value}

    def handle_data(self, data: str) -> None:
        """Take in text."""
        self.text += data


def test_every_route_and_schema_is_there() -> None:
    document = json.loads((ROOT / "docs/openapi.json").read_text(encoding="utf-8"))
    page = Page(plain_interface(document))
    for path, item in document["paths"].items():
        for method, operation in item.items():
            assert f"{method.upper()} {path}" in page.text
            assert " ".join(operation.get("description", "").split()) in " ".join(page.text.split())
    assert page.ids == set(document["components"]["schemas"])
    assert {link.removeprefix("#") for link in page.links} <= page.ids | {"openapi.json"}
    assert "script" not in page.tags


def test_text_stays_text() -> None:
    document = {"info": {"description": "<b>"}, "paths": {"/<i>": {"get": {"summary": "a & b"}}}}
    page = Page(plain_interface(document))
    assert not page.tags & {"b", "i"}
    assert "GET /<i>" in page.text
