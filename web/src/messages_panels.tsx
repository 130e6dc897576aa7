// What was said: events of tasks, and the commands of this page with their answers.
import { useEffect, useMemo, useRef, useState } from "react";
import { complete } from "./completion";
import { line, sentCommands, type Sent } from "./connection";
import { clock } from "./format";
import { live, useGraph, useLive } from "./live_state";
import { page } from "./page_state";
import { programs, usePrograms } from "./program_state";
import type { Severity } from "./protocol";

const SEVERITIES: Severity[] = ["debug", "info", "warning", "error", "fatal"];
const SIGNS: Record<Severity, string> = {
  debug: "·",
  info: "i",
  warning: "⚠",
  error: "✕",
  fatal: "✖",
};
const STEP = 200;

export function EventsPanel() {
  useLive("events");
  const [least, setLeast] = useState<Severity>("info");
  const [task, setTask] = useState("");
  const [text, setText] = useState("");
  const [most, setMost] = useState(STEP);
  const events = live.events;
  const tasks = useMemo(
    () => [...new Set(events.map((one) => one.task).filter(Boolean))].sort(),
    [events],
  );
  const found = useMemo(() => {
    const words = text.toLowerCase();
    return events
      .filter(
        (one) =>
          SEVERITIES.indexOf(one.severity) >= SEVERITIES.indexOf(least) &&
          (!task || one.task === task) &&
          (!words || `${one.code} ${one.text} ${one.task}`.toLowerCase().includes(words)),
      )
      .reverse();
  }, [events, least, task, text]);
  return (
    <div className="panel">
      <div className="row wrap filters">
        <label>
          from{" "}
          <select
            value={least}
            aria-label="least severity"
            onChange={(event) => setLeast(event.target.value as Severity)}
          >
            {SEVERITIES.map((one) => (
              <option key={one}>{one}</option>
            ))}
          </select>
        </label>
        <label>
          of{" "}
          <select value={task} aria-label="task" onChange={(event) => setTask(event.target.value)}>
            <option value="">all tasks</option>
            {tasks.map((one) => (
              <option key={one}>{one}</option>
            ))}
          </select>
        </label>
        <input
          type="search"
          placeholder="text"
          aria-label="text in the event"
          value={text}
          onChange={(event) => setText(event.target.value)}
        />
      </div>
      <p className="dim" aria-live="polite">
        {found.length} of {events.length} events, the newest first
      </p>
      <ol className="events" aria-label="events">
        {found.slice(0, most).map((one) => (
          <li key={one.n} className={`event-${one.severity}`}>
            <span className="sign" role="img" aria-label={one.severity} title={one.severity}>
              {SIGNS[one.severity]}
            </span>
            <time>{clock(one.t)}</time>
            {one.task ? (
              <button type="button" className="link" onClick={() => page.openTask(one.task)}>
                {one.task}
              </button>
            ) : (
              <span>{one.rtpu}</span>
            )}
            <b>{one.code}</b>
            <pre>{one.text}</pre>
          </li>
        ))}
      </ol>
      {found.length > most && (
        <button type="button" onClick={() => setMost(most + STEP)}>
          show more
        </button>
      )}
    </div>
  );
}

/** The names that a command line may hold, by kind. */
function useNames(): Record<string, string[]> {
  const graph = useGraph();
  const list = usePrograms("list");
  const isLive = live.link === "live";
  useEffect(() => {
    if (isLive && !programs.listed) void programs.list();
  }, [isLive]);
  return useMemo(() => {
    const tasks = graph?.tasks ?? [];
    const names: Record<string, string[]> = {
      task: tasks.map((one) => one.name),
      rtpu: graph?.rtpus.map((one) => one.name) ?? [],
      rmod: tasks.map((one) => one.name),
      variable: graph?.variables.map((one) => one.name) ?? [],
      module: [...new Set(tasks.map((one) => one.module))],
      class: [...new Set(tasks.map((one) => one.class).filter(Boolean))],
      field: live.fields.map((one) => one.name),
      job: programs.listed?.jobs.map((one) => one.name) ?? [],
      command: live.hello?.commands.map((one) => one.name) ?? [],
      signal: ["OFF", "FINISH", "ERROR", "WARNING", "SHUTDOWN", "ILLEGAL", "LEGAL"],
      what: ["flag", "start", "miss"].concat(
        tasks.map((one) => one.name),
        graph?.variables.map((one) => one.name) ?? [],
        graph?.rtpus.map((one) => one.name) ?? [],
      ),
      "task:signal": tasks.flatMap((one) =>
        ["on", "off", "clear", "reinit", "kill"].map((signal) => `${one.name}:${signal}`),
      ),
    };
    for (const one of tasks) names[`parameter ${one.name}`] = one.params.map((each) => each.name);
    return names;
  }, [graph, list]); // `list` stands for the jobs
}

