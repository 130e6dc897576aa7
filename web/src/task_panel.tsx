// Everything about one task: signals, frequency, parameters, profile, and its status fields.
import { useCallback, useEffect, useState } from "react";
import { readingCommand } from "./connection";
import {
  Outcome,
  SignalButtons,
  TaskState,
  Why,
  argHelp,
  commandHelp,
  useCommand,
  type Running,
} from "./controls";
import { field, seconds, short, unitText } from "./format";
import { live, useGraph, useLive, useTask } from "./live_state";
import { missingNote, notesOf } from "./node_cards";
import { page, usePage } from "./page_state";
import type { ParamInfo, ParamValue, TaskInfo, TaskProfile } from "./protocol";

export function TaskPanel() {
  const graph = useGraph();
  usePage("task");
  const names = graph?.tasks.map((one) => one.name) ?? [];
  const task = graph?.tasks.find((one) => one.name === page.task) ?? graph?.tasks[0];
  if (!task) return <p className="panel dim">no task exists</p>;
  return (
    <div className="panel">
      <label className="field inline">
        <span>task</span>
        <select value={task.name} onChange={(event) => page.openTask(event.target.value)}>
          {names.map((one) => (
            <option key={one}>{one}</option>
          ))}
        </select>
      </label>
      <About key={`about ${task.name}`} task={task} />
      <Parameters key={`parameters ${task.name}`} task={task} />
      <Profile key={`profile ${task.name}`} task={task.name} />
      <StatusFields task={task.name} />
    </div>
  );
}

function About({ task }: { task: TaskInfo }) {
  const status = useTask(task.name);
  const missing = missingNote(task.name);
  const notes: [string, string][] = status
    ? notesOf(status)
    : missing
      ? [["missing", missing]]
      : [];
  return (
    <section>
      <p className="big live">
        <TaskState task={task.name} /> <span className="dim">on {task.rtpu}</span>
      </p>
      <p>{task.desc}</p>
      <p className="dim">
        {[
          `module ${task.module}`,
          task.class,
          task.parts.length && `of ${task.parts.join(" + ")}`,
          task.type,
          task.crit && `criticality ${task.crit}`,
          task.fallback_of && `fallback of ${task.fallback_of}`,
          task.devices.length && `devices ${task.devices.join(", ")}`,
        ]
          .filter(Boolean)
          .join(" · ")}
      </p>
      {notes.map(([kind, text]) => (
        <p key={kind} className={`note note-${kind}`}>
          <b>{kind}</b> {text}
        </p>
      ))}
      <Why what={[task.name]} />
      <SignalButtons task={task.name} />
      {live.steers && task.freq > 0 && <Frequency task={task.name} />}
    </section>
  );
}

function Frequency({ task }: { task: string }) {
  const now = useTask(task)?.fields.refF;
  const running = useCommand();
  const [text, setText] = useState("");
  const send = () => {
    if (text.trim())
      void running.run("freq", { task, hz: text.trim() }).then((answer) => {
        if (answer.ok) setText("");
      });
  };
  return (
    <form
      className="row"
      onSubmit={(event) => {
        event.preventDefault();
        send();
      }}
    >
      <label className="field inline" title={commandHelp("freq")}>
        <span>frequency</span>
        <input
          inputMode="decimal"
          size={8}
          value={text}
          placeholder={typeof now === "number" ? short(now) : ""}
          onChange={(event) => setText(event.target.value)}
        />
        <span className="unit">Hz</span>
      </label>
      <button type="submit" disabled={running.busy || !text.trim()}>
        set
      </button>
      <Outcome of={running} />
    </form>
  );
}

type Words = string[];
const asWords = (value: unknown): Words =>
  Array.isArray(value)
    ? value.flat(9).map(String)
    : value === null || value === undefined
      ? []
      : [String(value)];

