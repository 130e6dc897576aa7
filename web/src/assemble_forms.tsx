// The details of what is chosen: forms of a task, a port, a variable and the job.
import { useEffect, useRef, useState, type ReactNode } from "react";
import { unitText } from "./format";
import { portTitle } from "./node_cards";
import type { EditorState, Fit, ParamInfo, Port, TaskInfo } from "./protocol";
import { choicesOf } from "./task_panel";
import { CheckField, ChoiceField, Refusal, TextField } from "./assemble_fields";
import { FaultCard } from "./assemble_verdict";
import { assemble, useAssemble, useEditor } from "./assemble_state";
import { faultsOf, numbersOf, portOf } from "./assemble_words";

/**
 * A setting of a task: its name, its unit, what it means, and words to choose from if it takes no
 * others.
 */
interface Setting {
  field: string;
  label: string;
  unit?: string;
  hint: string;
  choices?: readonly (readonly [string, string])[];
  words?: readonly string[];
  wide?: boolean;
}
const choices = (...words: string[]) => words.map((one) => [one, one] as const);
const RESTARTS = [
  ["off", "comes back OFF"],
  ["on", "comes back ON"],
  ["never", "stays away"],
] as const;
const FIRST: Setting[] = [
  {
    field: "freq",
    label: "FREQ",
    unit: "Hz",
    hint: "how often it runs a cycle; empty: as its RMOD says",
  },
  {
    field: "crit",
    label: "CRIT",
    unit: "1 to 62",
    hint: "criticality, instead of the scheduler's rule",
  },
  {
    field: "maxc",
    label: "MAXC",
    unit: "s",
    hint: "greatest execution time of a cycle; empty: as was measured",
  },
  {
    field: "restart",
    label: "RESTART",
    hint: "what becomes of it when its RTPU or the machine was lost",
    choices: RESTARTS,
  },
];
const MORE: Setting[] = [
  { field: "desc", label: "DESC", hint: "what it does, in a few words", wide: true },
  {
    field: "tasktype",
    label: "TASKTYPE",
    hint: "how it is timed",
    choices: choices("periodic", "synchronous", "sporadic", "deferrable", "background"),
  },
  { field: "minc", label: "MINC", unit: "s", hint: "least execution time of a cycle" },
  {
    field: "effc",
    label: "EFFC",
    unit: "s",
    hint: "of a soft task: the execution time to reserve, from MINC to MAXC",
  },
  {
    field: "softness",
    label: "SOFTNESS",
    unit: "0 to 1",
    hint: "share of the cycles that may miss",
  },
  { field: "capacity", label: "CAPACITY", unit: "s", hint: "CPU time of a server in each period" },
  {
    field: "handler",
    label: "HANDLER",
    unit: "1 to 62",
    hint: "criticality at which its handler of timing failures runs",
  },
  {
    field: "stale",
    label: "STALE",
    hint: "what it does while an input is too old",
    choices: [["", "as its module says"], ...choices("hold", "stable", "safe", "error")],
  },
  {
    field: "settle",
    label: "SETTLE",
    unit: "s",
    hint: "how long all inputs must have been fresh before it goes on",
  },
  {
    field: "safe_at",
    label: "SAFE",
    hint: "timing failures at which its out-vars get their safe values at once: deadline maxexec minexec",
    words: ["deadline", "maxexec", "minexec", "deadline maxexec", "deadline maxexec minexec"],
    wide: true,
  },
  {
    field: "needs",
    label: "NEEDS",
    hint: "the device that a special purpose processor must have",
    choices: [["", "nothing"], ...choices("cuda", "warp", "torch", "numpy")],
  },
];
const VARIABLE: Setting[] = [
  { field: "units", label: "UNITS", hint: "its unit, such as rad/s; none" },
  { field: "nelem", label: "NELEM", hint: "number of elements" },
  {
    field: "type",
    label: "TYPE",
    hint: "type of an element",
    words: ["double", "float", "int", "unsigned", "char", "long", "short"],
  },
  { field: "desc", label: "DESC", hint: "what it is, in a few words", wide: true },
  { field: "init", label: "INIT", hint: "first values; those that are missing are 0", wide: true },
  { field: "min", label: "MIN", hint: "least values", wide: true },
  { field: "max", label: "MAX", hint: "greatest values", wide: true },
  {
    field: "limit",
    label: "LIMIT",
    hint: "what is done with a value outside of MIN and MAX",
    choices: choices("none", "clip", "error"),
  },
  { field: "maxage", label: "MAXAGE", unit: "s", hint: "age from which a reader sees it as stale" },
  {
    field: "rate",
    label: "RATE",
    unit: "Hz",
    hint: "how often it is carried to other machines at most; empty: each time",
  },
];
const LISTS = new Set(["init", "min", "max"]);

