"""The job of the offline image: build the table of ``/site/site.toml``, or of the bundled hall where there is none.

The table is ``/tables/site.h5``, or what ``RAYFIX_TABLE_NAME`` names. It appears there when it is whole. A table that
is there already is taken over as far as it holds, so that the job may run at every start; a killed job goes on.
"""

import os
import sys
from pathlib import Path

from rayfix.example.files import write_example

site = Path("/site/site.toml")
if not site.exists():
    site = write_example("/tmp/hall")
    print(f"There is no /site/site.toml: building the bundled hall, {site}.")
table = Path("/tables") / os.environ.get("RAYFIX_TABLE_NAME", "site.h5")
start = Path(__file__).with_name("start.py")
os.execv(
    sys.executable, [sys.executable, str(start), "build", str(site), "-o", str(table), "--no-progress", *sys.argv[1:]]
)