function Parameters({ task }: { task: TaskInfo }) {
  const [params, setParams] = useState<ParamValue[] | null>(null);
  const [refused, setRefused] = useState("");
  const read = useCallback(async () => {
    const answer = await readingCommand("get", { task: task.name });
    const found = answer.data?.params;
    if (answer.ok && Array.isArray(found)) {
      setParams(found as ParamValue[]);
      setRefused("");
    } else setRefused(answer.text);
  }, [task.name]);
  useLive("link");
  const isLive = live.link === "live";
  const exists = useTask(task.name) !== undefined;
  useEffect(() => {
    if (isLive && exists && !live.log) void read();
  }, [read, isLive, exists]);
  useSetElsewhere(task.name, read);
  const known: ParamValue[] =
    params ??
    task.params.map((one) => ({
      name: one.name,
      value: one.value,
      type: one.type,
      unit: one.unit,
      doc: one.desc,
      bounds: one.bounds,
    }));
  return (
    <section>
      <h3>
        Parameters{" "}
        {!live.log && exists && (
          <button type="button" className="link" onClick={() => void read()}>
            read again
          </button>
        )}
      </h3>
      {refused && (
        <div className="outcome refusal" role="alert">
          <pre>{refused}</pre>
        </div>
      )}
      {!known.length && <p className="dim">it has none</p>}
      {known.map((one) => (
        <Parameter
          key={one.name}
          task={task.name}
          about={one}
          exists={exists}
          info={task.params.find((each) => each.name === one.name)}
          took={(news) =>
            setParams(
              (before) =>
                before?.map((each) => news.find((n) => n.name === each.name) ?? each) ?? news,
            )
          }
        />
      ))}
    </section>
  );
}

/** Calls `read` when an event says that a parameter of the task was set, by whomever. */
function useSetElsewhere(task: string, read: () => Promise<void>): void {
  const [seen, setSeen] = useState(() => live.events.at(-1)?.n ?? -1);
  useLive("events");
  const newest = live.events.findLast((one) => one.code === "SET" && one.task === task)?.n ?? -1;
  useEffect(() => {
    if (newest > seen) {
      setSeen(newest);
      void read();
    }
  }, [newest, seen, read]);
}

function Parameter({
  task,
  about,
  info,
  exists,
  took,
}: {
  task: string;
  exists: boolean;
  about: ParamValue;
  info: ParamInfo | undefined;
  took: (news: ParamValue[]) => void;
}) {
  const known = asWords(about.value);
  const [edited, setEdited] = useState<Words | null>(null);
  const running = useCommand();
  const words = edited ?? known;
  const changed = edited !== null && edited.join(" ") !== known.join(" ");
  const put = (k: number, text: string) => setEdited(words.map((one, n) => (n === k ? text : one)));
  const send = async (value: Words) => {
    const answer = await running.run("set", { task, param: about.name, value });
    if (!answer.ok) return;
    setEdited(null);
    if (Array.isArray(answer.data?.params)) took(answer.data.params as ParamValue[]);
  };
  const unit = unitText(about.unit);
  const low = info?.low ?? null,
    high = info?.high ?? null;
  const choices = choicesOf(about.type || info?.type || "", info?.type ?? "");
  const whole = about.type === "int";
  const slides =
    live.steers &&
    low !== null &&
    high !== null &&
    words.length <= 6 &&
    words.every((one) => Number.isFinite(Number(one)));
  const many = words.length > 1;
  return (
    <form
      className="parameter"
      onSubmit={(event) => {
        event.preventDefault();
        if (changed) void send(words);
      }}
    >
      <div className="head">
        <b>{about.name}</b>
        {unit && <span className="unit">{unit}</span>}
        <span className="dim">{about.bounds || boundsText(low, high)}</span>
      </div>
      <p className="doc">{about.doc}</p>
      {live.steers && exists ? (
        <div className="row wrap">
          {words.map((word, k) => (
            <span className="element" key={k}>
              {choices.length ? (
                <select
                  value={
                    word.toLowerCase() === "true"
                      ? "yes"
                      : word.toLowerCase() === "false"
                        ? "no"
                        : word
                  }
                  aria-label={about.name}
                  onChange={(event) => put(k, event.target.value)}
                >
                  {choices.map((one) => (
                    <option key={one}>{one}</option>
                  ))}
                </select>
              ) : (
                <input
                  size={Math.max(6, word.length)}
                  value={word}
                  spellCheck={false}
                  aria-label={`${about.name}${many ? ` element ${k}` : ""}${unit && ` in ${unit}`}`}
                  onChange={(event) => put(k, event.target.value)}
                />
              )}
              {slides && (
                <input
                  type="range"
                  min={low}
                  max={high}
                  step={whole ? 1 : "any"}
                  value={Number(word)}
                  aria-label={`${about.name}${many ? ` element ${k}` : ""}, slider`}
                  onChange={(event) =>
                    put(k, String(Number(Number(event.target.value).toPrecision(4))))
                  }
                  onPointerUp={() => {
                    if (changed) void send(words);
                  }}
                  onKeyUp={() => {
                    if (changed) void send(words);
                  }}
                />
              )}
            </span>
          ))}
          <button type="submit" disabled={!changed || running.busy || live.link !== "live"}>
            set
          </button>
          {changed && (
            <button
              type="button"
              className="link"
              onClick={() => {
                setEdited(null);
                running.clear();
              }}
            >
              undo
            </button>
          )}
        </div>
      ) : (
        <p className="values">{known.join("  ") || "–"}</p>
      )}
      <Outcome of={running} />
    </form>
  );
}