const textOf = (value: unknown): string =>
  value === null || value === undefined
    ? ""
    : Array.isArray(value)
      ? value.flat(9).join(" ")
      : String(value);

/** The form of what is chosen. */
export function DetailsPanel() {
  const state = useEditor();
  useAssemble("chosen");
  const place = useRef<HTMLDivElement>(null);
  const chosen = assemble.chosen;
  const key = JSON.stringify(chosen);
  useEffect(() => {
    if (chosen.kind === "port") place.current?.querySelector<HTMLElement>("h3")?.focus();
  }, [key, chosen.kind]);
  if (!state) return null;
  const task = state.graph.tasks.find((one) => one.name === assemble.task);
  return (
    <div className="panel" ref={place} key={key}>
      {chosen.kind !== "job" && (
        <p className="row">
          <button type="button" className="link" onClick={() => assemble.choose({ kind: "job" })}>
            ← the job
          </button>
          {chosen.kind === "port" && (
            <button
              type="button"
              className="link"
              onClick={() => assemble.choose({ kind: "task", task: chosen.task })}
            >
              {chosen.task}
            </button>
          )}
        </p>
      )}
      {chosen.kind === "job" && <JobForm state={state} />}
      {chosen.kind === "task" && task && <TaskForm state={state} task={task} />}
      {chosen.kind === "port" && <PortForm state={state} task={chosen.task} port={chosen.port} />}
      {chosen.kind === "variable" && <VariableForm state={state} name={chosen.name} />}
    </div>
  );
}

function SettingField({
  of,
  value,
  set,
}: {
  of: Setting;
  value: unknown;
  set: (text: string) => void;
}) {
  const common = {
    label: of.label,
    at: `field ${of.field}`,
    hint: of.hint,
    unit: of.unit ?? "",
    wide: of.wide ?? false,
  };
  return of.choices ? (
    <ChoiceField {...common} value={textOf(value)} choices={of.choices} set={set} />
  ) : (
    <TextField
      {...common}
      value={textOf(value)}
      set={set}
      placeholder={of.hint.length < 30 ? of.hint : ""}
      {...(of.words ? { words: of.words } : {})}
    />
  );
}

