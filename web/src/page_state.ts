// What the user of this page chose to see: selection, tabs, charts, trigger.
import { want } from "./connection";
import { Keyed, live, useKey } from "./live_state";
import type { Ring } from "./ring";
import type { Series } from "./series";
import { Trigger, triggerWindow, type TriggerSettings } from "./trigger";

export const TABS = ["Tasks", "Task", "Variables", "Change", "Events", "Commands"] as const;
/**
 * What the page is for now: to watch and steer, to assemble a job, or to write a program of jobs.
 */
export const MODES = ["Watch", "Assemble", "Program"] as const;
export type Mode = (typeof MODES)[number];
export type Tab = (typeof TABS)[number];
export interface Chart {
  id: number;
  series: Series[];
}
/** What the charts show: the newest `width` seconds, or a fixed time for some reason. */
export type View =
  | { mode: "live" }
  | { mode: "held"; from: number; to: number; why: "paused" | "zoomed" | "triggered" };

class PageState extends Keyed {
  mode: Mode = "Watch";
  tab: Tab = "Tasks";
  /** Tasks that are selected, in the order in which they were. */
  selected: string[] = [];
  /** The task whose details are shown. */
  task = "";
  hovered = "";
  pinned = "";
  compact: boolean | null = null;
  folded = new Set<string>();
  charts: Chart[] = [];
  plotsOpen = true;
  width = 10;
  view: View = { mode: "live" };
  /** Samples as they were when the view was held. */
  held: ReadonlyMap<string, Ring> | null = null;
  trigger: Trigger | null = null;
  private lastChart = 0;
  private due: ReturnType<typeof setTimeout> | null = null;

  constructor() {
    super();
    live.onSample((name, t, v) => this.feed(name, t, v));
    live.subscribe("hello", () => this.load());
    live.subscribe("graph", () => this.forgetGone());
  }

  setMode(mode: Mode): void {
    this.mode = mode;
    this.tell("mode");
  }
  show(tab: Tab): void {
    this.tab = tab;
    this.tell("tab");
  }
  openTask(task: string): void {
    this.task = task;
    this.tell("task");
    this.show("Task");
  }
  select(tasks: string[]): void {
    if (tasks.join("\n") === this.selected.join("\n")) return;
    this.selected = tasks;
    if (tasks.length === 1 && tasks[0] !== this.task) {
      this.task = tasks[0]!;
      this.tell("task");
    }
    this.tell("selected");
  }
  hover(variable: string): void {
    this.hovered = variable;
    this.inspect();
  }
  pin(variable: string): void {
    this.pinned = this.pinned === variable ? "" : variable;
    this.inspect();
  }
  get inspected(): string {
    return this.hovered || this.pinned;
  }
  private inspect(): void {
    want("inspect", [this.pinned, this.hovered].filter(Boolean));
    this.tell("inspected");
  }
  setCompact(compact: boolean): void {
    this.compact = compact;
    this.tell("drawing");
  }
  fold(rtpu: string): void {
    this.folded = new Set(this.folded);
    if (!this.folded.delete(rtpu)) this.folded.add(rtpu);
    this.tell("drawing");
  }

  addSeries(series: Series[], chart?: number): void {
    const found = this.charts.find((one) => one.id === chart);
    if (found) {
      const fresh = series.filter(
        (one) =>
          !found.series.some(
            (each) => each.variable === one.variable && each.element === one.element,
          ),
      );
      this.setCharts(
        this.charts.map((one) =>
          one === found ? { ...one, series: [...one.series, ...fresh] } : one,
        ),
      );
    } else this.setCharts([...this.charts, { id: ++this.lastChart, series }]);
    if (!this.plotsOpen) this.togglePlots();
  }
  removeSeries(chart: number, series: Series): void {
    this.setCharts(
      this.charts.map((one) =>
        one.id === chart ? { ...one, series: one.series.filter((each) => each !== series) } : one,
      ),
    );
  }
  removeChart(chart: number): void {
    this.setCharts(this.charts.filter((one) => one.id !== chart));
  }
  togglePlots(): void {
    this.plotsOpen = !this.plotsOpen;
    this.watch();
    this.tell("charts");
  }

  setWidth(width: number): void {
    this.width = width;
    this.resume();
  }
  hold(from: number, to: number, why: "paused" | "zoomed" | "triggered"): void {
    if (this.view.mode === "live" || why === "triggered")
      this.held = new Map([...live.rings].map(([name, ring]) => [name, ring.copy()]));
    this.view = { mode: "held", from, to, why };
    this.tell("view");
  }
  pause(): void {
    const now = live.now();
    this.hold(now - this.width, now, "paused");
  }
  resume(): void {
    this.view = { mode: "live" };
    this.held = null;
    this.tell("view");
  }
  /** The times at the ends of the charts now. */
  range(): [number, number] {
    if (this.view.mode === "held") return [this.view.from, this.view.to];
    const now = live.now();
    return [now - this.width, now];
  }
  rings(): ReadonlyMap<string, Ring> {
    return this.held ?? live.rings;
  }

  arm(settings: TriggerSettings): void {
    this.trigger = new Trigger(settings);
    want("trigger", [settings.variable]);
    this.resume();
    this.tell("trigger");
  }
  disarm(): void {
    this.trigger = null;
    if (this.due) clearTimeout(this.due);
    this.due = null;
    want("trigger", []);
    this.resume();
    this.tell("trigger");
  }

  private feed(name: string, t: number, v: readonly (number | null)[]): void {
    const trigger = this.trigger;
    if (!trigger || name !== trigger.settings.variable || this.due) return;
    const at = trigger.feed(t, v[trigger.settings.element] ?? NaN);
    if (at === null) return;
    // Until what follows has come, too
    const rest = Math.max(0, at + this.width / 2 - live.now()) * 1000 + 100;
    this.due = setTimeout(() => {
      this.due = null;
      const [from, to] = triggerWindow(at, this.width);
      this.hold(from, to, "triggered");
      this.tell("trigger");
    }, rest);
    this.tell("trigger");
  }

  private setCharts(charts: Chart[]): void {
    this.charts = charts;
    this.watch();
    this.tell("charts");
    try {
      localStorage.setItem(this.place, JSON.stringify(charts.map((one) => one.series)));
    } catch {
      /* no storage: not kept */
    }
  }
  private get place(): string {
    return `pbonet charts of ${live.hello?.name ?? ""}`;
  }
  private load(): void {
    if (this.charts.length) return this.watch();
    try {
      const kept = JSON.parse(localStorage.getItem(this.place) ?? "[]") as Series[][];
      this.charts = kept.map((series) => ({ id: ++this.lastChart, series }));
    } catch {
      this.charts = [];
    }
    this.watch();
    this.tell("charts");
  }
  private watch(): void {
    want(
      "plots",
      this.plotsOpen ? this.charts.flatMap((one) => one.series.map((each) => each.variable)) : [],
    );
  }
  private forgetGone(): void {
    const there = new Set(live.graph?.tasks.map((one) => one.name));
    this.select(this.selected.filter((one) => there.has(one)));
    const known = this.charts.map((one) => ({
      ...one,
      series: one.series.filter((each) => live.variables.has(each.variable)),
    }));
    if (known.some((one, k) => one.series.length !== this.charts[k]!.series.length)) {
      this.charts = known;
      this.watch();
      this.tell("charts");
    }
  }
}

export const page = new PageState();
export const usePage = (key: string): number => useKey(page, key);
