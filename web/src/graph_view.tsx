// The graph: frames, wires and their labels, and the variable that is looked at.
import {
  Background,
  BackgroundVariant,
  BaseEdge,
  Controls,
  EdgeLabelRenderer,
  MiniMap,
  ReactFlow,
  ReactFlowProvider,
  applyNodeChanges,
  useReactFlow,
  useStore,
  type EdgeProps,
  type NodeChange,
} from "@xyflow/react";
import { memo, useCallback, useEffect, useMemo, useRef, useState } from "react";
import { Outcome, Why, commandHelp, useClock, useCommand } from "./controls";
import { want } from "./connection";
import { clock, number, seconds, unitText } from "./format";
import {
  canDraw,
  drawing,
  keepEqual,
  layoutLoaded,
  refit,
  shouldCompact,
  taskId,
  wirePath,
  type AnyNode,
  type Drawing,
  type WireEdge,
} from "./graph_layout";
import { live, stateOf, useGraph, useLive, useStale, useValue } from "./live_state";
import { FrameCard, OtherCard, TaskCard } from "./node_cards";
import { page, usePage } from "./page_state";
import { parseSeries } from "./series";

const FAR = 0.42;
/** Room around the drawing; the buttons of the graph stand above it. */
const PADDING = { top: "52px", x: 0.05, bottom: 0.05 } as const;
const EMPTY: Drawing = { nodes: [], edges: [] };
const NODE_TYPES = { task: TaskCard, frame: FrameCard, other: OtherCard };
const EDGE_TYPES = { wire: memo(Wire) };

/** How many labels of a variable are mounted, to watch only what is visible. */
const labels = new Map<string, number>();
let labelsTold: ReturnType<typeof setTimeout> | null = null;
function countLabel(variable: string, by: 1 | -1): void {
  const count = (labels.get(variable) ?? 0) + by;
  if (count) labels.set(variable, count);
  else labels.delete(variable);
  labelsTold ??= setTimeout(() => {
    labelsTold = null;
    want("graph", [...labels.keys()]);
  }, 120);
}

/** Returns whether a task of a node exists; a frame has some that do. */
const isThere = (node: string): boolean =>
  !node.startsWith(taskId("")) || stateOf(node.slice(taskId("").length)) !== "NOT-CREATED";

function Wire(props: EdgeProps<WireEdge>) {
  const data = props.data!;
  const first = data.variables[0] ?? "";
  const isOld = useStale(data.kind === "constant" ? "" : first);
  const stale = isOld && (isThere(props.source) || isThere(props.target));
  return (
    <WireLine wire={props} look={stale ? "stale" : ""}>
      {data.labelled && (
        <WireLabel
          variables={data.variables}
          only={<VariableLabel name={first} constant={data.kind === "constant"} />}
        />
      )}
    </WireLine>
  );
}

/** A wire as a line, and its label in the middle. */
export function WireLine({
  wire,
  look,
  children,
}: {
  wire: EdgeProps<WireEdge>;
  look: string;
  children: React.ReactNode;
}) {
  const { kind, points } = wire.data!;
  const [path, x, y] =
    kind === "fallback"
      ? archPath(wire)
      : wirePath([wire.sourceX, wire.sourceY], points, [wire.targetX, wire.targetY]);
  const far = useStore((state) => state.transform[2] < FAR);
  const place = { transform: `translate(-50%,-50%) translate(${x}px,${y}px)` };
  return (
    <>
      <BaseEdge
        id={wire.id}
        path={path}
        markerEnd={kind === "device" ? undefined : "url(#arrow)"}
        interactionWidth={14}
        className={`wire wire-${kind} ${look}${wire.selected ? " chosen" : ""}`}
      />
      {children && !far && (
        <EdgeLabelRenderer>
          <div className={`wire-label wire-label-${kind} nodrag nopan`} style={place}>
            {kind === "fallback" ? "fallback of" : children}
          </div>
        </EdgeLabelRenderer>
      )}
    </>
  );
}

