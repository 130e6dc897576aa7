// Forms: what one line of a program says, its safe job, and the program's own lines.
import { useId, useState } from "react";
import { WordField } from "./controls";
import {
  endText,
  fit,
  lineText,
  moved,
  newStep,
  removed,
  replaced,
  stepName,
  steps,
  said,
  short,
  type Content,
  type Finish,
  type Goto,
  type Order,
  type Remark,
  type Repeat,
  type Seq,
  type Step,
  type StepEnd,
} from "./program_model";
import { programs } from "./program_state";

/** A field whose text counts when Enter is pressed or the field is left. */
export function TextField(props: {
  label: string;
  value: string;
  set: (text: string) => void;
  hint?: string;
  words?: readonly string[];
  mono?: boolean;
  focus?: boolean;
}) {
  const [typed, setTyped] = useState<string | null>(null);
  const id = useId();
  const done = () => {
    if (typed !== null && typed.trim() !== props.value) props.set(typed.trim());
    setTyped(null);
  };
  return (
    <label className="field">
      <span>
        {props.label}
        {props.hint && <small>{props.hint}</small>}
      </span>
      <input
        aria-label={props.label}
        aria-description={props.hint}
        list={props.words ? id : undefined}
        value={typed ?? props.value}
        autoComplete="off"
        spellCheck={false}
        className={props.mono ? "mono" : undefined}
        data-typed={typed !== null && typed !== props.value ? "" : undefined}
        onChange={(event) => setTyped(event.target.value)}
        onBlur={done}
        onKeyDown={(event) => {
          if (event.key === "Enter") {
            event.preventDefault();
            done();
          } else if (event.key === "Escape") setTyped(null);
        }}
      />
      {props.words && (
        <datalist id={id}>
          {props.words.map((word) => (
            <option key={word} value={word} />
          ))}
        </datalist>
      )}
    </label>
  );
}

/** A field for a number, or nothing. What is no number is refused here, in words. */
function NumberField(props: {
  label: string;
  value: number | null;
  set: (value: number | null) => void;
  hint?: string;
  whole?: boolean;
}) {
  const [refused, setRefused] = useState("");
  const take = (text: string) => {
    const number = Number(text);
    const good =
      text === "" ||
      (Number.isFinite(number) && number > 0 && (!props.whole || Number.isInteger(number)));
    setRefused(
      good
        ? ""
        : `“${text}” is no ${props.whole ? "whole number" : "number"} above 0: nothing was changed`,
    );
    if (good) props.set(text === "" ? null : number);
  };
  return (
    <div>
      <TextField
        label={props.label}
        hint={props.hint}
        value={props.value === null ? "" : String(props.value)}
        set={take}
      />
      {refused && (
        <p className="refused" role="alert">
          {refused}
        </p>
      )}
    </div>
  );
}

function Choice(props: {
  label: string;
  value: string;
  words: readonly string[];
  set: (word: string) => void;
  none?: string;
  hint?: string;
}) {
  const words =
    props.value && !props.words.includes(props.value) ? [props.value, ...props.words] : props.words;
  return (
    <label className="field">
      <span>
        {props.label}
        {props.hint && <small>{props.hint}</small>}
      </span>
      <select
        aria-label={props.label}
        aria-description={props.hint}
        value={props.value}
        onChange={(event) => props.set(event.target.value)}
      >
        {props.none !== undefined && <option value="">{props.none}</option>}
        {words.map((word) => (
          <option key={word}>{word}</option>
        ))}
      </select>
    </label>
  );
}

// -- ends of steps ---------------------------------------------------------------------

const spawned = (seq: Seq): string[] =>
  seq.lines.flatMap((one) =>
    one.keyword === "ORDER" && one.command === "spawn" ? one.words.slice(0, 1) : [],
  );
function signalsOf(step: Step, seq: Seq, task = ""): string[] {
  const listed = programs.listed;
  if (!listed) return [];
  const tasks = task
    ? [task]
    : [...(listed.jobs.find((one) => one.name === step.job)?.tasks ?? []), ...spawned(seq)];
  return [
    ...new Set([...tasks.flatMap((one) => listed.tasks[one]?.signals ?? []), ...listed.signals]),
  ];
}

