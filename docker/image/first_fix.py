"""Post the bundled report to a service that serves the bundled hall, and print the position.

``RAYFIX_URL`` is the service's address, ``RAYFIX_API_KEY_FILE`` the file with the key. A service of another site is
asked for its name only.
"""

import json
import os
import sys
import urllib.error
import urllib.request
from pathlib import Path

from rayfix.example.files import example_report

url = os.environ.get("RAYFIX_URL", "http://service:8000")
key = Path(os.environ.get("RAYFIX_API_KEY_FILE", "/run/secrets/api_key")).read_text(encoding="utf-8").strip()


def ask(path: str, body: str | None = None) -> dict:
    """Return the service's answer."""
    data = None if body is None else body.encode()
    headers = {"content-type": "application/json", "authorization": f"Bearer {key}"}
    request = urllib.request.Request(url + path, data, headers)
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        sys.exit(f"{url}{path}: {error.code} {error.read().decode()}")
    except OSError as error:
        sys.exit(f"{url}{path}: {error}")


site = ask("/v1/table")["site"]["name"]
if site != "hall":
    print(f"{url} serves site {site!r}")
else:
    fix = ask("/v1/positions", example_report())
    print(json.dumps({name: fix[name] for name in ("target_id", "status", "position")}))
