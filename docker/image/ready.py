"""Health check: ends with status 0 when the service of this container can locate."""

import os
import sys
import urllib.error
import urllib.request

url = f"http://127.0.0.1:{os.environ.get('RAYFIX_PORT', '8000')}/readyz"
try:
    urllib.request.urlopen(url, timeout=3).close()
except OSError as error:
    sys.exit(f"{url}: {error}")