function EndFields({
  end,
  step,
  seq,
  set,
}: {
  end: StepEnd;
  step: Step;
  seq: Seq;
  set: (end: StepEnd) => void;
}) {
  const [kind, setKind] = useState(end.condition ? "condition" : "signal");
  const tasks = [
    ...(programs.listed?.jobs.find((one) => one.name === step.job)?.tasks ?? []),
    ...spawned(seq),
  ];
  return (
    <>
      <Choice
        label="by"
        value={kind}
        words={["signal", "condition"]}
        set={(word) => {
          setKind(word);
          if (word === "signal" && end.condition)
            set({ condition: "", task: "", signal: "FINISH" });
        }}
      />
      {kind === "condition" ? (
        <TextField
          label="condition"
          mono
          value={end.condition}
          hint="such as WIDTH > 7 [cm]"
          words={programs.listed?.variables}
          set={(condition) =>
            set(
              condition
                ? { condition, signal: "", task: "" }
                : { condition: "", signal: "FINISH", task: "" },
            )
          }
        />
      ) : (
        <>
          <TextField
            label="signal"
            mono
            value={end.signal}
            words={signalsOf(step, seq, end.task)}
            set={(signal) => set({ ...end, condition: "", signal })}
          />
          <Choice
            label="of"
            value={end.task}
            words={tasks}
            none="any task"
            set={(task) => set({ ...end, condition: "", task })}
          />
        </>
      )}
    </>
  );
}

function Ends({
  step,
  seq,
  set,
}: {
  step: Step;
  seq: Seq;
  set: (label: string, step: Step) => void;
}) {
  const put = (label: string, until: StepEnd[]) => set(label, { ...step, until });
  return (
    <fieldset>
      <legend>ends when (UNTIL)</legend>
      {step.until.map((end, k) => (
        <div
          className="end-fields"
          key={`${k} ${step.until.length} ${end.condition ? "c" : "s"}`}
          role="group"
          aria-label={`end ${k + 1}`}
        >
          <EndFields
            end={end}
            step={step}
            seq={seq}
            set={(one) => put(`end ${endText(one)}`, step.until.with(k, one))}
          />
          <button
            type="button"
            onClick={() => put(`end ${endText(end)} removed`, step.until.toSpliced(k, 1))}
            aria-label={`remove the end ${endText(end)}`}
          >
            remove
          </button>
        </div>
      ))}
      {!step.until.length && step.seconds === null && (
        <p className="dim">It ends at once: the next line follows when its job is ON.</p>
      )}
      <button
        type="button"
        onClick={() =>
          put("end FINISH", [...step.until, { signal: "FINISH", task: "", condition: "" }])
        }
      >
        add an end
      </button>
    </fieldset>
  );
}

function StepFields({
  step,
  seq,
  set,
  safe = false,
}: {
  step: Step;
  seq: Seq;
  set: (label: string, step: Step) => void;
  safe?: boolean;
}) {
  const name = stepName(step);
  const jobs = programs.listed?.jobs.map((one) => one.name) ?? [];
  const names = steps(seq)
    .map(stepName)
    .filter((one, k, all) => one && all.indexOf(one) === k);
  const change = (part: Partial<Step>, what: string) =>
    set(`${what} of ${name}`, { ...step, ...part });
  return (
    <>
      <Choice
        label="job"
        value={step.job}
        words={jobs}
        set={(job) => change({ job }, `job ${job} instead`)}
      />
      {!safe && (
        <TextField
          label="label"
          hint="where the job stands in several steps"
          value={step.label}
          set={(label) => change({ label }, "label")}
        />
      )}
      <Ends step={step} seq={seq} set={set} />
      <NumberField
        label="or after (FOR)"
        hint="s; empty: no such time"
        value={step.seconds}
        set={(seconds) => change({ seconds }, "time")}
      />
      <NumberField
        label="at most (WITHIN)"
        hint="s; later it has failed"
        value={step.within}
        set={(within) => change({ within }, "limit")}
      />
      {!safe && (
        <Choice
          label="after an error (ELSE)"
          value={step.otherwise}
          words={names}
          none="the program fails"
          set={(otherwise) => change({ otherwise }, "ELSE")}
        />
      )}
    </>
  );
}

// -- other lines -----------------------------------------------------------------------

function GotoFields({
  line,
  seq,
  at,
  set,
}: {
  line: Goto;
  seq: Seq;
  at: number;
  set: (label: string, line: Content) => void;
}) {
  const above =
    seq.lines
      .slice(0, at)
      .findLast((one): one is Step & { key: number } => one.keyword === "STEP") ?? newStep("");
  const names = steps(seq)
    .map(stepName)
    .filter((one, k, all) => all.indexOf(one) === k);
  return (
    <>
      <Choice
        label="go to"
        value={line.step}
        words={names}
        none={line.step ? undefined : "choose a step"}
        set={(step) => set(`go to ${step}`, { ...line, step })}
      />
      <Choice
        label="when"
        value={line.when ? "if" : ""}
        words={["if"]}
        none="always"
        set={(word) =>
          set(word ? "go to with a condition" : "go to always", {
            ...line,
            when: word ? (above.until[0] ?? { signal: "FINISH", task: "", condition: "" }) : null,
          })
        }
      />
      {line.when && (
        <fieldset className="end-fields">
          <legend>if it holds, or the step above ended so</legend>
          <EndFields
            end={line.when}
            step={above}
            seq={seq}
            set={(when) => set(`go to if ${endText(when)}`, { ...line, when })}
          />
        </fieldset>
      )}
    </>
  );
}

