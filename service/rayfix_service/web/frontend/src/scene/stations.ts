/** Stations: a dot with the identifier, and a cone that opens along the station's boresight. */

import { ConeGeometry, Group, Mesh, MeshBasicMaterial, Quaternion, Vector3 } from "three";

import { DEG, direction, vec } from "../numeric";
import { theme } from "../theme";
import type { StationInfo } from "../types";
import { Dots } from "./shapes";
import type { Stage } from "./stage";

const NARROWEST = 12; // degrees that a cone opens to at least and at most
const WIDEST = 70;

export class Stations {
  readonly group = new Group();
  private readonly material = new MeshBasicMaterial({ transparent: true, opacity: 0.85, depthWrite: false });
  private readonly dots = new Dots({ rim: 0.28, throughWalls: true });
  private readonly places: Vector3[];

  constructor(stage: Stage, stations: readonly StationInfo[], size: number) {
    this.places = stations.map((s) => stage.local(vec(s.position)));
    stations.forEach((station, n) => {
      const { azimuth_deg, downtilt_deg } = station.boresight;
      const axis = new Vector3(...direction(azimuth_deg * DEG, (90 + downtilt_deg) * DEG));
      const opening = Math.min(Math.max(station.field_of_view_deg / 8, NARROWEST), WIDEST);
      const cone = new ConeGeometry(size * Math.tan((opening * Math.PI) / 360), size, 24, 1, true);
      // Its tip is at the station, its axis the boresight.
      cone.translate(0, -size / 2, 0);
      const mesh = new Mesh(cone, this.material);
      mesh.quaternion.copy(new Quaternion().setFromUnitVectors(new Vector3(0, -1, 0), axis));
      mesh.position.copy(this.places[n]!);
      mesh.renderOrder = 2;
      this.group.add(mesh);
      stage.labels.add(station.id, "station", this.places[n]!.clone());
    });
    this.group.add(this.dots);
    theme.onChange(() => this.paint());
    this.paint();
  }

  private paint(): void {
    const { palette } = theme;
    this.material.color.set(palette.station);
    this.dots.setRim(palette.background);
    this.dots.set(this.places.map((position) => ({ position, colour: palette.station, diameter: 12 })));
  }
}
