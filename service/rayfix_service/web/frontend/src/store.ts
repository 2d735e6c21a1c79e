/** The fixes that have come, by target, and which of them is looked at. */

import { vec } from "./numeric";
import { followTrack, type TrackHistory } from "./tracks";
import type { FixEvent, Vec3 } from "./types";

export interface Target {
  id: string;
  latest: FixEvent;
  /** Positions, the latest last, m. */
  trail: Vec3[];
  /** True positions where they are known, the latest last, m. */
  truths: Vec3[];
  /** Where the service follows the target. */
  track: TrackHistory | null;
  count: number;
  /** When the latest came, ms. */
  seen: number;
}

const UNNAMED = "(unnamed)";
/** Positions of a trail. */
export const TRAIL = 120;
const MOST_TARGETS = 500;

export class Store {
  readonly targets = new Map<string, Target>();
  selected: Target | null = null;
  paused = false;
  total = 0;
  private readonly fixListeners: ((target: Target | null) => void)[] = [];
  private readonly selectListeners: (() => void)[] = [];

  /** Listen to fixes; given the target, or null when all of them have changed. */
  onFix(listener: (target: Target | null) => void): void {
    this.fixListeners.push(listener);
  }

  onSelect(listener: () => void): void {
    this.selectListeners.push(listener);
  }

  /** Take a fix in; one that a person asked for is selected. */
  add(event: FixEvent): void {
    const live = event.source === "stream";
    if (live && this.paused) return;
    const target = this.take(event);
    if (target === null) return;
    for (const listener of this.fixListeners) listener(target);
    if (!(live || event.source === "log") || this.selected === null) this.select(target.id);
  }

  /** Show these fixes, ascending by time, instead of all others; the selected target stays selected. */
  replay(events: readonly FixEvent[]): void {
    const selected = this.selected?.id ?? null;
    this.targets.clear();
    for (const event of events) this.take(event);
    for (const listener of this.fixListeners) listener(null);
    this.select(selected);
  }

  /** Take a fix in without a word; null for one that is there already. */
  private take(event: FixEvent): Target | null {
    const live = event.source === "stream";
    const id = event.fix.target_id ?? UNNAMED;
    this.total += 1;
    let target = this.targets.get(id);
    if (target === undefined) {
      if (this.targets.size >= MOST_TARGETS) this.forgetOldest();
      target = { id, latest: event, trail: [], truths: [], track: null, count: 0, seen: 0 };
      this.targets.set(id, target);
    }
    // A posted report comes back over the stream, too; it is one fix.
    const again = live && sameReport(target.latest, event) && target.count > 0;
    if (again) return null;
    target.latest = event;
    target.count += 1;
    target.seen = performance.now();
    if (event.fix.position !== null) target.trail.push(vec(event.fix.position));
    if (target.trail.length > TRAIL) target.trail.shift();
    if (event.fix.track) target.track = followTrack(target.track, event.fix.track, TRAIL);
    if (event.truth) target.truths.push(event.truth);
    if (target.truths.length > TRAIL) target.truths.shift();
    return target;
  }

  select(id: string | null): void {
    this.selected = id === null ? null : (this.targets.get(id) ?? null);
    for (const listener of this.selectListeners) listener();
  }

  /** Select the next or previous target in the order of the list. */
  step(by: number): void {
    const ids = this.ordered().map((t) => t.id);
    if (ids.length === 0) return;
    const at = this.selected === null ? -1 : ids.indexOf(this.selected.id);
    this.select(ids[(at + by + ids.length) % ids.length]!);
  }

  /** Whether the service follows any of them. */
  get hasTracks(): boolean {
    return [...this.targets.values()].some((target) => target.track !== null);
  }

  ordered(): Target[] {
    return [...this.targets.values()].sort((a, b) => a.id.localeCompare(b.id, undefined, { numeric: true }));
  }

  clear(): void {
    this.targets.clear();
    this.select(null);
    for (const listener of this.fixListeners) listener(null);
  }

  private forgetOldest(): void {
    const oldest = [...this.targets.values()].reduce((a, b) => (a.seen < b.seen ? a : b));
    this.targets.delete(oldest.id);
    if (this.selected === oldest) this.select(null);
  }
}

function sameReport(a: FixEvent, b: FixEvent): boolean {
  if (a.source === "stream" || a.fix.timestamp !== b.fix.timestamp) return false;
  const [p, q] = [a.fix.position, b.fix.position];
  return p !== null && q !== null && p.x === q.x && p.y === q.y && p.z === q.z;
}
