// The cards of the graph: tasks, RTPUs, other subsystems and devices.
import { Handle, Position, useReactFlow, useStore, type NodeProps } from "@xyflow/react";
import { memo, useEffect, useState, type ReactNode } from "react";
import { SignalButtons, StateMark, TaskState } from "./controls";
import { clock, count, field, short, stallText } from "./format";
import {
  inHandle,
  outHandle,
  portRows,
  portTop,
  shiftInto,
  type FrameNode,
  type OtherNode,
  type TaskNode,
} from "./graph_layout";
import { live, stateOf, useGraph, useLive, useRtpu, useTask } from "./live_state";
import { page } from "./page_state";
import type { Port, State, TaskInfo, TaskStatus } from "./protocol";

export const TaskCard = memo(function TaskCard({ data }: NodeProps<TaskNode>) {
  return data.compact ? (
    <SmallCard task={data.task} faulty={data.faulty} />
  ) : (
    <WholeCard task={data.task} faulty={data.faulty} />
  );
});

function SmallCard({ task, faulty }: { task: TaskInfo; faulty: string[] }) {
  const status = useTask(task.name);
  return (
    <article
      className={`card small ${stateClass(task.name)}${useUnheard(task.rtpu)}${faulty.length ? " faulty" : ""}`}
      title={task.desc}
    >
      <header>
        <TaskState task={task.name} word={false} />
        <b className="name">{task.name}</b>
      </header>
      <div className="line live">
        <span className="word">{stateOf(task.name)}</span>
        <span>{rate(status?.fields)}</span>
      </div>
      <Handle type="target" id="in" position={Position.Left} isConnectable={false} />
      <Handle type="source" id="out" position={Position.Right} isConnectable={false} />
      <SideHandles />
    </article>
  );
}

function WholeCard({ task, faulty }: { task: TaskInfo; faulty: string[] }) {
  useTask(task.name);
  return (
    <article className={`card ${stateClass(task.name)}${useUnheard(task.rtpu)}`} title={task.desc}>
      <header>
        <TaskState task={task.name} />
        <b className="name">{task.name}</b>
        <Warnings task={task.name} />
      </header>
      <div className="kind" title={kindLine(task)}>
        {kindLine(task)}
      </div>
      <CardPorts
        task={task}
        row={(one) => (
          <PortName key={one.variable} port={one} faulty={faulty.includes(one.variable)} />
        )}
      />
      <SideHandles />
      <Figures task={task.name} />
      <SignalButtons task={task.name} place={useInSight()} />
      <Notes task={task.name} />
    </article>
  );
}

/** Moves the drawing, when a message of a card has come, until all of it can be read. */
function useInSight(): (message: HTMLElement | null) => void {
  const flow = useReactFlow();
  const [message, setMessage] = useState<HTMLElement | null>(null);
  const width = useStore((state) => state.width),
    height = useStore((state) => state.height);
  useEffect(() => {
    const area = message?.closest(".react-flow");
    if (!message || !area) return undefined;
    // Where bars above come with the message, the drawing is fitted again first.
    const timer = setTimeout(() => {
      const [x, y] = shiftInto(message.getBoundingClientRect(), area.getBoundingClientRect());
      const view = flow.getViewport();
      if (x || y) void flow.setViewport({ ...view, x: view.x + x, y: view.y + y });
    }, 100);
    return () => clearTimeout(timer);
  }, [message, width, height, flow]);
  return setMessage;
}

export function SideHandles() {
  return (
    <>
      <Handle
        type="target"
        id="device"
        position={Position.Left}
        isConnectable={false}
        style={{ top: 20 }}
        className="hidden"
      />
      <Handle
        type="source"
        id="device-out"
        position={Position.Right}
        isConnectable={false}
        style={{ top: 20 }}
        className="hidden"
      />
      <Handle
        type="source"
        id="fallback-out"
        position={Position.Top}
        isConnectable={false}
        style={{ left: "65%" }}
        className="hidden"
      />
      <Handle
        type="target"
        id="fallback-in"
        position={Position.Top}
        isConnectable={false}
        style={{ left: "35%" }}
        className="hidden"
      />
    </>
  );
}

/** Returns the class of what is old because its RTPU does not answer. */
export const useUnheard = (rtpu: string): string => (useRtpu(rtpu)?.silent ? " unheard" : "");
const stateClass = (task: string): string =>
  `is-${stateOf(task).toLowerCase().replace("?", "unknown")}`;