/** The label of a wire: that of its only variable, or how many it has. */
export function WireLabel({ variables, only }: { variables: string[]; only: React.ReactNode }) {
  return variables.length > 1 ? `${variables.length} variables` : variables.length ? only : null;
}

/** The arrow at the ends of wires. */
export function Markers() {
  return (
    <svg className="markers" aria-hidden="true">
      <defs>
        <marker
          id="arrow"
          viewBox="0 0 10 10"
          refX="9"
          refY="5"
          markerWidth="11"
          markerHeight="11"
          markerUnits="userSpaceOnUse"
          orient="auto"
        >
          <path d="M0 1 9 5 0 9Z" />
        </marker>
      </defs>
    </svg>
  );
}

function archPath({ sourceX, sourceY, targetX, targetY }: EdgeProps): [string, number, number] {
  const top = Math.min(sourceY, targetY) - 46;
  return [
    `M${sourceX},${sourceY}C${sourceX},${top} ${targetX},${top} ${targetX},${targetY}`,
    (sourceX + targetX) / 2,
    top + 11,
  ];
}

function VariableLabel({ name, constant }: { name: string; constant: boolean }) {
  useEffect(() => {
    if (constant) return undefined;
    countLabel(name, 1);
    return () => countLabel(name, -1);
  }, [name, constant]);
  return (
    <button
      type="button"
      tabIndex={-1}
      onMouseEnter={() => page.hover(name)}
      onMouseLeave={() => page.hover("")}
      onClick={() => page.pin(name)}
      title={live.variables.get(name)?.desc ?? name}
    >
      {name}
      {!constant && <Age name={name} />}
    </button>
  );
}

/** How old a value is, and whether it is stale. */
export function Age({ name }: { name: string }) {
  const value = useValue(name);
  useClock();
  if (!value) return live.log ? <span className="age">not in the log</span> : null;
  if (value.t === null) return <span className="age live">never written</span>;
  if (live.link !== "live") return <span className="age">old</span>;
  const age = Math.max(0, live.now() - value.t);
  return (
    <span className={`age live${value.stale ? " stale" : ""}`}>
      {value.stale ? "stale " : ""}
      {age < 0.1 ? "now" : age < 100 ? `${age.toFixed(1)} s` : seconds(age)}
    </span>
  );
}

/** The values of the variable under the mouse, or of the one that was clicked. */
function Inspector() {
  usePage("inspected");
  const name = page.inspected;
  const value = useValue(name);
  const about = live.variables.get(name);
  if (!about) return null;
  const unit = unitText(about.unit);
  return (
    <section className="inspector" aria-label={`variable ${name}`}>
      <header>
        <b>{name}</b>
        {unit && <span className="unit">{unit}</span>}
        {page.pinned === name && (
          <button type="button" className="close" aria-label="close" onClick={() => page.pin(name)}>
            ×
          </button>
        )}
      </header>
      <p>{about.desc}</p>
      <ol className="elements live" start={0}>
        {(value?.v ?? []).slice(0, 36).map((one, k) => (
          <li key={k}>
            <span>{k}</span>
            {number(one)}
          </li>
        ))}
        {about.n > 36 && <li>… {about.n} in all</li>}
      </ol>
      {!value && (
        <p className="dim">
          {live.log ? "this log holds no values of it" : "no value has come yet"}
        </p>
      )}
      <p className="dim">
        {value?.writer
          ? `written by ${value.writer}`
          : about.writers.length
            ? `${about.writers.join(", ")} can write it`
            : "no task writes it"}
        {about.readers.length ? `, read by ${about.readers.join(", ")}` : ""}
        {value && value.t !== null && (
          <>
            {" "}
            · {clock(value.t)} · <Age name={name} />
          </>
        )}
      </p>
      <button type="button" onClick={() => page.addSeries(parseSeries(name, live.variables))}>
        plot
      </button>
      {page.pinned === name && <Why key={name} what={[name]} />}
    </section>
  );
}