function TaskForm({ state, task }: { state: EditorState; task: TaskInfo }) {
  const settings = state.settings[task.name] ?? {};
  const set = (field: string, value: unknown) =>
    void assemble.change("set_field", { task: task.name, field, value }, `field ${field}`);
  const faults = faultsOf(state).filter(({ fault }) => fault.tasks.includes(task.name));
  const standby = task.fallback_of !== "";
  const told = Object.entries((settings.local ?? {}) as Record<string, string>);
  return (
    <>
      <section>
        <h3 tabIndex={-1}>
          {task.name} <span className="dim">{String(settings.module ?? task.module)}</span>
        </h3>
        <p>{task.desc}</p>
        {typeof settings.error === "string" && <pre className="warning">{settings.error}</pre>}
      </section>
      {faults.map((one) => (
        <FaultCard key={`${one.number} ${one.fault.text}`} of={one} />
      ))}
      <section className="fields-grid" aria-label="settings">
        <ChoiceField
          label="RTPU"
          at="field rtpu"
          hint="where it runs"
          value={task.rtpu}
          choices={rtpusOf(state, task)}
          set={(value) => set("rtpu", value)}
        />
        {FIRST.map((one) => (
          <SettingField
            key={one.field}
            of={one}
            value={settings[one.field]}
            set={(text) => set(one.field, text)}
          />
        ))}
        <CheckField
          label="CRITICAL"
          at="field critical"
          hint="it runs `stable`, or writes the safe values, while the configuration is illegal"
          value={Boolean(settings.critical)}
          set={(value) => set("critical", value)}
        />
      </section>
      <section>
        <h3>Ports</h3>
        <PortList task={task} ports={task.ins} word="reads" />
        <PortList task={task} ports={task.outs} word="writes" />
      </section>
      <section aria-label="parameters">
        <h3>Parameters</h3>
        {!task.params.length && !told.length && <p className="dim">it has none</p>}
        {task.params.map((one) => (
          <Parameter key={one.name} task={task.name} about={one} />
        ))}
        {!task.params.length &&
          told.map(([name, value]) => (
            <Parameter
              key={name}
              task={task.name}
              about={{
                name,
                value,
                unit: "",
                desc: "as its RMOD says; its module could not be described",
                type: "",
                bounds: "",
                shape: [],
                low: null,
                high: null,
              }}
            />
          ))}
      </section>
      {!standby && <Fallback task={task.name} settings={settings} />}
      <details>
        <summary>More settings</summary>
        <div className="fields-grid">
          {MORE.map((one) => (
            <SettingField
              key={one.field}
              of={one}
              value={settings[one.field]}
              set={(text) => set(one.field, text)}
            />
          ))}
        </div>
      </details>
      <section>
        <TextField
          label="name"
          at="rename"
          value={task.name}
          hint="its RMOD is copied under the new name"
          set={(name) =>
            void assemble.change("rename_task", { task: task.name, name: name.trim() }, "rename")
          }
        />
        <p className="row">
          <button
            type="button"
            className="signal-kill"
            onClick={() => void assemble.change("remove_task", { task: task.name }, "remove")}
          >
            remove {task.name}
          </button>
        </p>
        <Refusal at="remove" />
      </section>
    </>
  );
}

function rtpusOf(state: EditorState, task: TaskInfo): (readonly [string, string])[] {
  const names = state.graph.rtpus.map((one) => one.name);
  return (names.includes(task.rtpu) ? names : [task.rtpu, ...names]).map(
    (one) => [one, one] as const,
  );
}

function PortList({ task, ports, word }: { task: TaskInfo; ports: Port[]; word: string }) {
  if (!ports.length) return null;
  return (
    <ul className="port-list">
      {ports.map((one) => (
        <li key={one.port} title={portTitle(one)}>
          <span className="dim">{word}</span>
          <button
            type="button"
            className="link"
            onClick={() => assemble.choose({ kind: "port", task: task.name, port: one.port })}
          >
            {one.port}
          </button>
          {one.variable !== one.port && (
            <span>
              ={" "}
              <button
                type="button"
                className="link"
                onClick={() => assemble.choose({ kind: "variable", name: one.variable })}
              >
                {one.variable}
              </button>
            </span>
          )}
          <span className="unit">{unitText(one.unit)}</span>
        </li>
      ))}
    </ul>
  );
}