/** What a task is: its module, class, type and frequency. */
export const kindLine = (task: TaskInfo): string =>
  [
    task.module !== task.name && task.module,
    task.parts.length > 0 && task.parts.join(" + "),
    task.class,
    kindOf(task),
  ]
    .filter(Boolean)
    .join(" · ");
const kindOf = (task: TaskInfo): string =>
  task.freq ? `${task.type} ${short(task.freq)} Hz` : task.type;
function rate(fields: Record<string, unknown> | undefined): string {
  if (!fields || typeof fields.mezF !== "number") return "";
  return typeof fields.refF === "number"
    ? `${short(fields.mezF)} / ${short(fields.refF)} Hz`
    : `${short(fields.mezF)} Hz`;
}

/** A port in words: its name, its variable, unit, type and size. */
export const portTitle = (port: Port): string =>
  `${port.port}${port.port === port.variable ? "" : ` stands for ${port.variable}`} [${port.unit}], ${port.type} ${port.shape.join("×")}${port.constant ? ", a constant" : ""}`;

function PortName({ port, faulty }: { port: Port; faulty: boolean }) {
  const faults = faulty
    ? live.graph?.faults.filter(
        (one) =>
          one.variables.includes(port.variable) ||
          one.ports.some((each) => each.endsWith(port.port)),
      )
    : undefined;
  const about = faults?.map((one) => `${one.text}\n${one.remedy}`).join("\n");
  return (
    <li
      className={`${port.constant ? "constant" : ""}${faulty ? " faulty" : ""}`}
      title={about ?? portTitle(port)}
      onMouseEnter={() => page.hover(port.variable)}
      onMouseLeave={() => page.hover("")}
      onClick={() => page.pin(port.variable)}
    >
      {faulty && (
        <span className="fault-sign" role="img" aria-label="fault">
          !
        </span>
      )}
      {port.variable}
    </li>
  );
}

function Warnings({ task }: { task: string }) {
  const status = useTask(task);
  if (!status?.warning) return null;
  const count = status.fields.warn;
  return (
    <span
      className="warn-sign"
      role="img"
      aria-label={`warning: ${status.warning}`}
      title={status.warning}
    >
      ⚠{typeof count === "number" && count > 1 ? ` ${count}` : ""}
    </span>
  );
}

const NOT_IN_LOG = "the log does not hold it for this time";

/** Hz measured and wanted, CPU, misses and failures. */
function Figures({ task }: { task: string }) {
  const status = useTask(task);
  const fields = status?.fields;
  if (!fields || status.state === "NOT-CREATED") return <div className="figures" />;
  const counted = (name: string, word: string, bad: boolean) => {
    const value = fields[name];
    if (value === null && live.log) return <span title={NOT_IN_LOG}>– {word}</span>;
    return typeof value === "number" ? (
      <span className={bad && value ? "bad" : ""} title={`${value} ${word}`}>
        <b>{count(value)}</b> {word}
      </span>
    ) : null;
  };
  return (
    <div className="figures live">
      <div>
        <span className="rate">{rate(fields) || "–"}</span>
        <span title={live.log && fields.avgU === null ? NOT_IN_LOG : undefined}>
          CPU {field(fields.avgU, "%")}
        </span>
      </div>
      <div>
        {counted("cycle", "cycles", false)}
        {counted("miss", "missed", true)}
        {counted("failed", "failed", true)}
      </div>
    </div>
  );
}

/** What there is to say of a task, each with its kind. */
export function notesOf(status: TaskStatus): [string, string][] {
  const standby =
    status.fallback_of &&
    `${status.standby ? "stands by for" : "the fallback of"} ${status.fallback_of}`;
  const notes: [string, string][] = [
    ["error", status.error],
    ["warning", status.warning],
    ["waits", status.waits],
    ["standby", standby],
    ["restarted", status.restarted],
  ];
  return notes.filter(([, text]) => text);
}

/**
 * Returns why a task of the job does not exist, and what was told of it last; empty: it does, or
 * no task does.
 */
export function missingNote(task: string): string {
  const lacks = live.tasks.size > 0 && !live.tasks.has(task);
  const reason = lacks ? (live.graph?.missing?.[task] ?? "") : "";
  const last = reason && live.events.findLast((one) => one.task === task);
  return last ? `${reason}; last: ${clock(last.t, 0)} ${last.code} ${last.text}` : reason;
}

