/** Plays the fixes of a log: begin and halt, a slider over its time, speeds. */

import { h, replace } from "../dom";
import { clockText, countUntil, durationOf, latestOf, type Recording } from "../recording";
import { TRAIL, type Store } from "../store";

const SPEEDS = [0.25, 0.5, 1, 2, 5, 10, 30, 60] as const;
const STEPS = 1000; // of the slider
const AT_ONCE = 200; // fixes between two pictures, from which on only the latest are shown

export class Player {
  readonly element = h("div", { id: "player", role: "group", "aria-label": "Recorded log", hidden: true });
  private readonly button = h("button", { type: "button", onclick: () => this.toggle() });
  private readonly slider = h("input", { type: "range", min: "0", max: String(STEPS), step: "any", value: "0", "aria-label": "Time in the log" });
  private readonly clock = h("output", { className: "number" });
  private readonly name = h("span", { className: "muted" });
  private readonly speed = h("select", { "aria-label": "Speed", title: "Speed" });
  private recording: Recording | null = null;
  private at = 0; // s
  private count = 0;
  private playing = false;
  private last = 0;

  constructor(
    private readonly store: Store,
    private readonly onChange: () => void,
  ) {
    for (const speed of SPEEDS) {
      this.speed.append(h("option", { value: String(speed), selected: speed === 1 }, `${speed} ×`));
    }
    this.slider.addEventListener("input", () => this.seek((Number(this.slider.value) / STEPS) * this.duration));
    const close = h("button", { type: "button", title: "Close the log", "aria-label": "Close the log", onclick: () => this.close() }, "✕");
    this.element.append(this.button, this.slider, this.clock, this.speed, this.name, close);
  }

  /** Whether a log is shown; the fixes of a stream are left out meanwhile. */
  get active(): boolean {
    return this.recording !== null;
  }

  /** Show a log, halted at its first fix. */
  open(recording: Recording): void {
    this.recording = recording;
    this.playing = false;
    this.name.textContent = `${recording.name}, ${recording.events.length} fixes`;
    this.element.hidden = false;
    this.seek(0);
    this.store.select(recording.events[0]?.fix.target_id ?? null);
    this.onChange();
  }

  close(): void {
    this.recording = null;
    this.playing = false;
    this.element.hidden = true;
    this.store.clear();
    this.onChange();
  }

  toggle(): void {
    if (this.recording === null) return;
    if (!this.playing && this.at >= this.duration) this.seek(0);
    this.playing = !this.playing;
    this.last = performance.now();
    if (this.playing) requestAnimationFrame((now) => this.advance(now));
    this.describe();
  }

  /** Show the log as it was at a time, s after its first fix. */
  seek(seconds: number): void {
    const { recording } = this;
    if (recording === null) return;
    this.at = Math.min(Math.max(seconds, 0), this.duration);
    this.count = countUntil(recording, this.at);
    this.store.replay(latestOf(recording, this.count, TRAIL));
    this.describe();
  }

  private get duration(): number {
    return this.recording === null ? 0 : durationOf(this.recording);
  }

  private advance(now: number): void {
    const { recording } = this;
    if (!this.playing || recording === null) return;
    const next = Math.min(this.at + (Math.max(now - this.last, 0) / 1000) * Number(this.speed.value), this.duration);
    this.last = now;
    const count = countUntil(recording, next);
    if (count - this.count > AT_ONCE) this.seek(next);
    else {
      for (const event of recording.events.slice(this.count, count)) this.store.add(event);
      this.at = next;
      this.count = count;
    }
    this.playing = this.at < this.duration;
    if (this.playing) requestAnimationFrame((later) => this.advance(later));
    this.describe();
  }

  private describe(): void {
    const { recording } = this;
    if (recording === null) return;
    const title = this.playing ? "Halt (Space)" : "Play (Space)";
    this.button.title = title;
    this.button.setAttribute("aria-label", title);
    replace(this.button, this.playing ? "❚❚" : "▶");
    this.clock.textContent = clockText(recording, this.at);
    this.slider.value = String(this.duration > 0 ? (STEPS * this.at) / this.duration : 0);
  }
}
