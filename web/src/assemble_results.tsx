// What comes of the job that is edited: a simulated run with plots, and saved files that can be
// applied.
import { useEffect, useRef, useState } from "react";
import uPlot from "uplot";
import { Planned } from "./change_panel";
import { lineColour, plotOptions } from "./chart";
import { edit } from "./connection";
import { number, unitText } from "./format";
import { useLive } from "./live_state";
import type { FileChange, SimulatedRun } from "./protocol";
import { Refusal } from "./assemble_fields";
import { assemble, useAssemble, useEditor } from "./assemble_state";
import { diffLines, fileName } from "./assemble_words";

const MOST_LINES = 6;

export function SimulatePanel() {
  const state = useEditor();
  useAssemble("run");
  const [seconds, setSeconds] = useState("2");
  const [names, setNames] = useState<string[] | null>(null);
  const [text, setText] = useState("");
  const [isRunning, setRunning] = useState(false);
  if (!state) return null;
  const variables = state.graph.variables.filter((one) => !one.constant);
  const wanted =
    names ??
    variables
      .filter((one) => one.writers.length)
      .slice(0, 2)
      .map((one) => one.name);
  const add = () => {
    const found = variables.find((one) => one.name === text.trim());
    if (found) {
      setNames([...new Set([...wanted, found.name])]);
      setText("");
    }
  };
  const run = async () => {
    setRunning(true);
    const answer = await assemble.ask(
      "simulate",
      { seconds: Number(seconds), variables: wanted },
      "simulate",
    );
    assemble.run = answer.ok ? (answer.data?.run as SimulatedRun) : null;
    assemble.runOf = state;
    assemble.tell("run");
    setRunning(false);
  };
  return (
    <div className="panel">
      <form
        className="simulate"
        aria-label="simulate"
        onSubmit={(event) => {
          event.preventDefault();
          void run();
        }}
      >
        <p className="row">
          <label className="field inline">
            <span>seconds</span>
            <input
              inputMode="decimal"
              size={5}
              value={seconds}
              onChange={(event) => setSeconds(event.target.value)}
            />
          </label>
          <button type="submit" className="primary" disabled={isRunning}>
            {isRunning ? "it runs…" : "simulate"}
          </button>
          {isRunning && (
            <button type="button" onClick={() => void edit("cancel")}>
              cancel
            </button>
          )}
        </p>
        <p className="row wrap chips">
          {wanted.map((one) => (
            <span key={one} className="chip">
              {one}
              <button
                type="button"
                className="close"
                aria-label={`do not plot ${one}`}
                onClick={() => setNames(wanted.filter((each) => each !== one))}
              >
                ×
              </button>
            </span>
          ))}
          <input
            list="simulated-variables"
            value={text}
            size={9}
            placeholder="plot also"
            aria-label="variable to plot"
            spellCheck={false}
            autoComplete="off"
            onChange={(event) => setText(event.target.value)}
            onKeyDown={(event) => {
              if (event.key === "Enter") {
                event.preventDefault();
                add();
              }
            }}
          />
          <button type="button" onClick={add}>
            add
          </button>
          <datalist id="simulated-variables">
            {variables.map((one) => (
              <option key={one.name} value={one.name}>
                {one.desc}
              </option>
            ))}
          </datalist>
        </p>
        <p className="dim">
          In virtual time, by another process; nothing moves, and no file is written.
        </p>
      </form>
      <Refusal at="simulate" />
      {assemble.run && <RunResult run={assemble.run} />}
    </div>
  );
}

