import { describe, expect, test } from "vitest";

import { clockText, countUntil, durationOf, isFixes, latestOf, readFixes } from "../src/recording";
import { Store, TRAIL } from "../src/store";

const fix = (target: string, timestamp: string | null, x: number, more: object = {}): string =>
  JSON.stringify({
    log: "a.jsonl",
    entry: 1,
    target_id: target,
    timestamp,
    status: "ok",
    position: { x, y: 0, z: 1 },
    candidates: [],
    measurements: [],
    ...more,
  });

const at = (seconds: number): string => `2026-01-31T10:00:${String(seconds).padStart(2, "0")}Z`;

describe("fixes of a log", () => {
  test("are told from reports by their beginning", () => {
    expect(isFixes(fix("a", null, 0))).toBe(true);
    expect(isFixes('{"measurements": []}')).toBe(false);
  });

  test("are ordered by time, and those of one time stay as they were", () => {
    const recording = readFixes("f", [fix("a", at(4), 1), fix("b", at(2), 2), "", fix("c", at(4), 3)].join("\n"));
    expect(recording.events.map((e) => e.fix.target_id)).toEqual(["b", "a", "c"]);
    expect([...recording.seconds]).toEqual([0, 2, 2]);
    expect(durationOf(recording)).toBe(2);
    expect(clockText(recording, 1.25)).toBe("10:00:03.2");
  });

  test("without times are played one a second", () => {
    const recording = readFixes("f", [fix("a", null, 1), fix("a", null, 2)].join("\n"));
    expect([...recording.seconds]).toEqual([0, 1]);
    expect(clockText(recording, 0.5)).toBe("1 of 2");
  });

  test("one without a time comes with the one before it", () => {
    const recording = readFixes("f", [fix("a", at(1), 1), fix("a", at(5), 2), fix("a", null, 3)].join("\n"));
    expect([...recording.seconds]).toEqual([0, 4, 4]);
  });

  test("keep reports where they have them", () => {
    const report = { measurements: [{ type: "pt", station_id: "bs1" }] };
    const [first, second] = readFixes("f", [fix("a", at(1), 1, { report }), fix("a", at(2), 1)].join("\n")).events;
    expect(first!.report).toEqual(report);
    expect(second!.report.measurements).toEqual([]);
  });

  test.each([["no JSON", "{"], ["no fix", '{"log": "a"}'], ["no fix", "[]"]])("name the line that is %s", (what, line) => {
    expect(() => readFixes("f", `${fix("a", at(1), 1)}\n${line}`)).toThrow(`Line 2 is ${what}`);
  });

  test("up to a time are counted", () => {
    const recording = readFixes("f", [0, 1, 1, 3].map((s) => fix("a", at(s), s)).join("\n"));
    expect([-1, 0, 0.5, 1, 2, 3, 9].map((time) => countUntil(recording, time))).toEqual([0, 1, 1, 3, 3, 4, 4]);
  });

  test("are shown as they were at any time, whichever way one came there", () => {
    const lines = Array.from({ length: 300 }, (_, n) => fix(n % 3 === 0 ? "b" : "a", at(Math.floor(n / 5)), n));
    const recording = readFixes("f", lines.join("\n"));
    recording.events.forEach((event, n) => (event.truth = [n, n, 0]));
    const [played, sought] = [new Store(), new Store()];
    for (const event of recording.events.slice(0, 290)) played.add(event);
    sought.replay(recording.events.slice(0, 3));
    sought.replay(latestOf(recording, 290, TRAIL));
    for (const id of ["a", "b"]) {
      const [one, other] = [played, sought].map((store) => store.targets.get(id)!);
      expect(other!.trail).toEqual(one!.trail);
      expect(other!.truths).toEqual(one!.truths);
      expect(other!.latest).toBe(one!.latest);
    }
    expect(played.targets.get("a")!.trail).toHaveLength(TRAIL);
  });

  test("leave the selected target selected", () => {
    const recording = readFixes("f", [fix("a", at(1), 1), fix("b", at(2), 2)].join("\n"));
    const store = new Store();
    store.replay(recording.events);
    store.select("b");
    store.add(recording.events[0]!);
    expect(store.selected!.id).toBe("b");
    store.replay(recording.events.slice(0, 1));
    expect(store.selected).toBeNull();
  });
});
