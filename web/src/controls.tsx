// Parts that several panels use: states, buttons of signals, and what became of a command.
import { useCallback, useEffect, useId, useRef, useState, type ReactNode, type Ref } from "react";
import { command, sentCommands, type Args, type Sent } from "./connection";
import { live, stateOf, useLive, useTask } from "./live_state";
import type { Answer } from "./protocol";

export type Shown = "ON" | "OFF" | "ERROR" | "NOT-CREATED" | "?";

/** A state as shape, colour and word, so that no one of them has to be seen. */
export function StateMark({ state, word = true }: { state: Shown; word?: boolean }) {
  return (
    <span
      className={`state state-${state.toLowerCase().replace("?", "unknown")}`}
      title={`state ${state}`}
    >
      <svg viewBox="0 0 16 16" aria-hidden="true">
        {state === "ON" && <circle cx="8" cy="8" r="6.5" />}
        {state === "OFF" && (
          <rect className="open" x="2.5" y="2.5" width="11" height="11" rx="1.5" />
        )}
        {state === "ERROR" && (
          <>
            <path d="M8 1 15.5 14.5H.5Z" />
            <path className="sign" d="M8 6v4M8 11.6v1.2" />
          </>
        )}
        {(state === "NOT-CREATED" || state === "?") && (
          <circle className="open dashed" cx="8" cy="8" r="6" />
        )}
      </svg>
      {word && <b>{state}</b>}
    </span>
  );
}

export function TaskState({ task, word = true }: { task: string; word?: boolean }) {
  useTask(task);
  return <StateMark state={stateOf(task)} word={word} />;
}

export const commandHelp = (name: string): string =>
  live.hello?.commands.find((one) => one.name === name)?.help ?? "";
export const argHelp = (name: string, arg: string): string =>
  live.hello?.commands.find((one) => one.name === name)?.args.find((one) => one.name === arg)
    ?.doc ?? "";

export interface Running {
  run: (name: string, args: Args) => Promise<Answer>;
  busy: boolean;
  answer: Answer | null;
  clear: () => void;
  progress: Sent | undefined;
}

/** Gives commands for one control, and keeps the last answer for it. */
export function useCommand(): Running {
  const [busy, setBusy] = useState(false);
  const [answer, setAnswer] = useState<Answer | null>(null);
  const running = useRef(0);
  useLive("sent");
  const run = useCallback(async (name: string, args: Args) => {
    setBusy(true);
    setAnswer(null);
    const coming = command(name, args);
    const id = sentCommands().at(-1)?.id ?? 0;
    running.current = id;
    const got = await coming;
    if (running.current === id) {
      setBusy(false);
      setAnswer(got);
    }
    return got;
  }, []);
  const clear = useCallback(() => setAnswer(null), []);
  const progress = busy ? sentCommands().find((one) => one.id === running.current) : undefined;
  return { run, busy, answer, clear, progress };
}

/**
 * What became of the command of one control: its refusal word for word, its warnings, how long it
 * takes.
 */
export function Outcome({
  of,
  done = "",
  place,
}: {
  of: Running;
  done?: ReactNode;
  place?: Ref<HTMLDivElement>;
}) {
  const { answer, busy, progress } = of;
  if (busy && progress && progress.seconds > 0) {
    return (
      <p className="outcome progress" role="status">
        {progress.answer || "still at it"} – {progress.seconds.toFixed(1)} s
      </p>
    );
  }
  if (!answer || (answer.ok && !answer.warnings.length && !done)) return null;
  return (
    <div
      ref={place}
      className={`outcome ${!answer.ok ? "refusal" : answer.warnings.length ? "warned" : "done"}`}
      role={answer.ok ? "status" : "alert"}
    >
      <button type="button" className="close" onClick={of.clear} aria-label="close this message">
        ×
      </button>
      {answer.ok ? done : <pre>{answer.text}</pre>}
      {answer.warnings.map((text) => (
        <pre key={text} className="warning">
          {text}
        </pre>
      ))}
    </div>
  );
}

