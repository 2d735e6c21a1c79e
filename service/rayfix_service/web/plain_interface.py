"""Fallback page of the HTTP interface when the built page is missing: the OpenAPI document as HTML without scripts."""

import html
from collections.abc import Iterator, Mapping
from typing import Any

_PAGE = """\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="color-scheme" content="light dark">
<title>rayfix: HTTP interface</title>
<h1>HTTP interface</h1>
<p>This installation has no interactive page. <a href="openapi.json">The OpenAPI document</a> has the same content.
{body}
</html>
"""


def plain_interface(document: Mapping[str, Any]) -> str:
    """Render the routes and schemas of an OpenAPI document."""
    schemas = document.get("components", {}).get("schemas", {})
    parts = [f"<p>{_text(document['info'].get('description', ''))}"]
    for path, item in document["paths"].items():
        for method, operation in item.items():
            parts.extend(_operation(f"{method.upper()} {path}", operation))
    parts.append("<h2>Schemas</h2>")
    for name, schema in sorted(schemas.items()):
        parts.extend(_schema(name, schema))
    return _PAGE.format(body="\n".join(parts))


def _operation(title: str, operation: Mapping[str, Any]) -> Iterator[str]:
    yield f"<h2><code>{_text(title)}</code></h2>"
    yield f"<p>{_text(operation.get('description') or operation.get('summary', ''))}"
    parameters = [
        f"<li><code>{_text(one['name'])}</code> ({_text(one['in'])}, {_kind(one.get('schema', {}))}): "
        f"{_text(one.get('description', ''))}"
        for one in operation.get("parameters", [])
    ]
    yield _list("Parameters", parameters)
    yield _list("Body", list(_contents(operation.get("requestBody", {}))))
    answers = [
        f"<li>{_text(status)}: {_text(answer.get('description', ''))}"
        for status, answer in operation.get("responses", {}).items()
    ]
    yield _list("Answers", answers)


def _contents(body: Mapping[str, Any]) -> Iterator[str]:
    for media_type, content in body.get("content", {}).items():
        yield f"<li>{_text(media_type)}: {_kind(content.get('schema', {}))}"


def _schema(name: str, schema: Mapping[str, Any]) -> Iterator[str]:
    yield f'<h3 id="{_text(name)}">{_text(name)}</h3>'
    yield f"<p>{_text(schema.get('description', ''))}"
    required = schema.get("required", [])
    fields = [
        f"<li><code>{_text(field)}</code> ({_kind(value)}{', required' if field in required else ''}): "
        f"{_text(value.get('description', ''))}"
        for field, value in schema.get("properties", {}).items()
    ]
    yield _list("Fields", fields)


def _list(title: str, items: list[str]) -> str:
    return f"<p>{title}:\n<ul>\n" + "\n".join(items) + "\n</ul>" if items else ""


def _kind(schema: Mapping[str, Any]) -> str:
    """Type of a value in words, with links to the schemas."""
    if "$ref" in schema:
        name = _text(str(schema["$ref"]).rpartition("/")[2])
        return f'<a href="#{name}">{name}</a>'
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            return " or ".join(_kind(one) for one in schema[key])
    if "enum" in schema:
        return " or ".join(_text(repr(value)) for value in schema["enum"])
    if "const" in schema:
        return _text(repr(schema["const"]))
    if schema.get("type") == "array":
        return f"array of {_kind(schema.get('items', {}))}"
    return _text(str(schema.get("type", "any value")))


def _text(text: str) -> str:
    return html.escape(text)
