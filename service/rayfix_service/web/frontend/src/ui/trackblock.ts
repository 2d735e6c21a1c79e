/** The track of a target in numbers, and what it shares with the fix. */

import { h } from "../dom";
import { deviation, rounded, withDeviation } from "../rounding";
import { percent } from "../scene/selection";
import { STATE_MEANING, speedOf, speedStdev } from "../tracks";
import type { Matrix3, Point, Track } from "../types";

const AXES = ["x", "y", "z"] as const;

/** Each coordinate as its deviation deserves. */
function texts(p: Point, covariance: Matrix3 | null): string[] {
  return AXES.map((axis, n) => rounded(p[axis], Math.sqrt(covariance?.[n]![n as 0 | 1 | 2] ?? 0)));
}

export const pointText = (p: Point, covariance: Matrix3): string => texts(p, covariance).join(", ");

/** A position that is looked at when clicked. */
export function coordinates(p: Point, covariance: Matrix3 | null, onFocus: (p: Point) => void, title: string): HTMLElement {
  const values = texts(p, covariance);
  return h(
    "button",
    { type: "button", className: "coordinates", title, onclick: () => onFocus(p) },
    ...AXES.map((axis, n) => h("span", {}, h("small", {}, axis), values[n])),
    h("span", { className: "unit" }, "m"),
  );
}

export const fact = (name: string, value: string, title = ""): HTMLElement =>
  h("div", { title }, h("dt", {}, name), h("dd", {}, value));

export function trackBlock(track: Track, confidence: number, onFocus: (p: Point) => void): HTMLElement {
  const held = `with a probability of ${percent(confidence)}`;
  return h(
    "div",
    { className: "track" },
    h(
      "div",
      { className: "heading" },
      h("h3", {}, "Track"),
      h("span", { className: `chip ${track.state}`, title: STATE_MEANING[track.state] }, track.state),
    ),
    h("p", { className: "muted" }, STATE_MEANING[track.state]),
    coordinates(track.position, track.covariance_m2, onFocus, "Look there"),
    h(
      "dl",
      { className: "facts" },
      fact("horizontal", `± ${deviation(track.horizontal_accuracy_m)} m`, held),
      fact("vertical", `± ${deviation(track.vertical_accuracy_m)} m`, held),
      fact("speed", withDeviation(speedOf(track), speedStdev(track), " m/s"), "over ground, with its standard deviation"),
      fact("reports", String(track.num_reports), "since the track's start that constrained the position"),
      fact("there with", percent(track.probability), "less than all while rivals live"),
    ),
    h("p", { className: "muted number stamp" }, track.timestamp),
  );
}