function RunResult({ run }: { run: SimulatedRun }) {
  const shown = Object.entries(run.series);
  return (
    <section aria-label="simulated run">
      <p>
        {run.ok && !run.problems.length ? (
          <span className="flag legal">✓ it ran</span>
        ) : (
          <span className="flag illegal">✕ {run.ok ? "it ran, with problems" : "it failed"}</span>
        )}
        {assemble.runOf !== assemble.state && (
          <span className="dim"> before the last change of the job</span>
        )}
      </p>
      {run.problems.map((text) => (
        <pre key={text} className="problem">
          {text}
        </pre>
      ))}
      {shown.map(([name, series]) => (
        <RunChart key={name} name={name} series={series} />
      ))}
      {run.tasks.length > 0 && (
        <table className="list">
          <thead>
            <tr>
              <th scope="col">task</th>
              <th scope="col">state</th>
              <th scope="col" className="num">
                cycles
              </th>
              <th scope="col" className="num">
                missed
              </th>
            </tr>
          </thead>
          <tbody>
            {run.tasks.map((one) => (
              <tr key={String(one.task)}>
                <td>{String(one.task)}</td>
                <td>{String(one.state ?? "")}</td>
                <td className="num">{String(one.cycles ?? "")}</td>
                <td className={`num${one.missed ? " bad" : ""}`}>{String(one.missed ?? "")}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
      {run.output && (
        <details>
          <summary>what it printed</summary>
          <pre className="output">{run.output}</pre>
        </details>
      )}
    </section>
  );
}

/** One variable of a run, its elements as lines; the values at the cursor stand above. */
function RunChart({
  name,
  series,
}: {
  name: string;
  series: { t: number[]; v: (number | null)[][] };
}) {
  const place = useRef<HTMLDivElement>(null);
  const [at, setAt] = useState<number | null>(null);
  const unit = unitText(String(assemble.state?.table[name]?.units ?? ""));
  const count = Math.min(series.v[0]?.length ?? 0, MOST_LINES);
  useEffect(() => {
    const box = place.current;
    if (!box) return undefined;
    const begin = series.t[0] ?? 0;
    const lines = Array.from({ length: count }, (_, k) => series.v.map((row) => row[k] ?? null));
    const seconds = (splits: number[]) => splits.map((one) => `${Number(one.toPrecision(6))} s`);
    const plot = new uPlot(
      {
        ...plotOptions(count, box.clientWidth, seconds),
        cursor: { sync: { key: "run", scales: ["x", null] }, drag: { x: true, y: false } },
        hooks: { setCursor: [(one) => setAt(one.cursor.idx ?? null)] },
      },
      [series.t.map((one) => one - begin), ...lines],
      box,
    );
    const resized = new ResizeObserver(() =>
      plot.setSize({ width: Math.max(200, box.clientWidth), height: 170 }),
    );
    resized.observe(box);
    return () => {
      resized.disconnect();
      plot.destroy();
    };
  }, [series, count]);
  const row = series.v[at ?? series.v.length - 1];
  return (
    <figure className="run-chart" aria-label={`${name} over time`}>
      <figcaption className="row wrap">
        <b>{name}</b>
        {unit && <span className="unit">{unit}</span>}
        {Array.from({ length: count }, (_, k) => (
          <span key={k} className="series">
            <svg viewBox="0 0 22 8" aria-hidden="true">
              <path d="M0 4H22" stroke={lineColour(k)} />
            </svg>
            {count > 1 ? k : ""}
            <b>{number(row?.[k])}</b>
          </span>
        ))}
        {(series.v[0]?.length ?? 0) > count && (
          <span className="dim">
            the first {count} of {series.v[0]!.length}
          </span>
        )}
      </figcaption>
      <div ref={place} />
    </figure>
  );
}

export function SavePanel() {
  const state = useEditor();
  useLive("link");
  const [changes, setChanges] = useState<FileChange[] | null>(null);
  const [written, setWritten] = useState<string[] | null>(null);
  useEffect(() => {
    let isOld = false;
    void assemble.ask("changes", {}, "save").then((answer) => {
      if (!isOld && answer.ok) setChanges(answer.data?.changes as FileChange[]);
    });
    return () => {
      isOld = true;
    };
  }, [state]);
  if (!state) return null;
  const save = async () => {
    const answer = await assemble.ask("save", {}, "save");
    if (answer.ok) setWritten(answer.data?.written as string[]);
  };
  const discard = () => {
    if (window.confirm(`Open ${assemble.job} as its files are, without these changes?`))
      void assemble.open(assemble.job);
  };
  return (
    <div className="panel">
      <section aria-label="changes">
        <h3>What saving writes</h3>
        {!changes && <p className="dim">comparing…</p>}
        {changes?.length === 0 && (
          <p className="dim">Nothing: the files are as this page shows them.</p>
        )}
        {changes?.map((one) => (
          <Change key={one.file} of={one} />
        ))}
        {!state.legal && changes && changes.length > 0 && (
          <p className="warning-line">This job has faults. It can be saved, but not started.</p>
        )}
        <p className="row">
          <button
            type="button"
            className="primary"
            disabled={!changes?.length}
            onClick={() => void save()}
          >
            save{" "}
            {changes?.length ? (changes.length === 1 ? "one file" : `${changes.length} files`) : ""}
          </button>
          {Boolean(changes?.length) && (
            <button type="button" onClick={discard}>
              discard all changes…
            </button>
          )}
        </p>
        <Refusal at="save" />
        {written && written.length > 0 && !changes?.length && (
          <p className="outcome done" role="status">
            written: {written.map(fileName).join(", ")}
          </p>
        )}
      </section>
      <section className="apply" aria-label="apply to the running system">
        <h3>Apply to the running system</h3>
        {assemble.isChanged ? (
          <p className="dim">Save first: the system runs what the files say.</p>
        ) : !state.legal ? (
          <p className="warning-line">This job has faults, and cannot be started.</p>
        ) : (
          <Planned command="switch" args={{ job: assemble.job }} ready>
            {null}
          </Planned>
        )}
      </section>
    </div>
  );
}

function Change({ of }: { of: FileChange }) {
  return (
    <details className="file-change" open>
      <summary>
        <b>{fileName(of.file)}</b>{" "}
        <span className={`badge${of.kind === "removed" ? " bad" : ""}`}>{of.kind}</span>
      </summary>
      {of.notes.map((text) => (
        <p key={text} className="warning-line">
          ⚠ {text}
        </p>
      ))}
      <pre className="diff">
        {diffLines(of.diff).map((one, k) => (
          <span key={k} className={one.kind}>
            {one.text}
            {"\n"}
          </span>
        ))}
      </pre>
    </details>
  );
}
