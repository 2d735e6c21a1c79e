"""Print the OpenAPI document: ``python -m rayfix_service.server.openapi``."""

import json
from pathlib import Path

from rayfix_service.server.app import create_app


def openapi_text() -> str:
    """Write the OpenAPI document as it is committed in docs/openapi.json."""
    document = create_app(Path("no-table-is-read")).openapi()
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    print(openapi_text(), end="")
