"""Angle errors of antenna arrays in a scene: Delay-and-Sum, MVDR, MUSIC and ESPRIT on simulated snapshots.

Run with ``--table`` on any table, of which scene and stations are used; by default the bundled hall's is built.
"""

import json
from pathlib import Path

import numpy as np

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.arrays.picture import draw_angle_errors
from rayfix_evaluation.arrays.planar import PlanarArray, Signal
from rayfix_evaluation.arrays.study import ArrayStudy, angle_errors, statistics_rows, study_statistics
from rayfix_evaluation.drops.accuracy import drop_uniformly

STUDIES = {
    "4 x 4 antennas, 20 dB": ArrayStudy(
        array=PlanarArray(columns=4, rows=4), part=PlanarArray(columns=3, rows=3), signal=Signal(snr_db=20.0)
    ),
    "8 x 8 antennas, 20 dB": ArrayStudy(
        array=PlanarArray(columns=8, rows=8), part=PlanarArray(columns=6, rows=6), signal=Signal(snr_db=20.0)
    ),
    "8 x 8 antennas, 0 dB": ArrayStudy(
        array=PlanarArray(columns=8, rows=8), part=PlanarArray(columns=6, rows=6), signal=Signal(snr_db=0.0)
    ),
    "16 x 16 antennas, 20 dB": ArrayStudy(
        array=PlanarArray(columns=16, rows=16), part=PlanarArray(columns=12, rows=12), signal=Signal(snr_db=20.0)
    ),
}


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--drops", type=int, default=100)
    parser.add_argument("--picture", type=Path, help="where to draw the errors")
    parser.add_argument("--json", type=Path, help="where to write the statistics")
    options = parser.parse_args()
    with open_or_build(options.table) as table:
        drops = drop_uniformly(table, options.drops, np.random.default_rng([options.seed, 0]))
        stations = table.site.stations
    found, document = {}, {}
    for name, study in STUDIES.items():
        errors = angle_errors(drops, stations, study, np.random.default_rng([options.seed, 1]))
        found[name] = errors
        rows = statistics_rows(study_statistics(errors, study))
        document[name] = rows
        print(f"{name}; outliers are off by more than the beam width of {np.degrees(study.limit):.1f} deg")
        print(
            "estimator        50 %    90 %   outliers  other path   azimuth: bias  stdev   zenith: bias  stdev   tails"
        )
        for row in rows:
            apart = np.degrees(np.quantile(errors[row["estimator"]].apart, [0.5, 0.9]))
            bias, report = row["bias"], row["report"]
            tails = f"{report['tail_share']:.0%} x {report['tail_scale']:.1f}" if "tail_share" in report else "none"
            print(
                f"{row['estimator']:14} {apart[0]:6.2f} {apart[1]:7.2f} {row['outlier_share']:8.1%}"
                f" {row['other_path_share']:10.1%} {bias['azimuth_deg']:15.3f} {report['azimuth_stdev_deg']:8.3f}"
                f" {bias['zenith_deg']:12.3f} {report['zenith_stdev_deg']:8.3f}   {tails}",
                flush=True,
            )
    if options.picture:
        draw_angle_errors(options.picture, {name: (STUDIES[name], errors) for name, errors in found.items()})
    if options.json:
        options.json.write_text(json.dumps(document, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
