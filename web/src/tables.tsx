// All tasks and all variables as tables: what the graph shows, for the keyboard and for many.
import { memo, useEffect, useMemo, useState } from "react";
import { want } from "./connection";
import { Outcome, TaskState, commandHelp, inOrder, useCommand } from "./controls";
import { field, number, short, unitText } from "./format";
import { Age } from "./graph_view";
import { live, useGraph, useLive, useTask, useValue } from "./live_state";
import { useUnheard } from "./node_cards";
import { page, usePage } from "./page_state";
import { parseSeries } from "./series";
import type { TaskStatus, Variable } from "./protocol";

/** Returns the signals that all of these tasks may be sent now. */
export function commonSignals(statuses: readonly (TaskStatus | undefined)[]): string[] {
  if (!statuses.length) return [];
  const [first, ...rest] = statuses;
  return inOrder(
    (first?.signals ?? []).filter((signal) => rest.every((one) => one?.signals.includes(signal))),
  );
}

export function TaskTable() {
  const graph = useGraph();
  usePage("selected");
  const [filter, setFilter] = useState("");
  const names = useMemo(() => (graph?.tasks ?? []).map((one) => one.name), [graph]);
  const shown = names.filter((one) => one.includes(filter.trim()));
  const chosen = new Set(page.selected);
  const toggle = (name: string) =>
    page.select(
      chosen.has(name) ? page.selected.filter((one) => one !== name) : [...page.selected, name],
    );
  return (
    <div className="panel">
      {names.length > 12 && (
        <input
          className="filter"
          type="search"
          placeholder="filter by name"
          aria-label="filter tasks by name"
          value={filter}
          onChange={(event) => setFilter(event.target.value)}
        />
      )}
      <ListSignals />
      <table className="list">
        <thead>
          <tr>
            {live.steers && (
              <th scope="col">
                <span className="away">selected</span>
              </th>
            )}
            <th scope="col">task</th>
            <th scope="col">state</th>
            <th scope="col" className="num">
              Hz
            </th>
            <th scope="col" className="num">
              CPU
            </th>
            <th scope="col" className="num">
              missed
            </th>
            <th scope="col" className="num">
              failed
            </th>
          </tr>
        </thead>
        <tbody>
          {shown.map((name) => (
            <TaskRow key={name} name={name} chosen={chosen.has(name)} toggle={() => toggle(name)} />
          ))}
        </tbody>
      </table>
      {!shown.length && <p className="dim">no tasks</p>}
    </div>
  );
}

function TaskRow({ name, chosen, toggle }: { name: string; chosen: boolean; toggle: () => void }) {
  const status = useTask(name);
  const fields = status?.fields ?? {};
  const count = (value: unknown) => (
    <td className={`num live${value ? " bad" : ""}`}>{field(value, "")}</td>
  );
  return (
    <tr className={(chosen ? "chosen" : "") + useUnheard(status?.rtpu ?? "")}>
      {live.steers && (
        <td>
          <input type="checkbox" checked={chosen} onChange={toggle} aria-label={`select ${name}`} />
        </td>
      )}
      <td>
        <button type="button" className="link" onClick={() => page.openTask(name)}>
          {name}
        </button>
      </td>
      <td>
        <TaskState task={name} />
      </td>
      <td className="num live">
        {typeof fields.mezF === "number" ? short(fields.mezF) : "–"}
        {typeof fields.refF === "number" && <span className="dim"> / {short(fields.refF)}</span>}
      </td>
      <td className="num live">{field(fields.avgU, "%")}</td>
      {count(fields.miss)}
      {count(fields.failed)}
    </tr>
  );
}

/** Signals for all selected tasks, sent as one list. */
function ListSignals() {
  useLive("status");
  usePage("selected");
  const running = useCommand();
  const [chosen, setChosen] = useState<string[]>([]);
  if (!live.steers) return null;
  const tasks = page.selected;
  const signals = commonSignals(tasks.map((one) => live.tasks.get(one)));
  return (
    <div className="list-signals" role="group" aria-label="signals for the selected tasks">
      {tasks.length < 1 ? (
        <p className="dim">
          Select tasks to send a signal to all of them, in the order in which you select them.
        </p>
      ) : (
        <>
          <p>
            <b>{tasks.length}</b> selected: {tasks.join(", ")}{" "}
            <button type="button" className="link" onClick={() => page.select([])}>
              none
            </button>
          </p>
          <p className="row">
            {signals.map((signal) => (
              <button
                key={signal}
                type="button"
                className={`signal signal-${signal}`}
                title={commandHelp(signal)}
                disabled={running.busy || live.link !== "live"}
                onClick={() => {
                  setChosen(tasks);
                  void running.run(signal, { task: tasks });
                }}
              >
                {signal}
              </button>
            ))}
            {!signals.length && <span className="dim">no signal is legal for all of them now</span>}
          </p>
        </>
      )}
      <Outcome of={running} done={`done for ${chosen.join(", ")}`} />
    </div>
  );
}

const MOST_ROWS = 150;

export function VariableTable() {
  const graph = useGraph();
  const [filter, setFilter] = useState("");
  const words = filter.toLowerCase().trim();
  const found = useMemo(
    () =>
      (graph?.variables ?? []).filter(
        (one) =>
          !words ||
          `${one.name} ${one.desc} ${one.unit} ${one.writers.join(" ")}`
            .toLowerCase()
            .includes(words),
      ),
    [graph, words],
  );
  const shown = found.slice(0, MOST_ROWS);
  const key = shown.map((one) => one.name).join("\n");
  useEffect(() => {
    want("list", key ? key.split("\n") : []);
    return () => want("list", []);
  }, [key]);
  return (
    <div className="panel">
      <input
        className="filter"
        type="search"
        placeholder="filter by name, text, unit or writer"
        aria-label="filter variables"
        value={filter}
        onChange={(event) => setFilter(event.target.value)}
      />
      <table className="list">
        <thead>
          <tr>
            <th scope="col">variable</th>
            <th scope="col">value</th>
            <th scope="col">age</th>
            <th scope="col">
              <span className="away">plot</span>
            </th>
          </tr>
        </thead>
        <tbody>
          {shown.map((one) => (
            <VariableRow key={one.name} about={one} />
          ))}
        </tbody>
      </table>
      {found.length > MOST_ROWS && (
        <p className="dim">{found.length - MOST_ROWS} more: filter them</p>
      )}
    </div>
  );
}

const VariableRow = memo(function VariableRow({ about }: { about: Variable }) {
  const value = useValue(about.name);
  const unit = unitText(about.unit);
  return (
    <tr
      title={about.desc}
      onMouseEnter={() => page.hover(about.name)}
      onMouseLeave={() => page.hover("")}
    >
      <td>
        <button
          type="button"
          className="link"
          onClick={() => page.pin(about.name)}
          title="show all elements"
        >
          {about.name}
        </button>
        {about.constant && <span className="dim"> const</span>}
        {unit && <span className="unit">{unit}</span>}
      </td>
      <td className="values live">
        {value
          ? value.v.slice(0, 3).map(number).join("  ") + (value.v.length > 3 ? "  …" : "")
          : "–"}
      </td>
      <td>
        <Age name={about.name} />
      </td>
      <td>
        <button
          type="button"
          aria-label={`plot ${about.name}`}
          onClick={() => page.addSeries(parseSeries(about.name, live.variables))}
        >
          plot
        </button>
      </td>
    </tr>
  );
});