/** Returns whether graphs can be drawn already, and draws again when they can. */
export function useLayout(): boolean {
  const [isLoaded, setLoaded] = useState(canDraw);
  useEffect(() => void layoutLoaded.then(() => setLoaded(true)), []);
  return isLoaded;
}

function Flow() {
  const graph = useGraph();
  const choice = usePage("drawing");
  usePage("selected");
  const role = useLive("hello");
  const flow = useReactFlow<AnyNode, WireEdge>();
  const isLoaded = useLayout();
  const compact = page.compact ?? (graph ? shouldCompact(graph) : false);
  const last = useRef<Drawing>(EMPTY);
  const made = useMemo<Drawing>(
    () =>
      (last.current =
        graph && isLoaded
          ? keepEqual(
              last.current,
              drawing(graph, { compact, folded: page.folded, operator: live.steers }),
            )
          : EMPTY),
    [graph, isLoaded, compact, choice, role], // `choice` and `role` stand for what is outside of React
  );
  const [now, setNow] = useState(made);
  const shape = made.nodes.map((one) => one.id).join("\n"),
    moved = useRef(false);
  const places = useRef({ of: "", at: new Map<string, { x: number; y: number }>() });
  useEffect(() => {
    // What was moved by hand stays there until cards come or go.
    const of = `${shape} ${compact}`;
    if (places.current.of !== of) places.current = { of, at: new Map() };
    const { at } = places.current;
    setNow(
      at.size
        ? refit(
            made.nodes.map((one) => ({ ...one, position: at.get(one.id) ?? one.position })),
            made.edges,
          )
        : made,
    );
  }, [made, shape, compact]);
  const width = useStore((state) => state.width),
    height = useStore((state) => state.height);
  // What is on the screen, after the new drawing has come
  const drawn = now.nodes.map((one) => one.id).join("\n");
  useEffect(() => {
    moved.current = false;
  }, [drawn, compact]);
  useEffect(() => {
    if (drawn && !moved.current)
      requestAnimationFrame(
        () => void flow.fitView({ padding: PADDING, maxZoom: 1.05, minZoom: 0.08 }),
      );
  }, [drawn, compact, flow, width, height]);

  const selected = page.selected;
  const nodes = useMemo(() => {
    const chosen = new Set(selected.map(taskId));
    return now.nodes.map((one) =>
      one.type === "task" && Boolean(one.selected) !== chosen.has(one.id)
        ? { ...one, selected: chosen.has(one.id) }
        : one,
    );
  }, [now.nodes, selected]);

  const edges = useMemo(() => {
    const chosen = new Set(selected.map(taskId));
    return chosen.size
      ? now.edges.map((one) =>
          chosen.has(one.source) || chosen.has(one.target) ? { ...one, selected: true } : one,
        )
      : now.edges;
  }, [now.edges, selected]);

  const changed = useCallback((changes: NodeChange<AnyNode>[]) => {
    const moves = changes.filter((one) => one.type === "position" || one.type === "dimensions");
    if (moves.length)
      setNow((before) => ({ ...before, nodes: applyNodeChanges(moves, before.nodes) }));
    const picks = changes.filter((one) => one.type === "select");
    if (!picks.length) return;
    const kept = new Set(page.selected);
    for (const one of picks) {
      const name = one.id.replace(/^task /, "");
      if (one.selected) kept.add(name);
      else kept.delete(name);
    }
    page.select([...kept]);
  }, []);

  return (
    <ReactFlow<AnyNode, WireEdge>
      nodes={nodes}
      edges={edges}
      nodeTypes={NODE_TYPES}
      edgeTypes={EDGE_TYPES}
      onNodesChange={changed}
      onMoveStart={(event) => {
        if (event) moved.current = true;
      }}
      onNodeDragStop={(_, node) => {
        places.current.at.set(node.id, node.position);
        setNow((before) => refit(before.nodes, before.edges));
      }}
      onNodeDoubleClick={(_, node) => {
        if (node.type === "task") page.openTask(node.data.task.name);
      }}
      onEdgeMouseEnter={(_, edge) => page.hover(edge.data!.variables[0] ?? "")}
      onEdgeMouseLeave={() => page.hover("")}
      onEdgeClick={(_, edge) => {
        const name = edge.data!.variables[0];
        if (name) page.pin(name);
      }}
      onlyRenderVisibleElements
      nodesConnectable={false}
      deleteKeyCode={null}
      minZoom={0.08}
      maxZoom={2.5}
      colorMode="system"
      proOptions={{ hideAttribution: true }}
      elevateNodesOnSelect={false}
      multiSelectionKeyCode={["Meta", "Control", "Shift"]}
      selectionKeyCode={null}
      zoomOnDoubleClick={false}
    >
      <Markers />
      <Background variant={BackgroundVariant.Dots} gap={22} size={1} />
      <Controls showInteractive={false} />
      {made.nodes.length > 30 && (
        <MiniMap<AnyNode>
          pannable
          zoomable
          nodeClassName={(node) => `mini-${node.type ?? ""}`}
          ariaLabel="map of the graph"
        />
      )}
    </ReactFlow>
  );
}