function RepeatFields({
  line,
  set,
}: {
  line: Repeat;
  set: (label: string, line: Content) => void;
}) {
  return (
    <NumberField
      label="times"
      hint="empty: for ever"
      whole
      value={line.times || null}
      set={(times) => set(`repeat ${times ?? "forever"}`, { ...line, times: times ?? 0 })}
    />
  );
}

function FinishFields({
  line,
  set,
}: {
  line: Finish;
  set: (label: string, line: Content) => void;
}) {
  return (
    <>
      <Choice
        label="the program is"
        value={line.failed ? "failed" : "done"}
        words={["done", "failed"]}
        set={(word) => set(word, { ...line, failed: word === "failed" })}
      />
      <TextField
        label="because"
        hint="a text for people"
        value={line.text}
        set={(text) => set("text of the end", { ...line, text })}
      />
    </>
  );
}

type Named = [label: string, words: string[], rest?: boolean];
function OrderFields({
  line,
  seq,
  set,
}: {
  line: Order;
  seq: Seq;
  set: (label: string, line: Content) => void;
}) {
  const listed = programs.listed;
  const tasks = [
    ...new Set([
      ...(listed?.jobs
        .filter((one) => steps(seq).some((step) => step.job === one.name))
        .flatMap((one) => one.tasks) ?? []),
      ...spawned(seq),
    ]),
  ];
  const fields: Record<Order["command"], Named[]> = {
    spawn: [
      ["rmod", Object.keys(listed?.tasks ?? {})],
      ["rtpu", listed?.rtpus ?? []],
    ],
    kill: [["tasks", tasks, true]],
    set: [
      ["task", tasks],
      ["parameter", listed?.tasks[line.words[0] ?? ""]?.params ?? []],
      ["values", [], true],
    ],
    write: [
      ["variable", listed?.variables ?? []],
      ["values", [], true],
    ],
  };
  const own = fields[line.command];
  const put = (k: number, text: string) => {
    const words = own.map(([, , rest], n) =>
      n === k ? text : rest ? line.words.slice(n).join(" ") : (line.words[n] ?? ""),
    );
    const order = { ...line, words: words.join(" ").split(/\s+/).filter(Boolean) };
    set(lineText(order), order);
  };
  return (
    <>
      <Choice
        label="command"
        value={line.command}
        words={["spawn", "kill", "set", "write"]}
        set={(command) =>
          set(command, { ...line, command: command as Order["command"], words: [] })
        }
      />
      {own.map(([label, words, rest], k) => (
        <TextField
          key={line.command + label}
          label={label}
          mono
          words={words}
          hint={
            rest
              ? "several with spaces between"
              : label === "rtpu"
                ? "empty: where it belongs"
                : undefined
          }
          value={rest ? line.words.slice(k).join(" ") : (line.words[k] ?? "")}
          set={(text) => put(k, text)}
        />
      ))}
    </>
  );
}

// -- the panel -------------------------------------------------------------------------

export function RemarkList({ of }: { of: readonly Remark[] }) {
  return (
    <>
      {of.map((one) => (
        <pre key={one.text} className={`remark remark-${one.severity}`}>
          {short(said(one.text))}
        </pre>
      ))}
    </>
  );
}

export function FormPanel({ said: told }: { said: Map<number, Remark[]> }) {
  const draft = programs.draft!;
  if (programs.chosen === "program") return <ProgramFields seq={draft.seq} />;
  if (programs.chosen === "safe") return <SafeFields seq={draft.seq} told={told.get(-1) ?? []} />;
  return programs.line && <LineFields key={programs.line.key} told={told.get(programs.at) ?? []} />;
}