const ORDER = ["on", "off", "clear", "reinit", "kill"];
/** Returns signals in the order of their buttons: what cannot be taken back is the last. */
export const inOrder = (signals: readonly string[]): string[] =>
  [...signals].sort((a, b) => ORDER.indexOf(a) - ORDER.indexOf(b));

/** The signals that a task may be sent now, as buttons, and the last refusal. */
export function SignalButtons({ task, place }: { task: string; place?: Ref<HTMLDivElement> }) {
  const status = useTask(task);
  useLive("link");
  const running = useCommand();
  if (!live.steers) return null;
  const info = live.graph?.tasks.find((one) => one.name === task);
  return (
    <div className="signals nodrag nopan">
      {!status && info && stateOf(task) === "NOT-CREATED" && (
        <button
          type="button"
          className="signal"
          title={commandHelp("spawn")}
          aria-label={`spawn ${task}`}
          disabled={running.busy || live.link !== "live"}
          onClick={() => void running.run("spawn", { rmod: task, rtpu: info.rtpu })}
        >
          spawn
        </button>
      )}
      {inOrder(status?.signals ?? []).map((signal) => (
        <button
          key={signal}
          type="button"
          className={`signal signal-${signal}`}
          title={commandHelp(signal)}
          aria-label={`${signal} ${task}`}
          disabled={running.busy || live.link !== "live"}
          onClick={(event) => {
            event.stopPropagation();
            void running.run(signal, { task: [task] });
          }}
        >
          {signal}
        </button>
      ))}
      <Outcome of={running} {...(place ? { place } : {})} />
    </div>
  );
}

/** A button that explains why something is as it is, and the chain of causes below it. */
export function Why({ what }: { what: string[] }) {
  useLive("link");
  const running = useCommand();
  const about = what.join(" ");
  return (
    <div className="why">
      <button
        type="button"
        className="link"
        title={commandHelp("explain") + (live.log ? " Of the whole run, not of this time." : "")}
        aria-label={`explain ${about}`}
        disabled={running.busy || live.link !== "live"}
        onClick={() => void running.run("explain", { what })}
      >
        why?
      </button>
      <Outcome of={running} done={<pre>{running.answer?.text}</pre>} />
    </div>
  );
}

/** A field for a word, with words to choose from. */
export function WordField(props: {
  label: string;
  value: string;
  words: readonly string[];
  change: (text: string) => void;
  enter?: () => void;
  hint?: string;
  focus?: () => void;
}) {
  const id = useId();
  return (
    <label className="field">
      <span>
        {props.label}
        {props.hint && <small>{props.hint}</small>}
      </span>
      <input
        list={id}
        value={props.value}
        autoComplete="off"
        spellCheck={false}
        onFocus={props.focus}
        onChange={(event) => props.change(event.target.value)}
        onKeyDown={(event) => {
          if (event.key === "Enter" && props.enter) {
            event.preventDefault();
            props.enter();
          }
        }}
      />
      <datalist id={id}>
        {props.words.slice(0, 300).map((word) => (
          <option key={word} value={word} />
        ))}
      </datalist>
    </label>
  );
}

/** The names for all fields that take a variable. */
export function VariableNames() {
  useLive("graph");
  return (
    <datalist id="plot-variables">
      {[...live.variables.values()]
        .filter((one) => !one.constant)
        .slice(0, 600)
        .map((one) => (
          <option key={one.name} value={one.name}>
            {one.desc}
          </option>
        ))}
    </datalist>
  );
}

/** Draws again twice a second, where an age is shown that grows by itself. */
export function useClock(): void {
  useLive("status");
  useLive("link");
}

/** Calls something when a key is pressed anywhere, even while a field has the focus. */
export function useGlobalKey(key: string, act: () => void): void {
  const latest = useRef(act);
  latest.current = act;
  useEffect(() => {
    const pressed = (event: KeyboardEvent) => {
      if (event.key !== key || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      if (!event.repeat) latest.current();
    };
    window.addEventListener("keydown", pressed, { capture: true });
    return () => window.removeEventListener("keydown", pressed, { capture: true });
  }, [key]);
}