function Parameter({ task, about }: { task: string; about: ParamInfo }) {
  const at = `parameter ${about.name}`,
    unit = unitText(about.unit);
  const set = (value: string | null) =>
    void assemble.change("set_parameter", { task, name: about.name, value }, at);
  const words = choicesOf(/^bool/.test(about.type) ? "bool" : "", about.type);
  const now = textOf(about.value),
    shown = now === "true" ? "yes" : now === "false" ? "no" : now;
  const common = {
    label: <b>{about.name}</b>,
    at,
    hint: about.desc,
    unit: [unit, about.bounds].filter(Boolean).join("  "),
  };
  return (
    <div className="parameter">
      {words.length ? (
        <ChoiceField {...common} value={shown} choices={choices(...words)} set={set} />
      ) : (
        <TextField {...common} value={shown} set={set} />
      )}
      <p className="doc">
        {about.desc}{" "}
        <button
          type="button"
          className="link"
          title="take its LOCAL line out"
          aria-label={`${about.name} as by default`}
          onClick={() => set(null)}
        >
          default
        </button>
      </p>
    </div>
  );
}

function Fallback({ task, settings }: { task: string; settings: Record<string, unknown> }) {
  useAssemble("rmods");
  const fallback = textOf(settings.fallback),
    takeover = Number(settings.takeover ?? 0);
  const set = (name: string, seconds: number) =>
    void assemble.change(
      "set_fallback",
      { task, fallback: name || null, takeover: seconds },
      "fallback",
    );
  return (
    <section className="fields-grid" aria-label="fallback">
      <TextField
        label="FALLBACK"
        at="fallback"
        hint="the RMOD that stands by to take its place when it fails"
        value={fallback}
        words={assemble.rmods}
        placeholder="none"
        set={(text) => set(text.trim(), takeover)}
      />
      {fallback && (
        <TextField
          label="TAKEOVER"
          unit="s"
          at="takeover"
          hint="seconds without the task after which one on another RTPU takes over by itself; 0: only by swap"
          value={String(takeover)}
          set={(text) => set(fallback, Number(text))}
        />
      )}
    </section>
  );
}

/** A port, what fits it, and why the others do not: the way to connect it by keyboard. */
function PortForm({ state, task, port }: { state: EditorState; task: string; port: string }) {
  const [fits, setFits] = useState<Fit[] | null>(null);
  const found = portOf(state.graph, task, port);
  useEffect(() => {
    let isOld = false;
    void assemble.fitting(task, port).then((news) => {
      if (!isOld) setFits(news);
    });
    return () => {
      isOld = true;
    };
  }, [task, port, state]);
  if (!found)
    return (
      <p className="dim">
        {task} has no port {port} any more.
      </p>
    );
  const { port: about, isInput } = found;
  const connected = (one: Fit) => one.variable === about.variable;
  const good = fits?.filter((one) => one.fits) ?? [],
    bad = fits?.filter((one) => !one.fits) ?? [];
  const faults = faultsOf(state).filter(
    ({ fault }) => fault.tasks.includes(task) && fault.ports.includes(port),
  );
  return (
    <>
      <section>
        <h3 tabIndex={-1}>
          {port}{" "}
          <span className="dim">
            {isInput ? "is read by" : "is written by"} {task}
          </span>
        </h3>
        <p className="dim">{portTitle(about)}</p>
        <p>
          It is{" "}
          <button
            type="button"
            className="link"
            onClick={() => assemble.choose({ kind: "variable", name: about.variable })}
          >
            {about.variable}
          </button>
          .{" "}
          <button
            type="button"
            className="link"
            onClick={() => void assemble.change("disconnect", { task, port }, "fits")}
          >
            give it a variable of its own
          </button>
        </p>
        <Refusal at="fits" />
      </section>
      {faults.map((one) => (
        <FaultCard key={`${one.number} ${one.fault.text}`} of={one} />
      ))}
      <section aria-label="what fits">
        <h3>What fits</h3>
        {!fits && <p className="dim">asking…</p>}
        {fits && !good.length && <p className="dim">no port of another task, and no variable</p>}
        <ul className="fits">
          {good.map((one) => (
            <li key={`${one.task} ${one.port} ${one.variable}`}>
              <button
                type="button"
                disabled={connected(one) && one.port !== ""}
                onClick={() => void assemble.connect(task, port, one, "fits")}
              >
                {one.port ? `${one.port} of ${one.task}` : `variable ${one.variable}`}
              </button>
              <span className="dim">
                {connected(one)
                  ? "connected"
                  : one.port && one.variable !== one.port
                    ? one.variable
                    : ""}
              </span>
            </li>
          ))}
        </ul>
      </section>
      {bad.length > 0 && (
        <section aria-label="what does not fit">
          <h3>What does not fit</h3>
          <ul className="fits">
            {bad.map((one) => (
              <li key={`${one.task} ${one.port} ${one.variable}`}>
                <span>{one.port ? `${one.port} of ${one.task}` : `variable ${one.variable}`}</span>
                <span className="dim">{one.reason}</span>
              </li>
            ))}
          </ul>
        </section>
      )}
      <TextField
        label="another variable"
        at="variable"
        value=""
        once
        words={Object.keys(state.table)}
        hint="a variable of the table by its name"
        set={(name) =>
          void assemble.change("connect", { task, port, variable: name.trim() }, "variable")
        }
      />
    </>
  );
}

