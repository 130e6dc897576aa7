// Charts with one time axis: series, zoom, pause, trigger, and files of what is shown.
import { useEffect, useRef, useState } from "react";
import { ChartView, lineColour, lineDash } from "./chart";
import { clock, number, unitText } from "./format";
import { live, useLive } from "./live_state";
import { page, usePage, type Chart } from "./page_state";
import { alignSeries, parseSeries, seriesName, toCsv, type Series } from "./series";

const WIDTHS = [2, 5, 10, 30, 60];
const views = new Map<number, ChartView>();

export function PlotsPanel() {
  usePage("charts");
  useLive("hello");
  const charts = page.charts;
  return (
    <section className={`plots${page.plotsOpen ? "" : " closed"}`} aria-label="plots">
      <header className="row wrap">
        <button
          type="button"
          className="fold"
          aria-expanded={page.plotsOpen}
          onClick={() => page.togglePlots()}
        >
          {page.plotsOpen ? "▾" : "▸"} Plots
        </button>
        {page.plotsOpen && (
          <>
            <AddSeries label="new chart" />
            <ViewTools />
            <TriggerTools />
            <Files charts={charts} />
          </>
        )}
      </header>
      {page.plotsOpen && (
        <div className="charts">
          {charts.map((one) => (
            <ChartCard key={one.id} chart={one} />
          ))}
          {!charts.length && (
            <p className="dim">
              No chart yet: name a variable above, such as {example()}, or press “plot” beside a
              variable.
            </p>
          )}
        </div>
      )}
    </section>
  );
}

function example(): string {
  const found = live.graph?.variables.find((one) => !one.constant && one.writers.length);
  return found
    ? found.n > 1
      ? `${found.name} or ${found.name}[0]`
      : found.name
    : "Q_MEZ or Q_MEZ[0]";
}

function AddSeries({ label, chart }: { label: string; chart?: number }) {
  const [text, setText] = useState("");
  const [refused, setRefused] = useState("");
  const add = () => {
    try {
      page.addSeries(parseSeries(text, live.variables), chart);
      setText("");
      setRefused("");
    } catch (error) {
      setRefused(error instanceof Error ? error.message : String(error));
    }
  };
  return (
    <form
      className="add"
      onSubmit={(event) => {
        event.preventDefault();
        add();
      }}
    >
      <input
        list="plot-variables"
        value={text}
        size={14}
        spellCheck={false}
        autoComplete="off"
        aria-label={`variable for ${label}`}
        placeholder={chart ? "add variable" : "variable to plot"}
        onChange={(event) => {
          setText(event.target.value);
          setRefused("");
        }}
      />
      <button type="submit">{chart ? "add" : "new chart"}</button>
      {refused && (
        <span className="refused" role="alert">
          {refused}
        </span>
      )}
    </form>
  );
}

function ViewTools() {
  usePage("view");
  const view = page.view;
  return (
    <span className="row tools" role="group" aria-label="time axis">
      <label>
        last{" "}
        <select
          value={page.width}
          aria-label="seconds shown"
          onChange={(event) => page.setWidth(Number(event.target.value))}
        >
          {WIDTHS.map((one) => (
            <option key={one} value={one}>
              {one} s
            </option>
          ))}
        </select>
      </label>
      {view.mode === "live" ? (
        <button type="button" onClick={() => page.pause()}>
          pause
        </button>
      ) : (
        <button type="button" className="primary" onClick={() => page.resume()}>
          {page.trigger ? "wait again" : "live"}
        </button>
      )}
      {view.mode === "held" && (
        <>
          <button type="button" aria-label="earlier" onClick={() => move(-0.5, 1)}>
            ←
          </button>
          <button type="button" aria-label="later" onClick={() => move(0.5, 1)}>
            →
          </button>
          <button type="button" aria-label="zoom in" onClick={() => move(0, 0.5)}>
            +
          </button>
          <button type="button" aria-label="zoom out" onClick={() => move(0, 2)}>
            −
          </button>
          <span className="badge">{view.why}</span>
        </>
      )}
    </span>
  );
}