/** Returns the words between which to choose, if the parameter takes no others. */
export function choicesOf(type: string, described: string): string[] {
  if (type === "bool") return ["yes", "no"];
  const found = /^one of (.+)$/.exec(described);
  return found ? found[1]!.split(", ") : [];
}

const boundsText = (low: number | null, high: number | null): string =>
  [low !== null && `≥ ${short(low)}`, high !== null && `≤ ${short(high)}`]
    .filter(Boolean)
    .join(" and ");

const BINS = 32;

/** Returns how many of the cycles took how long, from the shares that needed at most a time. */
export function histogramOf(
  psi: readonly [number, number][],
  bins = BINS,
): { width: number; shares: number[] } {
  const longest = psi.at(-1)?.[0] ?? 0;
  const shares = new Array<number>(bins).fill(0);
  let before = 0;
  for (const [time, share] of psi) {
    const bin = Math.min(bins - 1, Math.floor((time / longest) * bins));
    shares[bin]! += share - before;
    before = share;
  }
  return { width: longest / bins, shares };
}

function Profile({ task }: { task: string }) {
  const running: Running = useCommand();
  const found = (running.answer?.data?.tasks as TaskProfile[] | undefined)?.find(
    (one) => one.task === task,
  );
  if (live.log) return null;
  return (
    <section>
      <h3 title={commandHelp("profile")}>
        Profile{" "}
        <button
          type="button"
          className="link"
          disabled={running.busy}
          onClick={() => void running.run("profile", { task: [task] })}
        >
          {found ? "measure again" : "show"}
        </button>
      </h3>
      {found ? (
        <ProfileOf found={found} />
      ) : (
        <p className="dim">{argHelp("profile", "task") && commandHelp("profile")}</p>
      )}
      {running.answer && !running.answer.ok && <Outcome of={running} />}
    </section>
  );
}

function ProfileOf({ found }: { found: TaskProfile }) {
  if (!found.psi.length) return <p className="dim">it has run no second cycle yet</p>;
  const { width, shares } = histogramOf(found.psi);
  const top = Math.max(...shares),
    whole = width * BINS;
  const marks = (["p50", "p99"] as const).filter((name) => found.quantiles[name]);
  return (
    <figure className="histogram">
      <svg
        viewBox="0 0 320 110"
        role="img"
        aria-label={`CPU time of ${found.counted} cycles, ${seconds(found.least)} to ${seconds(found.most)}`}
      >
        {shares.map((share, k) => (
          <rect
            key={k}
            x={k * 10 + 0.5}
            width="9"
            y={100 - (share / top) * 92}
            height={(share / top) * 92}
          >
            <title>{`${seconds(k * width)} to ${seconds((k + 1) * width)}: ${(share * 100).toFixed(1)} %`}</title>
          </rect>
        ))}
        {marks.map((name) => {
          const x = Math.min(318, (found.quantiles[name]! / whole) * 320);
          return (
            <g key={name}>
              <path d={`M${x} 0V100`} />
              <text x={x > 280 ? x - 26 : x + 3} y={name === "p50" ? 9 : 21}>
                {name}
              </text>
            </g>
          );
        })}
        <path className="axis" d="M0 100H320" />
        <text x="0" y="110">
          0
        </text>
        <text x="320" y="110" textAnchor="end">
          {seconds(whole)}
        </text>
      </svg>
      <figcaption>
        CPU time of {found.counted} cycles: least {seconds(found.least)},{" "}
        {Object.entries(found.quantiles)
          .map(([name, value]) => `${name} ${seconds(value)}`)
          .join(", ")}
        , most {seconds(found.most)}
        {found.declared.maxc ? `, declared MAXC ${seconds(found.declared.maxc)}` : ""}. Delay of the
        start:{" "}
        {Object.entries(found.delays)
          .map(([name, value]) => `${name} ${seconds(value)}`)
          .join(", ")}
        .
      </figcaption>
    </figure>
  );
}

function StatusFields({ task }: { task: string }) {
  const status = useTask(task);
  if (!status) return null;
  return (
    <details>
      <summary>All status fields</summary>
      <table className="list fields">
        <tbody>
          {live.fields
            .filter((one) => one.name in status.fields)
            .map((one) => (
              <tr key={one.name}>
                <th scope="row">{one.name}</th>
                <td className="num live">{field(status.fields[one.name], one.unit)}</td>
                <td className="dim">{one.doc}</td>
              </tr>
            ))}
        </tbody>
      </table>
    </details>
  );
}