function VariableForm({ state, name }: { state: EditorState; name: string }) {
  const entry = state.table[name];
  const about = state.graph.variables.find((one) => one.name === name);
  const users = about
    ? [
        ...about.writers.map((one) => [one, "writes it"]),
        ...about.readers.map((one) => [one, "reads it"]),
      ]
    : [];
  const faults = faultsOf(state)
    .filter(({ fault }) => fault.variables.includes(name))
    .map((one) => <FaultCard key={`${one.number} ${one.fault.text}`} of={one} />);
  if (!entry)
    return (
      <>
        <p>The table has no variable {name}.</p>
        {faults}
      </>
    );
  const set = (field: string, text: string) => {
    const at = `field ${field}`;
    try {
      const value = LISTS.has(field)
        ? numbersOf(text)
        : text.trim() === "" && field !== "desc"
          ? null
          : text;
      void assemble.change("set_variable", { name, field, value }, at);
    } catch (error) {
      assemble.refuse({ at, text: error instanceof Error ? error.message : String(error) });
    }
  };
  return (
    <>
      <section>
        <h3 tabIndex={-1}>
          {name} <span className="dim">variable of the table</span>
        </h3>
        {users.length ? (
          <ul className="port-list">
            {users.map(([task, word]) => (
              <li key={`${task} ${word}`}>
                <button
                  type="button"
                  className="link"
                  onClick={() => assemble.choose({ kind: "task", task: task! })}
                >
                  {task}
                </button>
                <span className="dim">{word}</span>
              </li>
            ))}
          </ul>
        ) : (
          <p className="dim">no task of this job uses it</p>
        )}
      </section>
      {faults}
      <section className="fields-grid" aria-label="settings">
        {VARIABLE.map((one) => (
          <SettingField
            key={one.field}
            of={one}
            value={entry[one.field]}
            set={(text) => set(one.field, text)}
          />
        ))}
        <CheckField
          label="FINITE"
          at="field finite"
          hint="NaN and infinities are refused"
          value={entry.finite !== false}
          set={(value) =>
            void assemble.change("set_variable", { name, field: "finite", value }, "field finite")
          }
        />
      </section>
      <section>
        <button
          type="button"
          className="signal-kill"
          disabled={users.length > 0}
          title={users.length ? "tasks use it" : ""}
          onClick={() => void assemble.change("remove_variable", { name }, "remove variable")}
        >
          remove {name}
        </button>
        <Refusal at="remove variable" />
      </section>
    </>
  );
}