function move(by: number, scale: number): void {
  const [from, to] = page.range(),
    width = to - from,
    middle = (from + to) / 2 + by * width;
  page.hold(middle - (width * scale) / 2, middle + (width * scale) / 2, "zoomed");
}

function TriggerTools() {
  usePage("trigger");
  usePage("view");
  const trigger = page.trigger;
  const [settings, set] = useState({
    variable: "",
    level: "0",
    edge: "rising" as "rising" | "falling",
    hold: "0",
    once: true,
  });
  const [refused, setRefused] = useState("");
  const place = useRef<HTMLDetailsElement>(null);
  const arm = () => {
    try {
      const [one] = parseSeries(settings.variable, live.variables);
      const level = Number(settings.level),
        hold = Number(settings.hold);
      if (!settings.level.trim() || !Number.isFinite(level))
        throw new Error(`the level is not a number: ${settings.level}`);
      if (!Number.isFinite(hold) || hold < 0)
        throw new Error(`the hold is not a number of seconds: ${settings.hold}`);
      setRefused("");
      page.arm({ ...one!, level, hold, edge: settings.edge, once: settings.once });
      if (place.current) place.current.open = false;
    } catch (error) {
      setRefused(error instanceof Error ? error.message : String(error));
    }
  };
  const told = !trigger
    ? ""
    : page.view.mode === "held" && page.view.why === "triggered"
      ? `triggered at ${clock(trigger.at ?? 0)}`
      : trigger.at === null
        ? "waits"
        : "triggered";
  return (
    <details className="trigger" ref={place}>
      <summary>
        trigger
        {trigger && (
          <span className="badge" role="status">
            {told}
          </span>
        )}
      </summary>
      <form
        className="popup"
        onSubmit={(event) => {
          event.preventDefault();
          arm();
        }}
      >
        <label className="field">
          <span>
            variable<small>and element: Q_MEZ[2]; it need not be plotted</small>
          </span>
          <input
            list="plot-variables"
            value={settings.variable}
            spellCheck={false}
            onChange={(event) => set({ ...settings, variable: event.target.value })}
          />
        </label>
        <label className="field">
          <span>level</span>
          <input
            inputMode="decimal"
            value={settings.level}
            onChange={(event) => set({ ...settings, level: event.target.value })}
          />
        </label>
        <label className="field">
          <span>edge</span>
          <select
            value={settings.edge}
            onChange={(event) =>
              set({ ...settings, edge: event.target.value as "rising" | "falling" })
            }
          >
            <option>rising</option>
            <option>falling</option>
          </select>
        </label>
        <label className="field">
          <span>
            hold<small>seconds without another trigger</small>
          </span>
          <input
            inputMode="decimal"
            value={settings.hold}
            onChange={(event) => set({ ...settings, hold: event.target.value })}
          />
        </label>
        <label className="check">
          <input
            type="checkbox"
            checked={settings.once}
            onChange={(event) => set({ ...settings, once: event.target.checked })}
          />{" "}
          stay at the first
        </label>
        <p className="row">
          <button type="submit" className="primary">
            {trigger ? "arm again" : "arm"}
          </button>
          {trigger && (
            <button type="button" onClick={() => page.disarm()}>
              off
            </button>
          )}
        </p>
        {refused && (
          <p className="refused" role="alert">
            {refused}
          </p>
        )}
      </form>
    </details>
  );
}

