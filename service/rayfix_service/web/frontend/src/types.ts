/** The JSON of the service, as far as the viewer reads it, and the viewer's own shapes. */

export type Vec3 = readonly [number, number, number];

export interface Point {
  x: number;
  y: number;
  z: number;
}

export type Matrix3 = readonly (readonly [number, number, number])[];

export interface TableInfo {
  /** Name among the tables of the service. */
  name: string;
  table_id: string;
  software_version: string;
  site: { name: string; north_deg: number; max_path_length_m: number };
  num_components: number;
}

export interface StationInfo {
  id: string;
  position: Point;
  orientation: { bearing_deg: number; downtilt_deg: number; slant_deg: number };
  boresight: { azimuth_deg: number; downtilt_deg: number };
  field_of_view_deg: number;
  levels: { window_deg: number; num_cells: number; num_components: number }[];
  /** Absent in pages of earlier versions. */
  calibration?: Calibration | null;
}

/** Biases, measured minus true, and deviations that count instead of the stated ones. */
export interface Calibration {
  range_m: number;
  azimuth_deg: number;
  zenith_deg: number;
  /** What depends on the direction: a row for each zenith of the grid. */
  angles: { azimuths_deg: number[]; zeniths_deg: number[]; azimuth_deg: number[][]; zenith_deg: number[][] } | null;
  azimuth_stdev_deg: number | null;
  zenith_stdev_deg: number | null;
  range_stdev_m: number | null;
}

export interface ViewerSettings {
  simulation: boolean;
  max_reflections: number;
  /** Materials of the scene that let signals through. */
  open_materials: string[];
}

export interface Measurement {
  type: string;
  station_id: string;
  reference_station_id?: string;
  frame?: "scene" | "lcs" | "north";
  azimuth_deg?: number;
  zenith_deg?: number | null;
  azimuth_stdev_deg?: number;
  zenith_stdev_deg?: number | null;
  [key: string]: unknown;
}

export interface Report {
  target_id?: string | null;
  timestamp?: string | null;
  measurements: Measurement[];
  [key: string]: unknown;
}

export interface Candidate {
  probability: number;
  position: Point;
  covariance_m2: Matrix3;
}

export interface Outcome {
  index: number;
  used: boolean;
  outlier_probability: number | null;
  reason?: string;
}

/** What is known of a target from all its reports, after one of them; docs/tracking.md. */
export interface Track {
  state: "started" | "updated" | "restarted" | "predicted" | "late";
  timestamp: string;
  num_reports: number;
  probability: number;
  position: Point;
  covariance_m2: Matrix3;
  velocity_m_s: Point;
  velocity_covariance_m2_s2: Matrix3;
  horizontal_accuracy_m: number;
  vertical_accuracy_m: number;
}

export interface Fix {
  target_id: string | null;
  timestamp: string | null;
  status: "ok" | "ambiguous" | "inconsistent" | "insufficient";
  position: Point | null;
  covariance_m2: Matrix3 | null;
  horizontal_accuracy_m: number | null;
  vertical_accuracy_m: number | null;
  ellipsoid_semi_axes_m: Matrix3 | null;
  confidence: number;
  candidates: Candidate[];
  measurements: Outcome[];
  /** Of an inconsistent fix; absent otherwise. */
  warnings?: string[];
  /** Where the service follows the target. */
  track?: Track | null;
  table_id: string;
  /** Absent in the fixes of a log. */
  compute_ms?: number;
}

export interface Posterior {
  gaussians: Candidate[];
  num_gaussians: number;
  prior_share: number;
  samples: Vec3[];
}

/** A fix with the report that it answers, and where it came from. */
export interface FixEvent {
  report: Report;
  fix: Fix;
  source: "stream" | "posted" | "simulated" | "file" | "log";
  /** Where a simulated or surveyed UE was. */
  truth?: Vec3;
  posterior?: Posterior;
}

export interface MixtureView {
  station_id: string;
  in_field_of_view: boolean;
  level: number;
  window_deg: number;
  cells: { index: number; azimuth_deg: number; zenith_deg: number; num_components: number }[];
  num_cells: number;
  log_evidence: number | null;
  num_components: number;
  components: {
    probability: number;
    log_weight: number;
    position: Point;
    covariance_m2: Matrix3;
    path_length_m: number;
    path_length_stdev_m: number;
    num_reflections: number;
    num_walls: number;
  }[];
  by_reflections: number[];
  by_walls: number[];
}

export interface Coverage {
  station_id: string;
  coverage: number[];
  wall_coverage: number[];
  levels: { window_deg: number; num_cells: number; num_filled_cells: number; mass_by_reflections: number[] }[];
}

/** All that a page of `rayfix view` holds. */
export interface EmbeddedData {
  table: TableInfo;
  stations: StationInfo[];
  settings: ViewerSettings;
  scene_base64: string;
  events: FixEvent[];
  /** Fixes of a log, to be played. */
  recording?: { name: string; events: FixEvent[] };
}

/** What the viewer knows of the site once it is loaded. */
export interface Site {
  table: TableInfo;
  stations: StationInfo[];
  settings: ViewerSettings;
}

export interface Mesh {
  /** Corners in the scene frame less `origin`, m. */
  positions: Float32Array;
  origin: Vec3;
  groups: { material: string; colour: Vec3; indices: Uint32Array }[];
}
