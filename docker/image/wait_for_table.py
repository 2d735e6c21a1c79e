"""Wait until a table is there: ``wait_for_table.py FILE``. Tables appear under their name when they are whole."""

import sys
import time
from pathlib import Path

file = Path(sys.argv[1])
print(f"waiting for {file}", flush=True)
while not file.exists():
    time.sleep(1.0)
print(f"{file} is there")