function ChartCard({ chart }: { chart: Chart }) {
  const place = useRef<HTMLDivElement>(null);
  const cells = useRef<(HTMLElement | null)[]>([]);
  const time = useRef<HTMLElement>(null);
  const theme = useTheme();
  useEffect(() => {
    if (!place.current) return undefined;
    const made = new ChartView(chart.series, place.current, (values, t) => {
      values.forEach((value, k) => {
        const cell = cells.current[k];
        if (cell) cell.textContent = number(value);
      });
      if (time.current) time.current.textContent = t === null ? "" : clock(t);
    });
    views.set(chart.id, made);
    return () => {
      views.delete(chart.id);
      made.destroy();
    };
  }, [chart.id, chart.series, theme]);
  return (
    <article
      className="chart"
      aria-label={`chart of ${chart.series.map((one) => nameOf(one)).join(", ")}`}
    >
      <header className="row wrap">
        {chart.series.map((one, k) => (
          <span className="series" key={nameOf(one)}>
            <svg viewBox="0 0 22 8" aria-hidden="true">
              <path d="M0 4H22" stroke={lineColour(k)} strokeDasharray={lineDash(k).join(" ")} />
            </svg>
            {nameOf(one)}{" "}
            <b
              ref={(cell) => {
                cells.current[k] = cell;
              }}
              className="live"
            />{" "}
            {unitText(live.variables.get(one.variable)?.unit ?? "")}
            <button
              type="button"
              className="close"
              aria-label={`remove ${nameOf(one)}`}
              onClick={() => page.removeSeries(chart.id, one)}
            >
              ×
            </button>
          </span>
        ))}
        <i ref={time} className="cursor-time" />
        <AddSeries label="this chart" chart={chart.id} />
        <button
          type="button"
          className="close"
          aria-label="remove this chart"
          title="remove this chart"
          onClick={() => page.removeChart(chart.id)}
        >
          ×
        </button>
      </header>
      <div className="live" ref={place} />
    </article>
  );
}

const nameOf = (one: Series): string => seriesName(one, live.variables.get(one.variable));

/** Grows when the colours of the page change between dark and light. */
function useTheme(): number {
  const [count, setCount] = useState(0);
  useEffect(() => {
    const query = matchMedia("(prefers-color-scheme: dark)");
    const changed = () => setCount((before) => before + 1);
    query.addEventListener("change", changed);
    return () => query.removeEventListener("change", changed);
  }, []);
  return count;
}

function Files({ charts }: { charts: Chart[] }) {
  const all = charts.flatMap((one) => one.series);
  const once = [...new Map(all.map((one) => [nameOf(one), one])).values()];
  const csv = () => {
    const [from, to] = page.range();
    download(
      "csv",
      new Blob([toCsv(once, alignSeries(once, page.rings(), from, to), live.variables, from, to)], {
        type: "text/csv",
      }),
    );
  };
  return (
    <span className="row tools">
      <button
        type="button"
        disabled={!once.length}
        onClick={csv}
        title="save what is shown as a table"
      >
        CSV
      </button>
      <button
        type="button"
        disabled={!once.length}
        onClick={() => savePicture(charts)}
        title="save the charts as a picture"
      >
        PNG
      </button>
    </span>
  );
}

function download(ending: string, blob: Blob): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = `${live.hello?.name ?? "pbonet"}-${clock(page.range()[1], 0).replaceAll(":", "")}.${ending}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Draws the charts below each other, each with its names, and saves them. */
function savePicture(charts: Chart[]): void {
  const parts = charts.flatMap((one) => {
    const view = views.get(one.id);
    return view ? [{ series: one.series, from: view.plot.ctx.canvas }] : [];
  });
  const scale = devicePixelRatio,
    head = 24 * scale;
  const canvas = document.createElement("canvas");
  canvas.width = Math.max(...parts.map((one) => one.from.width));
  canvas.height = parts.reduce((sum, one) => sum + one.from.height + head, 0);
  const ctx = canvas.getContext("2d")!;
  const style = getComputedStyle(document.body);
  ctx.fillStyle = style.backgroundColor;
  ctx.fillRect(0, 0, canvas.width, canvas.height);
  ctx.font = `${12 * scale}px ${style.fontFamily}`;
  let y = 0;
  for (const { series, from } of parts) {
    let x = 12 * scale;
    series.forEach((one, k) => {
      const unit = unitText(live.variables.get(one.variable)?.unit ?? ""),
        text = `${nameOf(one)}${unit && ` (${unit})`}`;
      ctx.fillStyle = lineColour(k);
      ctx.fillText(text, x, y + 16 * scale);
      x += ctx.measureText(text).width + 18 * scale;
    });
    ctx.drawImage(from, 0, y + head);
    y += from.height + head;
  }
  canvas.toBlob((blob) => {
    if (blob) download("png", blob);
  });
}
