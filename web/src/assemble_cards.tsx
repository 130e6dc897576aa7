// The cards of tasks and RTPUs of the job that is edited.
import type { NodeProps } from "@xyflow/react";
import { memo } from "react";
import { seconds, short } from "./format";
import type { FrameNode, TaskNode } from "./graph_layout";
import { CardPorts, SideHandles, kindLine, portTitle } from "./node_cards";
import type { Port, TaskInfo } from "./protocol";
import { assemble, useAssemble, useEditor } from "./assemble_state";
import { barOf, faultHead, faultsOf, misfit } from "./assemble_words";

export const DraftCard = memo(function DraftCard({ data }: NodeProps<TaskNode>) {
  const { task, faulty } = data;
  const state = useEditor();
  if (!state) return null;
  const settings = state.settings[task.name] ?? {};
  const faults = faultsOf(state).filter(({ fault }) => fault.tasks.includes(task.name));
  const isWrong = faults.some(({ fault }) => fault.severity !== "warn");
  return (
    <article className={`card draft${isWrong ? " wrong" : ""}`} title={task.desc}>
      <header>
        <b className="name">{task.name}</b>
        {Boolean(settings.critical) && (
          <span className="badge" title="it runs `stable` while the configuration is illegal">
            CRITICAL
          </span>
        )}
      </header>
      <div className="kind">{kindLine(task)}</div>
      <CardPorts
        task={task}
        connectable
        row={(one) => (
          <DraftPort
            key={one.variable}
            task={task}
            port={one}
            faulty={faulty.includes(one.variable)}
          />
        )}
      />
      <SideHandles />
      <Load task={task} restart={String(settings.restart ?? "")} />
      {faults.length > 0 && (
        <div className="notes">
          {faults.slice(0, 2).map(({ number, fault }) => (
            <button
              key={number}
              type="button"
              className={`note note-${fault.severity === "warn" ? "warning" : "error"} nodrag`}
              title={fault.text}
              onClick={showFaults}
            >
              {faultHead(fault.text)}
            </button>
          ))}
          {faults.length > 2 && (
            <button type="button" className="note note-error nodrag" onClick={showFaults}>
              {faults.length - 2} more
            </button>
          )}
        </div>
      )}
    </article>
  );
});

/** Shows the faults, and leaves the card unselected. */
function showFaults(event: React.MouseEvent): void {
  event.stopPropagation();
  assemble.show("Faults");
}

/** A port: a button that shows what fits; while another is dragged, it is lit if it fits. */
function DraftPort({ task, port, faulty }: { task: TaskInfo; port: Port; faulty: boolean }) {
  useAssemble("connecting");
  useAssemble("chosen");
  const from = assemble.connecting,
    graph = assemble.state!.graph;
  const reason = from ? misfit(graph, from, task.name, port.port) : "";
  const isOwn = from !== null && from.task === task.name && from.port === port.port;
  const isKnown = from !== null && from.fits.length > 0;
  const chosen = assemble.chosen;
  const isChosen = chosen.kind === "port" && chosen.task === task.name && chosen.port === port.port;
  const look = [
    port.constant && "constant",
    faulty && "faulty",
    isChosen && "picked",
    isKnown && !isOwn && (reason ? "misfit" : "fits"),
  ]
    .filter(Boolean)
    .join(" ");
  const over = reason
    ? `${port.port} of ${task.name}: ${reason}`
    : `connect it with ${port.port} of ${task.name}`;
  return (
    <li
      className={look}
      data-task={task.name}
      data-port={port.port}
      title={reason || portTitle(port)}
      onPointerEnter={() => {
        if (isKnown && !isOwn) assemble.hover(over);
      }}
      onPointerLeave={() => assemble.hover("")}
    >
      <button
        type="button"
        className="nodrag"
        aria-label={`port ${port.port} of ${task.name}${faulty ? ", at fault" : ""}`}
        onKeyDown={(event) => event.stopPropagation()}
        onClick={(event) => {
          event.stopPropagation();
          assemble.choose({ kind: "port", task: task.name, port: port.port });
        }}
      >
        {faulty && (
          <span className="fault-sign" role="img" aria-label="fault">
            !
          </span>
        )}
        {port.variable}
      </button>
    </li>
  );
}

/** How much of its RTPU a task takes, as the analysis knows it. */
function Load({ task, restart }: { task: TaskInfo; restart: string }) {
  const about = assemble.state?.timing.find((one) => one.rtpu === task.rtpu);
  const load = about?.tasks.find((one) => one.task === task.name);
  const isUnknown = about?.unknown.includes(task.name) ?? false,
    isLate = about?.late.includes(task.name) ?? false;
  return (
    <div className="figures">
      <div>
        <span className="rate">{task.freq ? `${short(task.freq)} Hz` : task.type}</span>
        <span>
          {isUnknown || !load
            ? "MAXC unknown"
            : `${short((load.utilization ?? 0) * 100)} % of ${task.rtpu}`}
        </span>
      </div>
      <div>
        {isLate ? (
          <span className="bad">
            <b>may be late</b>
          </span>
        ) : (
          <span>{load && !isUnknown ? `MAXC ${seconds(load.maxc)} (${load.source})` : ""}</span>
        )}
        <span>
          {task.fallback_of
            ? `stands by for ${task.fallback_of}`
            : restart && restart !== "off"
              ? `RESTART ${restart}`
              : ""}
        </span>
      </div>
    </div>
  );
}

export const DraftFrame = memo(function DraftFrame({ data }: NodeProps<FrameNode>) {
  const state = useEditor();
  const about = state?.timing.find((one) => one.rtpu === data.rtpu);
  const scheduler = state?.graph.rtpus.find((one) => one.name === data.rtpu)?.scheduler;
  const bar = about ? barOf(about) : null;
  return (
    <section className={`frame${data.tasks.length ? "" : " folded vacant"}`}>
      <header className="nodrag">
        <b>{data.rtpu}</b>
        <span className="dim">
          {[scheduler, data.keeper && "table"].filter(Boolean).join(" · ")}
        </span>
        {about && bar && about.utilization !== null && (
          <span className={`load${bar.over ? " over" : ""}`} title={about.text}>
            <i style={{ width: `${bar.filled}%` }} />
            {about.unknown.length ? "≥ " : ""}
            {short(about.utilization * 100)} %
          </span>
        )}
      </header>
      {!data.tasks.length && <p className="dim">no task runs here</p>}
    </section>
  );
});