function LineFields({ told }: { told: Remark[] }) {
  const draft = programs.draft!,
    seq = draft.seq,
    at = programs.at,
    line = seq.lines[at]!;
  const set = (label: string, content: Content) => programs.edit(label, replaced(seq, at, content));
  const jobs = programs.listed?.jobs ?? [];
  const job = line.keyword === "STEP" ? jobs.find((one) => one.name === line.job) : undefined;
  const edge = fit(seq, at, jobs, draft.judged);
  return (
    <section className="panel" aria-label="line">
      <h3>
        {line.keyword === "STEP" ? (
          <>
            step <code>{stepName(line)}</code>
          </>
        ) : (
          lineText(line)
        )}
      </h3>
      {job && <p className="dim">{job.desc}</p>}
      <div className="row wrap">
        <button type="button" disabled={at === 0} onClick={() => shift(-1)}>
          ◂ move left
        </button>
        <button type="button" disabled={at === seq.lines.length - 1} onClick={() => shift(1)}>
          move right ▸
        </button>
        <button type="button" onClick={remove}>
          remove
        </button>
      </div>
      {told.length > 0 && (
        <div role="status">
          <RemarkList of={told} />
        </div>
      )}
      {line.keyword === "STEP" && <StepFields step={line} seq={seq} set={set} />}
      {line.keyword === "GOTO" && <GotoFields line={line} seq={seq} at={at} set={set} />}
      {line.keyword === "REPEAT" && <RepeatFields line={line} set={set} />}
      {line.keyword === "FINISH" && <FinishFields line={line} set={set} />}
      {line.keyword === "ORDER" && <OrderFields line={line} seq={seq} set={set} />}
      {job && (
        <dl className="conditions">
          {edge && (
            <>
              <dt>guaranteed by {edge.from}</dt>
              {edge.gives.length ? (
                edge.gives.map((one) => <dd key={one}>{one}</dd>)
              ) : (
                <dd className="dim">nothing</dd>
              )}
            </>
          )}
          <dt>demanded by its PRE</dt>
          {job.pre.length ? (
            job.pre.map((one) => <dd key={one}>{one}</dd>)
          ) : (
            <dd className="dim">nothing</dd>
          )}
          <dt>its own POST</dt>
          {job.post.length ? (
            job.post.map((one) => <dd key={one}>{one}</dd>)
          ) : (
            <dd className="dim">nothing</dd>
          )}
        </dl>
      )}
    </section>
  );
}

/** Moves the chosen line one place to the left or right. */
export function shift(by: 1 | -1): void {
  const seq = programs.draft?.seq,
    at = programs.at;
  if (!seq || at < 0) return;
  programs.edit(`${lineText(seq.lines[at]!)} moved`, moved(seq, at, by > 0 ? at + 2 : at - 1));
}
/** Removes the chosen line, and chooses the next one. */
export function remove(): void {
  const seq = programs.draft?.seq,
    at = programs.at;
  if (!seq || at < 0) return;
  const rest = removed(seq, at);
  programs.edit(
    `${lineText(seq.lines[at]!)} removed`,
    rest,
    rest.lines[Math.min(at, rest.lines.length - 1)]?.key ?? "program",
  );
}

function SafeFields({ seq, told }: { seq: Seq; told: Remark[] }) {
  const set = (label: string, safe: Step | null) =>
    programs.edit(`safe job: ${label}`, { ...seq, safe });
  const jobs = programs.listed?.jobs.map((one) => one.name) ?? [];
  return (
    <section className="panel" aria-label="safe job">
      <h3>the safe job (SAFE)</h3>
      <p className="dim">An abort leads to it, and an error that no ELSE takes.</p>
      <RemarkList of={told} />
      {seq.safe ? (
        <>
          <StepFields step={seq.safe} seq={seq} safe set={set} />
          <button type="button" onClick={() => set("removed", null)}>
            remove the safe job
          </button>
        </>
      ) : (
        <Choice
          label="job"
          value=""
          words={jobs}
          none="none: the present job stays"
          set={(job) => set(job, newStep(job))}
        />
      )}
    </section>
  );
}

function ProgramFields({ seq }: { seq: Seq }) {
  return (
    <section className="panel" aria-label="the program">
      <h3>
        program <code>{programs.name}</code>
      </h3>
      <TextField
        label="description"
        hint="DESC"
        value={seq.desc}
        set={(desc) => programs.edit("description", { ...seq, desc })}
      />
      <NumberField
        label="wait for conditions (WAIT)"
        hint="s that PRE and POST may take"
        value={seq.wait || null}
        set={(wait) => programs.edit("WAIT", { ...seq, wait: wait ?? 0 })}
      />
      <NumberField
        label="each step at most (WITHIN)"
        hint="s; empty: no limit"
        value={seq.within}
        set={(within) => programs.edit("WITHIN", { ...seq, within })}
      />
      <p className="dim">
        Choose an icon to see what ends its step. Keys there: arrows choose, Alt with an arrow
        moves, Delete removes, Enter opens the form; Ctrl Z takes back.
      </p>
    </section>
  );
}

/** A field for a new program's name. */
export function NewName({ begin }: { begin: (name: string) => void }) {
  const [name, setName] = useState("");
  return (
    <form
      className="row new-name"
      onSubmit={(event) => {
        event.preventDefault();
        if (name.trim()) {
          begin(name.trim());
          setName("");
        }
      }}
    >
      <WordField label="new program" value={name} words={[]} change={setName} />
      <button type="submit" disabled={!name.trim()}>
        begin
      </button>
    </form>
  );
}
