"""Site files of the tables that an evaluation needs besides the site's own."""

from pathlib import Path

import tomli_w

from rayfix_evaluation.studies.variants import _variant
from rayfix_offline.site import read_site


def test_the_site_file_of_a_variant_is_read_back_whatever_the_folder_is_named(room_site: Path, tmp_path: Path) -> None:
    """A scene's path is written into the file, so that quotes and characters beyond the first 65,536 occur in it."""
    folder = tmp_path / 'the "hall" \N{FACTORY} \N{GRINNING FACE}'
    folder.mkdir()
    for name in ("site.toml", "room.glb"):
        (folder / name).write_bytes((room_site.parent / name).read_bytes())
    site = read_site(folder / "site.toml")
    written = tmp_path / "uniform.toml"
    written.write_text(tomli_w.dumps(_variant(site, folder / "site.toml", "uniform", True)), encoding="utf-8")
    variant = read_site(written)
    assert Path(variant.site.scene) == folder / "room.glb"
    assert variant.propagation.path_prior == "uniform"
    assert variant.table.windows_deg == (12.0,)
    assert variant.stations == site.stations