function JobForm({ state }: { state: EditorState }) {
  const { about } = state;
  const set = (args: Record<string, unknown>, at: string) =>
    void assemble.change("set_job", args, at);
  const lines = (text: string) =>
    text
      .split("\n")
      .map((one) => one.trim())
      .filter(Boolean);
  return (
    <>
      <section className="fields-column">
        <h3 tabIndex={-1}>
          {about.name} <span className="dim">job</span>
        </h3>
        <TextField
          label="JOB"
          at="job name"
          hint="its name"
          value={about.name}
          set={(name) => set({ name: name.trim() }, "job name")}
        />
        <TextField
          label="DESC"
          at="job desc"
          hint="what it does"
          value={about.desc}
          set={(desc) => set({ desc }, "job desc")}
        />
        <TextField
          label="PRE"
          unit="conditions for its start, one a line"
          at="pre"
          lines={2}
          value={about.pre.join("\n")}
          set={(text) => set({ pre: lines(text) }, "pre")}
        />
        <TextField
          label="POST"
          unit="conditions for leaving it"
          at="post"
          lines={2}
          value={about.post.join("\n")}
          set={(text) => set({ post: lines(text) }, "post")}
        />
      </section>
      <OffOrder state={state} />
      <Names
        title="Variables of the table"
        names={Object.keys(state.table)}
        choose={(name) => assemble.choose({ kind: "variable", name })}
      >
        <NewVariable />
      </Names>
    </>
  );
}

/**
 * The order in which tasks are turned off; none: the reverse of that in which they are turned on.
 */
function OffOrder({ state }: { state: EditorState }) {
  const tasks = state.graph.tasks.filter((one) => !one.fallback_of).map((one) => one.name);
  const order = state.off_order.length
    ? [...state.off_order, ...tasks.filter((one) => !state.off_order.includes(one))]
    : [...tasks].reverse();
  const set = (names: string[]) => void assemble.change("set_off_order", { tasks: names }, "off");
  const move = (k: number, by: number) => {
    const next = [...order];
    next.splice(k + by, 0, ...next.splice(k, 1));
    set(next);
  };
  if (!tasks.length) return null;
  return (
    <section aria-label="order of turning off">
      <h3>
        Tasks, as they are turned OFF{" "}
        {state.off_order.length > 0 && (
          <button type="button" className="link" onClick={() => set([])}>
            reverse of ON
          </button>
        )}
      </h3>
      <ol className="off-order">
        {order.map((name, k) => (
          <li key={name}>
            <button
              type="button"
              className="link"
              onClick={() => assemble.choose({ kind: "task", task: name })}
            >
              {name}
            </button>
            <button
              type="button"
              aria-label={`${name} earlier`}
              disabled={k === 0}
              onClick={() => move(k, -1)}
            >
              ↑
            </button>
            <button
              type="button"
              aria-label={`${name} later`}
              disabled={k === order.length - 1}
              onClick={() => move(k, 1)}
            >
              ↓
            </button>
          </li>
        ))}
      </ol>
      <Refusal at="off" />
    </section>
  );
}

function Names({
  title,
  names,
  choose,
  children,
}: {
  title: string;
  names: string[];
  choose: (name: string) => void;
  children: ReactNode;
}) {
  return (
    <details>
      <summary>
        {title} <span className="dim">{names.length}</span>
      </summary>
      <ul className="names">
        {names.map((one) => (
          <li key={one}>
            <button type="button" className="link" onClick={() => choose(one)}>
              {one}
            </button>
          </li>
        ))}
      </ul>
      {children}
    </details>
  );
}

function NewVariable() {
  const [name, setName] = useState("");
  const add = async () => {
    if (await assemble.change("add_variable", { name: name.trim() }, "add variable")) {
      setName("");
      assemble.choose({ kind: "variable", name: name.trim() });
    }
  };
  return (
    <form
      className="row"
      onSubmit={(event) => {
        event.preventDefault();
        if (name.trim()) void add();
      }}
    >
      <input
        value={name}
        aria-label="name of a new variable"
        placeholder="new variable"
        spellCheck={false}
        size={14}
        onChange={(event) => setName(event.target.value)}
      />
      <button type="submit" disabled={!name.trim()}>
        add
      </button>
      <Refusal at="add variable" />
    </form>
  );
}
