/** Fixes of a log, in the order of time, and which of them there were at a time. */

import type { Fix, FixEvent, Report } from "./types";

/** A line of `rayfix locate -o FIXES.jsonl`, as the viewer reads it. */
type Line = Fix & { log: string; entry: number; report?: Report };

export interface Recording {
  name: string;
  /** Ascending by time. */
  events: readonly FixEvent[];
  /** Seconds of each event since the first. */
  seconds: Float64Array;
  /** Time of the first event, ms since 1970; null where fixes have no times and one a second is played. */
  begin: number | null;
}

/** Whether a text begins as `rayfix locate -o FIXES.jsonl` does. */
export const isFixes = (text: string): boolean => text.startsWith('{"log":');

/** Read the fixes of a log; throws for a line that is none. */
export function readFixes(name: string, text: string): Recording {
  const lines = text.split("\n").map((line, n) => ({ line, number: n + 1 }));
  return recordingOf(
    name,
    lines.filter(({ line }) => line.trim()).map(({ line, number }) => eventOf(line, number)),
  );
}

function eventOf(text: string, number: number): FixEvent {
  let line: unknown;
  try {
    line = JSON.parse(text);
  } catch (error) {
    throw new Error(`Line ${number} is no JSON – ${(error as Error).message}`, { cause: error });
  }
  if (!isLine(line)) throw new Error(`Line ${number} is no fix as rayfix locate -o FIXES.jsonl writes them.`);
  const { report, ...fix } = line;
  return { report: report ?? { measurements: [] }, fix, source: "log" };
}

const isLine = (line: unknown): line is Line =>
  typeof line === "object" && line !== null && "status" in line && "candidates" in line && "measurements" in line;

/** Order events by time; one without a time comes with the one before it. */
export function recordingOf(name: string, events: readonly FixEvent[]): Recording {
  const times = events.map(({ fix }) => (fix.timestamp === null ? NaN : Date.parse(fix.timestamp)));
  const begin = times.reduce((least, time) => (time < least ? time : least), Infinity);
  if (!Number.isFinite(begin)) return { name, events, seconds: Float64Array.from(events.keys()), begin: null };
  let before = begin;
  const timed = events.map((event, n) => {
    before = Number.isNaN(times[n]!) ? before : times[n]!;
    return { event, seconds: (before - begin) / 1000 };
  });
  timed.sort((a, b) => a.seconds - b.seconds); // stable: those of one time stay in the log's order
  return { name, events: timed.map(({ event }) => event), seconds: Float64Array.from(timed, (t) => t.seconds), begin };
}

/** Seconds from the first event to the last. */
export const durationOf = ({ seconds }: Recording): number => seconds.at(-1) ?? 0;

/** How many events there were up to a time, that time included. */
export function countUntil({ seconds }: Recording, time: number): number {
  let [low, high] = [0, seconds.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (seconds[middle]! <= time) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The latest events before the `count`-th, at most `most` of each target, ascending. */
export function latestOf({ events }: Recording, count: number, most: number): FixEvent[] {
  const seen = new Map<string | null, number>();
  const latest: FixEvent[] = [];
  for (let n = count - 1; n >= 0; n--) {
    const event = events[n]!;
    const before = seen.get(event.fix.target_id) ?? 0;
    if (before >= most) continue;
    seen.set(event.fix.target_id, before + 1);
    latest.push(event);
  }
  return latest.reverse();
}

/** The time of a place in the recording, as people read it. */
export function clockText({ begin, events }: Recording, seconds: number): string {
  if (begin === null) return `${Math.min(events.length, Math.floor(seconds) + 1)} of ${events.length}`;
  return new Date(begin + 1000 * seconds).toISOString().slice(11, 21);
}
