// The program that runs: where it is, what it waits for, and how it is steered.
import { useState } from "react";
import { program } from "./connection";
import { useClock } from "./controls";
import { clock } from "./format";
import { live, useLive } from "./live_state";
import { page, usePage } from "./page_state";
import { short } from "./program_model";
import { ENDED, programs, usePrograms } from "./program_state";
import type { Answer } from "./protocol";

type State = NonNullable<typeof live.running>["state"];

/** Where it is, in words. */
function where(state: State): string {
  const step = state.safe
    ? `the safe job ${state.job}`
    : state.step &&
      (state.step === state.job ? `step ${state.step}` : `step ${state.step} (job ${state.job})`);
  switch (state.phase) {
    case "enters":
      return `changes to ${step}`;
    case "waits":
      return `${step}, waits for ${state.waiting}`;
    case "paused":
      return step
        ? `paused after ${step}`
        : `paused before its first ${state.line > 0 ? "step" : "line"}`;
    case "done":
      return "done";
    case "failed":
      return "failed";
    case "aborted":
      return "aborted";
    case "stopped":
      return "stopped";
    default:
      return step || "begins";
  }
}

/** The last answer of a control, if it was a refusal. */
export function Refusal({ of, close }: { of: Answer | null; close: () => void }) {
  if (!of || of.ok) return null;
  return (
    <div className="outcome refusal" role="alert">
      <button type="button" className="close" onClick={close} aria-label="close this message">
        ×
      </button>
      <pre>{of.text}</pre>
    </div>
  );
}

/** A bar on every page while a program runs; after its end where programs are. */
export function RunBar() {
  useLive("program");
  useLive("link");
  usePage("mode");
  usePrograms("draft");
  const [answer, setAnswer] = useState<Answer | null>(null);
  const running = live.running;
  const here = live.steers && page.mode === "Program";
  if (!running || (ENDED.has(running.state.phase) && !here)) return null;
  const { state, program: name } = running;
  const ended = ENDED.has(state.phase);
  // Why it ended is said already
  const errors = state.errors.filter((one) => !ended || !state.text.includes(one));
  const steer = (what: string) => {
    setAnswer(null);
    void program(what).then(setAnswer);
  };
  const kind = !ended
    ? state.safe || state.failed
      ? "troubled"
      : "runs"
    : state.phase === "done"
      ? "done"
      : "ended";
  return (
    <section className={`run-bar run-${kind} live`} aria-label="program that runs">
      <div className="row wrap">
        <span className="run-mark" aria-hidden="true">
          {ended ? (state.phase === "done" ? "✓" : "■") : state.pausing ? "❚❚" : "▶"}
        </span>
        <b>{name}</b>
        <span className="where" role="status">
          <b>{where(state)}</b>
          {ended && state.text && state.text !== state.phase && `: ${short(state.text)}`}
          {!ended && state.pausing && state.phase !== "paused" && " – pauses before the next line"}
        </span>
        {!ended && <Since t={state.since} />}
        <span className="dim">
          {state.count === 1 ? "1 step" : `${state.count} steps`} entered
          {ended &&
            state.safe &&
            (state.entered.at(-1) === state.step
              ? `; went to the safe job ${state.job}`
              : `; the safe job ${state.job} was not reached`)}
        </span>
        {live.steers && (
          <span className="row run-buttons">
            {!ended &&
              !state.safe &&
              (state.pausing ? (
                <>
                  <button type="button" onClick={() => steer("resume")}>
                    resume
                  </button>
                  <button
                    type="button"
                    onClick={() => steer("step")}
                    title="carry out the next line, then pause again"
                  >
                    step
                  </button>
                </>
              ) : (
                <button
                  type="button"
                  onClick={() => steer("pause")}
                  title="the present job goes on, but no line after it begins"
                >
                  pause
                </button>
              ))}
            {!ended && (
              <button
                type="button"
                className="abort"
                onClick={() => steer("abort")}
                title={
                  state.safe
                    ? "end at once, without waiting for the safe job"
                    : "give the step up, and go to the safe job"
                }
              >
                abort
              </button>
            )}
            {!here && (
              <button
                type="button"
                className="link"
                onClick={() => {
                  page.setMode("Program");
                  void programs.open(name);
                }}
              >
                show the program
              </button>
            )}
            {here && programs.name !== name && (
              <button type="button" className="link" onClick={() => void programs.open(name)}>
                show it
              </button>
            )}
          </span>
        )}
      </div>
      <Refusal of={answer} close={() => setAnswer(null)} />
      {errors.length > 0 && (
        <details open={ended}>
          <summary className="bad">
            {errors.length === 1 ? "1 error" : `${errors.length} errors`}
            {ended && errors.length < state.errors.length && " beside it"}
          </summary>
          {errors.map((text, k) => (
            <pre key={k}>{short(text)}</pre>
          ))}
        </details>
      )}
    </section>
  );
}

/** Since when it is in its phase. */
function Since({ t }: { t: number }) {
  useClock();
  return t > 1e9 ? (
    <span className="dim num" title={`since ${clock(t, 1)}`}>
      {Math.max(0, live.now() - t).toFixed(0)} s
    </span>
  ) : null;
}
