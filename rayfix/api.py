"""Build a site's table from Python; needs the extra ``offline``."""

from pathlib import Path

from rayfix.extras import needs_extra
from rayfix_tables.table import Table


def build(
    site_path: str | Path,
    table_path: str | Path | None = None,
    *,
    jobs: int = -1,
    former: str | Path | None = None,
    tolerance: float = 0.0,
) -> Table:
    """Build a site's table and open it.

    Parameters
    ----------
    site_path : str or Path
        Site file.
    table_path : str or Path, optional
        Path of the new table; by default next to the site file, with the suffix ``.h5``.
    jobs : int
        Cells that are fitted at a time; -1 for one per core.
    former : str or Path, optional
        Table whose valid parts are reused; by default the one at ``table_path``, if there is one.
    tolerance : float
        Fraction of a cell's mass, 0 or more and below 1, that may have changed before a cell of the former table is
        fitted again. With 0, the table equals that of a new build.

    Raises
    ------
    SiteError, SceneError, BuildError, TableError
    """
    with needs_extra("offline"):
        from rayfix_offline.build import build_table

    table_path = Path(table_path) if table_path is not None else Path(site_path).with_suffix(".h5")
    build_table(site_path, table_path, jobs=jobs, former=former, tolerance=tolerance)
    return Table.open(table_path)
