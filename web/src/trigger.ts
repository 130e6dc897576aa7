// A trigger as an oscilloscope has one: it finds where a value crosses a level.

export interface TriggerSettings {
  variable: string;
  element: number;
  level: number;
  edge: "rising" | "falling";
  /** Seconds after a trigger in which no other one counts. */
  hold: number;
  /** Whether it stays at the first trigger until it is armed again. */
  once: boolean;
}

export class Trigger {
  /** The time of the newest trigger; null before the first. */
  at: number | null = null;
  private before: { t: number; v: number } | null = null;

  constructor(readonly settings: TriggerSettings) {}

  get waits(): boolean {
    return !(this.settings.once && this.at !== null);
  }

  /** Takes a sample; returns the time of the crossing if this sample triggers, else null. */
  feed(t: number, v: number): number | null {
    if (this.before && t < this.before.t) {
      // A clock was put back, or another time was sought.
      this.before = null;
      if (!this.settings.once) this.at = null;
    }
    const before = this.before;
    this.before = Number.isFinite(v) ? { t, v } : null;
    if (!before || !this.before || !this.waits) return null;
    const { level, edge, hold } = this.settings;
    const crossed =
      edge === "rising" ? before.v < level && v >= level : before.v > level && v <= level;
    if (!crossed) return null;
    const at = before.t + (t - before.t) * ((level - before.v) / (v - before.v));
    if (this.at !== null && at < this.at + hold) return null;
    this.at = at;
    return at;
  }

  arm(): void {
    this.at = null;
    this.before = null;
  }
}

/** Returns the window to show: the trigger in the middle of `width` seconds. */
export function triggerWindow(at: number, width: number): [number, number] {
  return [at - width / 2, at + width / 2];
}