export function CommandsPanel() {
  useLive("sent");
  const sent = sentCommands();
  return (
    <div className="panel commands">
      <CommandLine />
      <ol className="sent" aria-label="commands given from this page" aria-live="polite">
        {[...sent]
          .reverse()
          .slice(0, STEP)
          .map((one) => (
            <SentRow key={one.id} one={one} />
          ))}
      </ol>
      {!sent.length && (
        <p className="dim">
          Commands of this page and their answers are listed here; “help” shows all.
        </p>
      )}
    </div>
  );
}

const WORDS: Record<Sent["outcome"], string> = {
  running: "…",
  done: "done",
  refused: "refused",
  unknown: "unknown",
};

function SentRow({ one }: { one: Sent }) {
  return (
    <li className={`sent-${one.outcome}`}>
      <div>
        <time>{clock(one.at, 0)}</time>
        <code>{one.text}</code>
        <span className="outcome-word">
          {WORDS[one.outcome]}
          {one.outcome === "running" && one.seconds > 0 ? ` ${one.seconds.toFixed(1)} s` : ""}
        </span>
      </div>
      {one.warnings.map((text) => (
        <pre key={text} className="warning">
          {text}
        </pre>
      ))}
      {one.answer && (
        <pre
          className={one.outcome === "done" ? "output" : ""}
          tabIndex={one.outcome === "done" ? 0 : undefined}
        >
          {one.answer}
        </pre>
      )}
    </li>
  );
}

function CommandLine() {
  const names = useNames();
  const [text, setText] = useState("");
  const [chosen, setChosen] = useState(-1);
  const [open, setOpen] = useState(false);
  const before = useRef<string[]>([]);
  const place = useRef(0);
  if (!live.steers) return null;
  const offers = open ? complete(text, live.hello?.commands ?? [], names).slice(0, 40) : [];
  const about = live.hello?.commands
    .filter((one) => text.startsWith(one.name))
    .sort((a, b) => b.name.length - a.name.length)[0];
  const accept = (word: string) => {
    setText(text.replace(/\S*$/, "") + word + (/[=]$/.test(word) ? "" : " "));
    setChosen(-1);
  };
  const send = () => {
    const words = text.trim();
    if (!words) return;
    before.current = [...before.current.filter((one) => one !== words), words];
    place.current = before.current.length;
    setText("");
    setOpen(false);
    void line(words);
  };
  const history = (by: number) => {
    place.current = Math.max(0, Math.min(before.current.length, place.current + by));
    setText(before.current[place.current] ?? "");
  };
  const key = (event: React.KeyboardEvent) => {
    if (event.key === "Tab" && !event.shiftKey && offers.length && text.trim()) {
      event.preventDefault();
      accept(offers[Math.max(0, chosen)]!);
      return;
    }
    if (event.key === "Enter") {
      event.preventDefault();
      if (chosen >= 0 && offers[chosen]) accept(offers[chosen]);
      else send();
      return;
    }
    if (event.key === "Escape") {
      setOpen(false);
      setChosen(-1);
      return;
    }
    if (event.key !== "ArrowDown" && event.key !== "ArrowUp") return;
    event.preventDefault();
    const by = event.key === "ArrowDown" ? 1 : -1;
    if (open && offers.length && text.trim() && (chosen >= 0 || by > 0))
      setChosen(Math.max(-1, Math.min(offers.length - 1, chosen + by)));
    else {
      setOpen(false);
      history(by);
    }
  };
  return (
    <div className="command-line">
      <div className="row">
        <span className="prompt" aria-hidden="true">
          {live.hello?.name}&gt;
        </span>
        <input
          role="combobox"
          aria-label="command"
          aria-expanded={offers.length > 0}
          aria-controls="offers"
          aria-autocomplete="list"
          aria-activedescendant={chosen >= 0 ? `offer-${chosen}` : undefined}
          value={text}
          spellCheck={false}
          autoComplete="off"
          autoCapitalize="off"
          placeholder="a command; Tab completes, arrow up repeats"
          onChange={(event) => {
            setText(event.target.value);
            setOpen(true);
            setChosen(-1);
          }}
          onBlur={() => setOpen(false)}
          onKeyDown={key}
        />
        <button type="button" onClick={send} disabled={!text.trim()}>
          give
        </button>
      </div>
      {about && (
        <p className="usage">
          <code>{about.usage}</code> {about.help}
        </p>
      )}
      {offers.length > 0 && (
        <ul id="offers" role="listbox" aria-label="words that fit">
          {offers.map((word, k) => (
            <li
              key={word}
              id={`offer-${k}`}
              role="option"
              aria-selected={k === chosen}
              onMouseDown={(event) => {
                event.preventDefault();
                accept(word);
              }}
            >
              {word}
            </li>
          ))}
        </ul>
      )}
    </div>
  );
}
