// The canvas: the graph of the job that is edited, where modules are dropped and ports connected.
import {
  Background,
  BackgroundVariant,
  Controls,
  ReactFlow,
  ReactFlowProvider,
  applyNodeChanges,
  useReactFlow,
  useStore,
  type EdgeProps,
  type NodeChange,
  type OnConnectEnd,
  type OnConnectStart,
} from "@xyflow/react";
import { memo, useCallback, useEffect, useMemo, useRef, useState } from "react";
import {
  drawing,
  keepEqual,
  refit,
  shouldCompact,
  taskId,
  type AnyNode,
  type Drawing,
  type FrameNode,
  type WireEdge,
} from "./graph_layout";
import { Markers, WireLabel, WireLine, useLayout } from "./graph_view";
import { OtherCard } from "./node_cards";
import { DraftCard, DraftFrame } from "./assemble_cards";
import { DRAGGED } from "./assemble_palette";
import { Refusal } from "./assemble_fields";
import { assemble, useAssemble, useEditor } from "./assemble_state";

const NODE_TYPES = { task: DraftCard, frame: DraftFrame, other: OtherCard };
const EDGE_TYPES = { wire: memo(DraftWire) };
const NONE: ReadonlySet<string> = new Set();

function DraftWire(props: EdgeProps<WireEdge>) {
  useAssemble("chosen");
  const { variables, kind, labelled } = props.data!;
  const name = variables[0] ?? "";
  const ends = [props.source, props.target];
  const isChosen = assemble.chosen.kind === "variable" && variables.includes(assemble.chosen.name);
  const isNear = assemble.task !== "" && ends.includes(taskId(assemble.task));
  return (
    <WireLine wire={props} look={isChosen ? "chosen" : isNear ? "near" : ""}>
      {labelled && (
        <WireLabel
          variables={variables}
          only={
            <button
              type="button"
              tabIndex={-1}
              title={`the variable ${name}${kind === "constant" ? ", a constant" : ""}`}
              onClick={() => assemble.choose({ kind: "variable", name })}
            >
              {name}
            </button>
          }
        />
      )}
    </WireLine>
  );
}

/** Returns the RTPU in whose frame a place of the drawing is. */
function rtpuAt(nodes: AnyNode[], x: number, y: number): string | null {
  const frames = nodes.filter((one): one is FrameNode => one.type === "frame");
  const found = frames.find(
    (one) =>
      x >= one.position.x &&
      y >= one.position.y &&
      x <= one.position.x + one.width! &&
      y <= one.position.y + one.height!,
  );
  return found?.data.rtpu ?? null;
}

/** Returns what the mouse was let go over: a port of a task, or a variable alone. */
function endOf(
  event: MouseEvent | TouchEvent,
): { task: string; port: string; variable: string } | null {
  const at = "changedTouches" in event ? event.changedTouches[0]! : event;
  const found = document
    .elementsFromPoint(at.clientX, at.clientY)
    .map((one) => one.closest<HTMLElement>("[data-port],[data-variable]"))
    .find(Boolean);
  return found
    ? {
        task: found.dataset.task ?? "",
        port: found.dataset.port ?? "",
        variable: found.dataset.variable ?? "",
      }
    : null;
}