/** Sets a class when the drawing is so small that its small words cannot be read. */
function Frame() {
  const far = useStore((state) => state.transform[2] < FAR);
  const graph = useGraph();
  usePage("drawing");
  const compact = page.compact ?? (graph ? shouldCompact(graph) : false);
  return (
    <section
      className={`graph${far ? " far" : ""}${compact ? " many" : ""}`}
      aria-label="graph of tasks and variables"
    >
      <Flow />
      <div className="graph-tools">
        <button
          type="button"
          aria-pressed={compact}
          onClick={() => page.setCompact(!compact)}
          title="show tasks without their ports"
        >
          compact
        </button>
        <Legend />
        <StartJob />
      </div>
      {graph && !graph.tasks.length && (
        <p className="empty">No task exists yet. Create one with “spawn”, or start a job.</p>
      )}
      {!graph && (
        <p className="empty">{live.hello ? "waiting for the graph" : "connecting to the server"}</p>
      )}
      <Inspector />
    </section>
  );
}

/** Starts the job of this page where none of its tasks exists. */
function StartJob() {
  useLive("status");
  useLive("hello");
  const running = useCommand();
  const job = live.hello?.job ?? "";
  if (!live.steers || !job || (live.tasks.size > 0 && !running.busy && !running.answer))
    return null;
  return (
    <div className="start-job">
      {live.tasks.size === 0 && (
        <button
          type="button"
          className="primary"
          title={commandHelp("start")}
          disabled={running.busy || live.link !== "live"}
          onClick={() => void running.run("start", {})}
        >
          start job {job}
        </button>
      )}
      <Outcome of={running} />
    </div>
  );
}

function Legend() {
  return (
    <details className="legend">
      <summary>legend</summary>
      <ul>
        {(
          [
            ["variable", "variable"],
            ["constant", "constant"],
            ["link", "link to another subsystem"],
            ["device", "device"],
            ["fallback", "fallback of a task"],
          ] as const
        ).map(([kind, text]) => (
          <li key={kind}>
            <svg viewBox="0 0 40 8" aria-hidden="true">
              <path className={`wire wire-${kind}`} d="M0 4H40" />
            </svg>
            {text}
          </li>
        ))}
        <li>
          <svg viewBox="0 0 40 8" aria-hidden="true">
            <path className="wire stale" d="M0 4H40" />
          </svg>
          stale: not written within its MAXAGE
        </li>
        <li>
          double click, or Enter on a selected task: its details; Ctrl and click: select several
        </li>
      </ul>
    </details>
  );
}

export function GraphView() {
  return (
    <ReactFlowProvider>
      <Frame />
    </ReactFlowProvider>
  );
}
