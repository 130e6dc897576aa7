// One chart with uPlot: it is drawn from samples outside of React.
import uPlot from "uplot";
import { clock } from "./format";
import { live } from "./live_state";
import { page } from "./page_state";
import { alignSeries, type Series, type Table } from "./series";

export const COLOURS = [
  "#2a7fd4",
  "#d9651b",
  "#12a06c",
  "#bb55aa",
  "#b08a1e",
  "#3bb3cc",
  "#a0623f",
  "#858b96",
];
export const DASHES = [[], [6, 3], [2, 3], [9, 3, 2, 3]];
export const lineColour = (k: number): string => COLOURS[k % COLOURS.length]!;
export const lineDash = (k: number): number[] =>
  DASHES[Math.floor(k / COLOURS.length) % DASHES.length]!;
const TIME_STEPS = [
  0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600,
  1800, 3600,
];
const HEIGHT = 170;

const css = (name: string): string =>
  getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Values at the cursor of any chart, or the newest ones. */
export type AtCursor = (values: (number | null)[], t: number | null) => void;

export class ChartView {
  readonly plot: uPlot;
  private table: Table = [[]];
  private readonly stops: (() => void)[] = [];
  private asked = 0;

  constructor(
    private readonly series: Series[],
    place: HTMLElement,
    private readonly atCursor: AtCursor,
  ) {
    this.plot = new uPlot(this.options(place.clientWidth), this.table as uPlot.AlignedData, place);
    const resized = new ResizeObserver(() => {
      if (place.clientWidth > 60)
        this.plot.setSize({
          width: place.clientWidth,
          height: Math.max(HEIGHT, place.clientHeight),
        });
    });
    resized.observe(place);
    this.stops.push(
      () => resized.disconnect(),
      live.subscribe("samples", () => {
        if (page.view.mode === "live") this.ask();
      }),
      page.subscribe("view", () => this.ask()),
      page.subscribe("trigger", () => this.ask()),
    );
    this.ask();
  }

  destroy(): void {
    cancelAnimationFrame(this.asked);
    this.stops.forEach((stop) => stop());
    this.plot.destroy();
  }

  private ask(): void {
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      this.draw();
    });
  }

  private draw(): void {
    const [from, to] = page.range();
    this.table = alignSeries(this.series, page.rings(), from, to);
    this.plot.batch(() => {
      this.plot.setData(this.table as uPlot.AlignedData, false);
      this.plot.setScale("x", { min: from, max: to });
    });
    this.tellCursor();
  }

  private tellCursor(): void {
    const at = this.plot.cursor.idx;
    const isOver = at !== null && at !== undefined && (this.plot.cursor.left ?? -1) >= 0;
    const values = this.series.map((_, k) =>
      this.near(k + 1, isOver ? at : this.table[0].length - 1),
    );
    this.atCursor(values, isOver ? (this.table[0][at] ?? null) : null);
  }

  /** Returns the value of a series at a place, or of the nearest place before it that has one. */
  private near(column: number, at: number): number | null {
    const values = this.table[column];
    for (let k = at; values && k >= 0; k--) {
      const v = values[k];
      if (v !== undefined) return v;
    }
    return null;
  }

  private options(width: number): uPlot.Options {
    const times = (splits: number[], step: number) =>
      splits.map((t) => clock(t, step < 0.1 ? 3 : step < 1 ? 1 : 0));
    return {
      ...plotOptions(this.series.length, width, times),
      cursor: {
        sync: { key: "time", scales: ["x", null] },
        drag: { x: true, y: false, setScale: false },
        points: { size: 6 },
        dataIdx: (_, column, hovered) => this.hoverPlace(column, hovered),
      },
      hooks: {
        setCursor: [() => this.tellCursor()],
        setSelect: [(plot) => this.zoom(plot)],
        draw: [(plot) => this.drawTrigger(plot)],
      },
    };
  }

  private hoverPlace(column: number, hovered: number): number {
    const values = this.table[column];
    for (let k = hovered; values && k >= 0; k--) if (values[k] !== undefined) return k;
    return hovered;
  }

  private zoom(plot: uPlot): void {
    if (plot.select.width < 4) return;
    const from = plot.posToVal(plot.select.left, "x"),
      to = plot.posToVal(plot.select.left + plot.select.width, "x");
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    page.hold(from, to, "zoomed");
  }

  /** Draws where the trigger was, and its level where its variable is shown. */
  private drawTrigger(plot: uPlot): void {
    const trigger = page.trigger;
    if (!trigger) return;
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.strokeStyle = css("--warn");
    ctx.setLineDash([4, 4]);
    ctx.lineWidth = devicePixelRatio;
    ctx.beginPath();
    if (trigger.at !== null) {
      const x = plot.valToPos(trigger.at, "x", true);
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
    }
    const { variable, element, level } = trigger.settings;
    if (this.series.some((one) => one.variable === variable && one.element === element)) {
      const y = plot.valToPos(level, "y", true);
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
    }
    ctx.stroke();
    ctx.restore();
  }
}

/** Returns what all charts have in common: axes, lines and their colours. */
export function plotOptions(
  count: number,
  width: number,
  timeTexts: (splits: number[], step: number) => string[],
): uPlot.Options {
  const grid = { stroke: css("--grid"), width: 1 };
  const axis = {
    stroke: css("--dim"),
    grid,
    ticks: { show: false },
    font: `11px ${css("--font")}`,
  };
  return {
    width: Math.max(200, width),
    height: HEIGHT,
    legend: { show: false },
    padding: [8, 34, 0, 0],
    scales: { x: { time: false }, y: { range: (_, low, high) => spread(low, high) } },
    axes: [
      {
        ...axis,
        size: 24,
        space: 90,
        incrs: TIME_STEPS,
        values: (_, splits, __, ___, step) => timeTexts(splits, step),
      },
      {
        ...axis,
        size: 62,
        values: (_, splits) => splits.map((v) => String(Number(v.toPrecision(6)))),
      },
    ],
    series: [
      {},
      ...Array.from({ length: count }, (_, k) => ({
        stroke: lineColour(k),
        width: 1.6,
        dash: lineDash(k),
        points: { show: false },
      })),
    ],
  };
}

function spread(low: number | null, high: number | null): [number, number] {
  if (low === null || high === null || !Number.isFinite(low) || !Number.isFinite(high))
    return [0, 1];
  const room = (high - low) * 0.08 || Math.abs(high) * 0.1 || 1;
  return [low - room, high + room];
}
