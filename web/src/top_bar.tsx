// What is always visible: who and where, the flag, complaints, Stop, and the time of a recorded
// run.
import { useEffect, useState } from "react";
import { play, seek, stop } from "./connection";
import { Why, useClock, useGlobalKey } from "./controls";
import { clock } from "./format";
import { illegalCauses, live, useGraph, useLive } from "./live_state";
import { MODES, page, usePage } from "./page_state";
import type { Answer } from "./protocol";

export const STOP_KEY = "F8";
const DONE_FOR = 6000; // ms; the message covers other buttons

export function TopBar() {
  useLive("hello");
  useLive("link");
  const hello = live.hello;
  return (
    <header className="top">
      <div className="who">
        <h1>{hello?.name ?? "pbonet"}</h1>
        <Job />
        {hello && <Role />}
      </div>
      {live.steers && <Modes />}
      <Flag />
      <LinkState />
      {live.steers && <Stop />}
    </header>
  );
}

/** The job that was entered last; before any was, the one with which the page was opened. */
function Job() {
  const present = useGraph()?.job ?? "";
  const opened = live.hello?.job ?? "";
  if (live.log) return <span className="dim">job {opened}</span>;
  if (present) return <span className="job">job {present}</span>;
  return opened ? <span className="dim">opened with job {opened}</span> : null;
}

/** Chooses what the page is for. */
function Modes() {
  usePage("mode");
  return (
    <nav className="modes" aria-label="what the page is for">
      {MODES.map((one) => (
        <button
          key={one}
          type="button"
          aria-pressed={page.mode === one}
          onClick={() => page.setMode(one)}
        >
          {one}
        </button>
      ))}
    </nav>
  );
}

function Role() {
  if (live.log) return <span className="badge">recorded run</span>;
  return live.role === "observer" ? (
    <span
      className="badge"
      title="the link that this page was opened with lets you look, not steer"
    >
      observer: looks only
    </span>
  ) : (
    <span className="badge">operator</span>
  );
}

function LinkState() {
  useClock();
  if (live.link === "live")
    return (
      <span className="link-state ok">
        <i aria-hidden="true" />
        {live.log ? "recorded" : "live"} <time>{live.now() ? clock(live.now(), 0) : ""}</time>
      </span>
    );
  return (
    <span className="link-state lost">
      <i aria-hidden="true" />
      {live.link === "lost" ? "connection lost" : "connecting"}
    </span>
  );
}

function Flag() {
  useLive("status");
  if (!live.rtpus.size) return null;
  const isIllegal = illegalCauses(live.rtpus.values()).length > 0;
  return (
    <span
      className={`flag live ${isIllegal ? "illegal" : "legal"}`}
      title={`the flag of the configuration that ${live.log ? "ran" : "runs"}`}
    >
      {isIllegal ? "▲ ILLEGAL" : "✓ legal"}
    </span>
  );
}

function Stop() {
  const [answer, setAnswer] = useState<Answer | null>(null);
  const [busy, setBusy] = useState(false);
  const act = () => {
    setBusy(true);
    setAnswer(null);
    void stop().then((got) => {
      setAnswer(got);
      setBusy(false);
    });
  };
  useEffect(() => {
    // what it has done is in the events, too; a refusal stays
    if (!answer?.ok || answer.warnings.length) return undefined;
    const timer = setTimeout(() => setAnswer(null), DONE_FOR);
    return () => clearTimeout(timer);
  }, [answer]);
  useGlobalKey(STOP_KEY, act);
  return (
    <div className="stop-place">
      <button
        type="button"
        className="stop"
        onClick={act}
        aria-keyshortcuts={STOP_KEY}
        title="turn all tasks off and end them, now; it asks nothing"
      >
        {busy ? "stopping…" : "STOP"} <kbd>{STOP_KEY}</kbd>
      </button>
      {answer && (
        <div className={`outcome ${answer.ok ? "done" : "refusal"}`} role="alert">
          <button
            type="button"
            className="close"
            aria-label="close this message"
            onClick={() => setAnswer(null)}
          >
            ×
          </button>
          <pre>{answer.text || "stopped"}</pre>
        </div>
      )}
    </div>
  );
}

