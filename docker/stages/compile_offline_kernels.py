"""Compile the kernels of the builder into ``NUMBA_CACHE_DIR``, when its image is built, by building small tables."""

import tempfile
from pathlib import Path

from rayfix.example.files import write_example
from rayfix_offline.build import build_table
from rayfix_offline.check import check_site


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        site, table = write_example(folder, windows_deg=(4.0, 12.0)), Path(folder) / "hall.h5"
        check_site(site)
        build_table(site, table)
        # Once more with a station less and less reflecting walls, for the kernels that compare with a former table.
        text = site.read_text(encoding="utf-8").replace("reflection_loss_db = 6.0", "reflection_loss_db = 6.5")
        site.write_text(text, encoding="utf-8")
        build_table(site, table, tolerance=0.01)


if __name__ == "__main__":
    main()
