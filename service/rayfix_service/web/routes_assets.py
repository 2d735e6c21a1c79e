"""The viewer's page and its files."""

from functools import cache

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from rayfix_service.web.assets import INDEX, SECURITY_HEADERS, Asset, load_assets

router = APIRouter(include_in_schema=False)

_NOT_BUILT = """\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>rayfix</title>
<h1>rayfix</h1>
<p>The service runs, but its viewer is not built. With Node.js 20.19 or later, run <code>make viewer</code> in the
checkout and start the service again. Installed packages have the viewer.
<p><a href="/docs">The HTTP interface</a>
</html>
"""


@cache
def _assets() -> dict[str, Asset]:
    return load_assets()


@router.api_route("/", methods=["GET", "HEAD"])
async def get_viewer(request: Request) -> Response:
    """Give the viewer's page."""
    asset = _assets().get(INDEX)
    if asset is None:
        return Response(_NOT_BUILT, media_type="text/html", headers={**SECURITY_HEADERS, "Cache-Control": "no-cache"})
    return _answer(request, asset)


@router.api_route("/assets/{name:path}", methods=["GET", "HEAD"])
async def get_asset(request: Request, name: str) -> Response:
    """Give one of its files; their names change with their content."""
    asset = _assets().get(f"assets/{name}")
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