/** Errors and warnings in full, below the card; of a task that does not exist, why. */
function Notes({ task }: { task: string }) {
  const status = useTask(task);
  useGraph();
  const there: [string, string][] = status ? notesOf(status) : [];
  const missing = missingNote(task);
  if (missing) there.push(["missing", missing]);
  if (!there.length) return null;
  return (
    <div className="notes live">
      {there.map(([kind, text]) => (
        <p key={kind} className={`note note-${kind}`}>
          <b>{kind}</b> {text}
        </p>
      ))}
    </div>
  );
}

/** The ports of a card, inputs left and outputs right, with the ends of their wires. */
export function CardPorts({
  task,
  row,
  connectable = false,
}: {
  task: TaskInfo;
  row: (port: Port) => ReactNode;
  connectable?: boolean;
}) {
  const { ins, outs } = portRows(task);
  const handle = (one: Port, k: number, side: "in" | "out") => (
    <Handle
      key={one.variable}
      type={side === "in" ? "target" : "source"}
      id={(side === "in" ? inHandle : outHandle)(one.variable)}
      position={side === "in" ? Position.Left : Position.Right}
      isConnectable={connectable}
      style={{ top: portTop(k) }}
      className={one.constant ? "constant" : ""}
    />
  );
  return (
    <>
      <div className="ports" style={{ height: Math.max(ins.length, outs.length, 1) * 22 }}>
        <ul>{ins.map(row)}</ul>
        <ul className="right">{outs.map(row)}</ul>
      </div>
      {ins.map((one, k) => handle(one, k, "in"))}
      {outs.map((one, k) => handle(one, k, "out"))}
    </>
  );
}

export const FrameCard = memo(function FrameCard({ data }: NodeProps<FrameNode>) {
  const status = useRtpu(data.rtpu);
  const stall = stallText(status?.stalls ?? 0, status?.stall_age);
  const load = status?.load === undefined ? null : Math.round(status.load * 100);
  return (
    <section
      className={`frame${data.folded ? " folded" : ""}${status?.silent ? " silent" : ""}${status?.illegal.length ? " illegal" : ""}`}
    >
      <header className="nodrag">
        <button
          type="button"
          className="fold nopan"
          aria-expanded={!data.folded}
          title={data.folded ? "show its tasks" : "fold its tasks into one card"}
          aria-label={`${data.folded ? "unfold" : "fold"} ${data.rtpu}`}
          onClick={() => page.fold(data.rtpu)}
        >
          {data.folded ? "▸" : "▾"}
        </button>
        <b>{data.rtpu}</b>
        <span className="dim" title={data.keeper ? "it keeps the table of variables" : undefined}>
          {[status?.scheduler, status?.backend, data.keeper && "table"].filter(Boolean).join(" · ")}
        </span>
        {load !== null && (
          <span
            className="load live"
            title="share of the core that its tasks took over the last second"
          >
            <i style={{ width: `${Math.min(100, load)}%` }} />
            {load} %
          </span>
        )}
        {status?.silent && <span className="badge bad">does not answer</span>}
        {stall && (
          <span
            className={`badge ${status?.stall_age === 0 ? "bad" : "warn"}`}
            title={stall}
            role="img"
            aria-label={stall}
          >
            ❚❚ {status?.stalls}×
          </span>
        )}
      </header>
      {data.folded && <Counts tasks={data.tasks} />}
      <HiddenHandles />
    </section>
  );
});

/** The ends of wires at a card on which none can be drawn. */
function HiddenHandles() {
  return (
    <>
      <Handle
        type="target"
        id="in"
        position={Position.Left}
        isConnectable={false}
        className="hidden"
      />
      <Handle
        type="source"
        id="out"
        position={Position.Right}
        isConnectable={false}
        className="hidden"
      />
    </>
  );
}

/** How many tasks of a folded RTPU are in which state. */
function Counts({ tasks }: { tasks: string[] }) {
  useLive("status");
  const states: State[] = ["ON", "OFF", "ERROR", "NOT-CREATED"];
  return (
    <p className="counts live">
      {states.map((state) => {
        const count = tasks.filter((one) => stateOf(one) === state).length;
        return count ? (
          <span key={state}>
            <StateMark state={state} word={false} /> {count} {state}
          </span>
        ) : null;
      })}
    </p>
  );
}

export const OtherCard = memo(function OtherCard({ data }: NodeProps<OtherNode>) {
  return (
    <div className={`other other-${data.what}`}>
      <small>{data.what}</small>
      <b>{data.name}</b>
      <HiddenHandles />
    </div>
  );
});
