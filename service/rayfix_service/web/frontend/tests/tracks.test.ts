import { describe, expect, test } from "vitest";

import { followTrack, speedOf, speedStdev, type TrackHistory } from "../src/tracks";
import type { Track } from "../src/types";

function track(state: Track["state"], x: number, more: Partial<Track> = {}): Track {
  return {
    state,
    timestamp: `2026-01-31T10:00:0${Math.abs(x)}Z`,
    num_reports: 1,
    probability: 1,
    position: { x, y: 0, z: 1 },
    covariance_m2: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    velocity_m_s: { x: 0, y: 0, z: 0 },
    velocity_covariance_m2_s2: [[0.04, 0, 0], [0, 0.09, 0], [0, 0, 1]],
    horizontal_accuracy_m: 1,
    vertical_accuracy_m: 1,
    ...more,
  };
}

const follow = (...tracks: Track[]): TrackHistory =>
  tracks.reduce<TrackHistory | null>((before, each) => followTrack(before, each, 3), null)!;
const along = (history: TrackHistory): number[] => history.trail.map(([x]) => x);

describe("a trail of a track", () => {
  test("grows with each report, and forgets the oldest positions", () => {
    expect(along(follow(track("started", 1), track("updated", 2)))).toEqual([1, 2]);
    expect(along(follow(track("started", 1), track("updated", 2), track("predicted", 3), track("updated", 4)))).toEqual([2, 3, 4]);
  });

  test("begins anew with the track: no line joins what is before and after", () => {
    const history = follow(track("started", 1), track("updated", 2), track("restarted", 7));
    expect(along(history)).toEqual([7]);
    expect(along(follow(track("updated", 1), track("started", 8)))).toEqual([8]);
  });

  test("is not changed by a late report, whose state is kept", () => {
    const history = follow(track("started", 1), track("updated", 2), track("late", 2));
    expect(along(history)).toEqual([1, 2]);
    expect(history.latest.state).toBe("late");
  });

  test("begins with whatever comes first, as the page may be opened later than the track", () => {
    expect(along(follow(track("late", 5)))).toEqual([5]);
  });
});

describe("speed", () => {
  test("is over ground", () => {
    expect(speedOf(track("updated", 1, { velocity_m_s: { x: 3, y: -4, z: 12 } }))).toBe(5);
  });

  test("has the deviation along the velocity", () => {
    const towards = (x: number, y: number): number => speedStdev(track("updated", 1, { velocity_m_s: { x, y, z: 0 } }));
    expect(towards(2, 0)).toBeCloseTo(0.2, 12);
    expect(towards(0, -1)).toBeCloseTo(0.3, 12);
    expect(towards(1, 1)).toBeCloseTo(Math.sqrt(0.065), 12);
    expect(towards(0, 0)).toBeCloseTo(0.3, 12);
  });
});
