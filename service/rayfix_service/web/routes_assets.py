"""Routes of the viewer's page, the page of the HTTP interface, and their files."""

from functools import cache
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from rayfix_service.http.access.prefix import prefix_of
from rayfix_service.http.routes.dependencies import ServicesDep
from rayfix_service.web.assets import INDEX, INTERFACE, SECURITY_HEADERS, Asset, load_assets
from rayfix_service.web.plain_interface import plain_interface
from rayfix_service.web.site_examples import with_site_examples

router = APIRouter(include_in_schema=False)

_NOT_BUILT = """\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="color-scheme" content="light dark">
<title>rayfix</title>
<h1>rayfix</h1>
<p>The service runs, but this installation has no viewer, because there was no Node.js 20.19 or later when it was
made. With that, run <code>make viewer</code> in the checkout, or install rayfix again, and start the service again.
<p><a href="docs">The HTTP interface</a>, and <a href="openapi.json">its OpenAPI document</a>
</html>
"""


@cache
def _assets() -> dict[str, Asset]:
    return load_assets()


@router.api_route("/", methods=["GET", "HEAD"])
async def get_viewer(request: Request) -> Response:
    """Return the viewer's page."""
    asset = _assets().get(INDEX)
    return _plain(_NOT_BUILT) if asset is None else _answer(request, asset)


@router.api_route("/docs", methods=["GET", "HEAD"])
async def get_interface(request: Request) -> Response:
    """Return the page that shows the OpenAPI document."""
    asset = _assets().get(INTERFACE)
    return _plain(plain_interface(request.app.openapi())) if asset is None else _answer(request, asset)


@router.api_route("/openapi.json", methods=["GET", "HEAD"])
async def get_openapi(request: Request, services: ServicesDep) -> Response:
    """Return the OpenAPI document, with examples for the served table and the path prefix of a proxy."""
    document: dict[str, Any] = request.app.openapi()
    tables = services.tables.at_hand()
    if tables:
        table = tables[0].locator.table
        document = await services.table_cache.get(
            table.table_id, "openapi.json", lambda: with_site_examples(document, table)
        )
    if prefix := prefix_of(request.scope):
        document = {**document, "servers": [{"url": prefix}]}
    return JSONResponse(document, headers={"Cache-Control": "no-cache"})


@router.api_route("/assets/{name:path}", methods=["GET", "HEAD"])
async def get_viewer_file(request: Request, name: str) -> Response:
    """Return one of the viewer's files; their names change with their content."""
    return _file(request, f"assets/{name}")


@router.api_route("/interface/{name:path}", methods=["GET", "HEAD"])
async def get_interface_file(request: Request, name: str) -> Response:
    """Return one of the files of the HTTP interface's page; their names change with their content."""
    return _file(request, f"interface/{name}")


def _plain(page: str) -> Response:
    return Response(page, media_type="text/html", headers={**SECURITY_HEADERS, "Cache-Control": "no-cache"})


def _file(request: Request, name: str) -> Response:
    asset = _assets().get(name)
    if asset is None:
        raise HTTPException(404)
    return _answer(request, asset)


def _answer(request: Request, asset: Asset) -> Response:
    headers = {**SECURITY_HEADERS, "Cache-Control": asset.cache_control, "ETag": asset.tag, "Vary": "Accept-Encoding"}
    if request.headers.get("if-none-match") == asset.tag:
        return Response(status_code=304, headers=headers)
    body = asset.body
    if asset.compressed is not None and "gzip" in request.headers.get("accept-encoding", ""):
        body = asset.compressed
        headers["Content-Encoding"] = "gzip"
    return Response(body, media_type=asset.media_type, headers=headers)