/** Bars below the top: lost connection, complaints, causes of the flag, faults of the graph. */
export function Bars() {
  useLive("link");
  useLive("complaints");
  useLive("status");
  const graph = useGraph();
  const causes = illegalCauses(live.rtpus.values());
  const failed = [...live.tasks.values()]
    .filter((one) => one.state === "ERROR")
    .map((one) => one.task);
  return (
    <div className="bars">
      <p className="away" aria-live="polite">
        {failed.length ? `in ERROR: ${failed.join(", ")}` : ""}
      </p>
      {live.link === "lost" && (
        <p className="bar lost" role="alert">
          <b>Connection lost.</b> {live.linkText} What is shown is old: it is from{" "}
          {clock(live.now(), 0)}. Trying again every half second.
          {live.steers &&
            " Stop cannot be sent from here: use the emergency stop, or “pbonet stop”."}
        </p>
      )}
      {causes.map(({ cause, rtpus }) => (
        <p className="bar illegal live" key={cause} role="alert">
          <b>ILLEGAL</b> <span className="dim">{rtpus.join(", ")}</span> {cause}
        </p>
      ))}
      {causes.length > 0 && <Why what={["flag"]} />}
      {graph?.faults
        .filter((one) => one.severity !== "warn")
        .map((one) => (
          <p className="bar fault-refuse" key={one.text}>
            <b>✕ fault</b> <span>{one.text}</span>
          </p>
        ))}
      <Remarks
        texts={graph?.faults.filter((one) => one.severity === "warn").map((one) => one.text) ?? []}
      />
      {live.complaints.map((text) => (
        <p className="bar complaint" key={text} role="status">
          <b>⚠</b> <span>{text}</span>
        </p>
      ))}
    </div>
  );
}

/** What is doubtful in the graph: a line that opens, because it is no hindrance. */
function Remarks({ texts }: { texts: string[] }) {
  if (!texts.length) return null;
  return (
    <details className="bar fault-warn">
      <summary>
        <b>⚠ {texts.length === 1 ? "one remark" : `${texts.length} remarks`}</b> about the
        configuration
      </summary>
      {texts.map((text) => (
        <p key={text}>{text}</p>
      ))}
    </details>
  );
}

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10];

/** The time bar of a recorded run. */
export function LogBar() {
  useLive("hello");
  useLive("status");
  useLive("at");
  const [speed, setSpeed] = useState(1);
  const [dragged, setDragged] = useState<number | null>(null);
  const log = live.log;
  if (!log) return null;
  const at = dragged ?? Math.max(log.begin, Math.min(log.end, live.now()));
  const playing = live.speed > 0;
  const go = (on: boolean, by = speed) => play(on ? by : 0);
  const release = () => {
    if (dragged !== null) {
      seek(dragged);
      setDragged(null);
    }
  };
  return (
    <div className="log-bar row" role="group" aria-label="recorded run">
      <button type="button" className="primary" onClick={() => go(!playing)}>
        {playing ? "pause" : "play"}
      </button>
      <select
        value={speed}
        aria-label="speed"
        onChange={(event) => {
          const by = Number(event.target.value);
          setSpeed(by);
          if (playing) go(true, by);
        }}
      >
        {SPEEDS.map((one) => (
          <option key={one} value={one}>
            {one} ×
          </option>
        ))}
      </select>
      <input
        type="range"
        min={log.begin}
        max={log.end}
        step="any"
        value={at}
        aria-label="time in the run"
        aria-valuetext={`${(at - log.begin).toFixed(1)} s`}
        onChange={(event) => setDragged(Number(event.target.value))}
        onPointerUp={release}
        onKeyUp={release}
        onBlur={release}
      />
      <span>
        {(at - log.begin).toFixed(1)} / {(log.end - log.begin).toFixed(1)} s
      </span>
      <span className="dim" title={log.file}>
        {clock(at, 1)}
      </span>
    </div>
  );
}
