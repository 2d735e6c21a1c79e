/** The track of a target as the stream tells it: the latest one, and where it was before. */

import { vec } from "./numeric";
import type { Track, Vec3 } from "./types";

export interface TrackHistory {
  latest: Track;
  /** Positions since the track's start, the latest last, m. */
  trail: readonly Vec3[];
}

/** What a report did to the track. */
export const STATE_MEANING: Record<Track["state"], string> = {
  started: "first report of this target",
  updated: "the report was fused with those before",
  restarted: "begun anew: a long pause, or a report that contradicts the track",
  predicted: "no measurement of the report could be used; the track is moved on",
  late: "the report is not after the last one and changed nothing",
};

/**
 * Take in the track after a report; the trail keeps at most `most` positions. A track that begins anew begins a trail,
 * so that no line joins positions that the target did not move between. A late report adds none.
 */
export function followTrack(before: TrackHistory | null, track: Track, most: number): TrackHistory {
  const at = vec(track.position);
  if (before === null || track.state === "started" || track.state === "restarted") return { latest: track, trail: [at] };
  if (track.state === "late") return { latest: track, trail: before.trail };
  return { latest: track, trail: [...before.trail, at].slice(-most) };
}

/** Speed over ground, m/s. */
export const speedOf = (track: Track): number => Math.hypot(track.velocity_m_s.x, track.velocity_m_s.y);

/** Standard deviation of that speed along the velocity, m/s; of the faster axis where the target stands still. */
export function speedStdev(track: Track): number {
  const { x, y } = track.velocity_m_s;
  const [[xx, xy], [, yy]] = track.velocity_covariance_m2_s2 as unknown as [[number, number], [number, number]];
  const speed = Math.hypot(x, y);
  if (speed === 0) return Math.sqrt(Math.max(xx, yy));
  return Math.sqrt(Math.max(0, (x * x * xx + 2 * x * y * xy + y * y * yy) / (speed * speed)));
}
