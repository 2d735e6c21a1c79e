"""Fetch a table: ``fetch_table.py URL TABLE_ID FILE``; an object store's signed URL, say. Ends at once if it is there.

The table gets its name once it is whole and its content has the hash that was asked for.
"""

import os
import shutil
import sys
import urllib.request
from pathlib import Path

from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table

url, table_id, file = sys.argv[1], sys.argv[2], Path(sys.argv[3])


def is_it(path: Path) -> bool:
    """Whether a file is the table that is wanted, and whole."""
    if not path.exists():
        return False
    try:
        table = Table.open(path)
        table.verify()
    except RayfixError as error:
        print(error, file=sys.stderr)
        return False
    print(f"{path} is table {table.table_id}", flush=True)
    return table.table_id == table_id


if is_it(file):
    sys.exit(0)
part = file.with_name(f".{file.name}.part-{os.getpid()}")
try:
    with urllib.request.urlopen(url, timeout=60) as answer, part.open("wb") as sink:
        shutil.copyfileobj(answer, sink, 1 << 20)
    if not is_it(part):
        sys.exit(f"what {url.partition('?')[0]} holds is not table {table_id}; check address and hash")
    part.replace(file)
except OSError as error:
    sys.exit(f"cannot fetch {url.partition('?')[0]} to {file}: {error}")
finally:
    part.unlink(missing_ok=True)