function Flow() {
  const state = useEditor();
  useAssemble("chosen");
  const graph = state?.graph ?? null;
  const flow = useReactFlow<AnyNode, WireEdge>();
  const isLoaded = useLayout();
  const last = useRef<Drawing>({ nodes: [], edges: [] });
  const made = useMemo<Drawing>(
    () =>
      (last.current =
        graph && isLoaded
          ? keepEqual(
              last.current,
              drawing(graph, { compact: false, folded: NONE, operator: false, empty: true }),
            )
          : { nodes: [], edges: [] }),
    [graph, isLoaded],
  );
  const [now, setNow] = useState(made);
  const places = useRef(new Map<string, { x: number; y: number }>());
  const tasks = graph?.tasks.map((one) => one.name).join("\n") ?? "";
  useEffect(() => {
    // What was moved by hand stays there until tasks come or go.
    const moved = made.nodes.map((one) =>
      places.current.has(one.id) ? { ...one, position: places.current.get(one.id)! } : one,
    );
    setNow(places.current.size ? refit(moved, made.edges) : made);
  }, [made]);
  const width = useStore((store) => store.width),
    height = useStore((store) => store.height);
  useEffect(() => {
    places.current.clear();
    requestAnimationFrame(
      () =>
        void flow.fitView({
          padding: { top: 0.05, left: 0.06, right: 0.06, bottom: 0.16 },
          maxZoom: 1.05,
          minZoom: 0.08,
        }),
    );
  }, [tasks, flow, width, height]);

  const nodes = useMemo(
    () =>
      now.nodes.map((one) => {
        const isChosen = one.type === "task" && one.id === taskId(assemble.task);
        return Boolean(one.selected) === isChosen ? one : { ...one, selected: isChosen };
      }),
    [now.nodes, assemble.task],
  );
  const changed = useCallback((changes: NodeChange<AnyNode>[]) => {
    const moves = changes.filter((one) => one.type === "position" || one.type === "dimensions");
    if (moves.length)
      setNow((before) => ({ ...before, nodes: applyNodeChanges(moves, before.nodes) }));
    const picked = changes.find((one) => one.type === "select" && one.selected);
    if (picked?.type === "select")
      assemble.choose({ kind: "task", task: picked.id.replace(/^task /, "") });
  }, []);
  const begin: OnConnectStart = (_, { nodeId, handleId }) => {
    const task = nodeId?.replace(/^task /, "") ?? "",
      about = graph?.tasks.find((one) => one.name === task);
    const variable = handleId?.replace(/^(in|out):/, "");
    const port = (handleId?.startsWith("in:") ? about?.ins : about?.outs)?.find(
      (one) => one.variable === variable,
    );
    if (port) assemble.begin(task, port.port);
  };
  const end: OnConnectEnd = (event) => void finish(event);
  const drop = (event: React.DragEvent) => {
    const rmod = event.dataTransfer.getData(DRAGGED);
    if (!rmod) return;
    event.preventDefault();
    const { x, y } = flow.screenToFlowPosition({ x: event.clientX, y: event.clientY });
    const rtpu = rtpuAt(now.nodes, x, y);
    void assemble.change("add_task", { module: rmod, ...(rtpu ? { rtpu } : {}) }, "canvas");
  };
  const pressed = (event: React.KeyboardEvent) => {
    const isCard = (event.target as HTMLElement).closest(".react-flow__node") === event.target;
    if (event.key === "Delete" && isCard && assemble.task)
      void assemble.change("remove_task", { task: assemble.task }, "canvas");
  };
  return (
    <div
      className="drop-place"
      onDragOver={(event) => {
        if (event.dataTransfer.types.includes(DRAGGED)) {
          event.preventDefault();
          event.dataTransfer.dropEffect = "copy";
        }
      }}
      onDrop={drop}
      onKeyDown={pressed}
    >
      <ReactFlow<AnyNode, WireEdge>
        nodes={nodes}
        edges={now.edges}
        nodeTypes={NODE_TYPES}
        edgeTypes={EDGE_TYPES}
        onNodesChange={changed}
        onNodeDragStop={(_, node) => {
          places.current.set(node.id, node.position);
          setNow((before) => refit(before.nodes, before.edges));
        }}
        onConnectStart={begin}
        onConnectEnd={end}
        onPaneClick={() => assemble.choose({ kind: "job" })}
        onEdgeClick={(_, edge) => {
          const name = edge.data!.variables[0];
          if (name) assemble.choose({ kind: "variable", name });
        }}
        connectOnClick={false}
        deleteKeyCode={null}
        minZoom={0.08}
        maxZoom={2.5}
        colorMode="system"
        proOptions={{ hideAttribution: true }}
        multiSelectionKeyCode={null}
        selectionKeyCode={null}
        zoomOnDoubleClick={false}
        elevateNodesOnSelect={false}
      >
        <Markers />
        <Background variant={BackgroundVariant.Dots} gap={22} size={1} />
        <Controls showInteractive={false} />
      </ReactFlow>
    </div>
  );
}

/** Connects the port from which was dragged with what was under the mouse; says why it does not. */
async function finish(event: MouseEvent | TouchEvent): Promise<void> {
  const from = assemble.connecting,
    to = endOf(event),
    reason = assemble.over;
  assemble.end();
  if (!from || !to || (to.task === from.task && to.port === from.port)) return;
  const fits = from.fits.length ? from.fits : await assemble.fitting(from.task, from.port);
  const fit = fits.find((one) =>
    to.port
      ? one.task === to.task && one.port === to.port
      : !one.port && one.variable === to.variable,
  );
  if (fit?.fits) {
    await assemble.connect(from.task, from.port, fit, "canvas");
    return;
  }
  assemble.refuse({
    at: "canvas",
    text:
      reason ||
      `${from.port} of ${from.task} does not fit there: ${fit?.reason ?? "both are inputs, or both outputs"}`,
  });
}

/**
 * What is said while a connection is made, and variables without a port to which it can be made.
 */
function Connection() {
  useAssemble("connecting");
  useAssemble("over");
  const from = assemble.connecting;
  if (!from) return null;
  const alone = from.fits.filter((one) => !one.port);
  return (
    <div className="connection" role="status">
      <p>
        <b>{from.port}</b> of {from.task}: {assemble.over || "drop it on a port that is lit"}
      </p>
      {alone.length > 0 && (
        <p className="alone">
          {alone.map((one) => (
            <span
              key={one.variable}
              className={one.fits ? "fits" : "misfit"}
              data-variable={one.variable}
              title={one.reason}
              onPointerEnter={() =>
                assemble.hover(
                  one.fits ? `connect it to ${one.variable}` : `${one.variable}: ${one.reason}`,
                )
              }
            >
              {one.variable}
            </span>
          ))}
        </p>
      )}
    </div>
  );
}

export function Canvas() {
  const state = useEditor();
  useAssemble("connecting");
  useAssemble("refused");
  return (
    <section
      className={`graph canvas${assemble.connecting ? " connecting" : ""}${state && shouldCompact(state.graph) ? " many" : ""}`}
      aria-label="the job as a graph"
    >
      <ReactFlowProvider>
        <Flow />
      </ReactFlowProvider>
      {state && !state.graph.tasks.length && (
        <p className="empty">Drag a module from the palette onto an RTPU, or press Enter on it.</p>
      )}
      {!state && (
        <p className="empty">
          {assemble.refused?.at === "open"
            ? "No job is open. Choose one above, or begin a new one."
            : "opening the job…"}
        </p>
      )}
      <div className="canvas-messages">
        <Connection />
        <Refusal at="canvas" />
      </div>
    </section>
  );
}
