// From a GRAPH to the nodes and edges that are drawn, and where they stand.
import type { Graph as Digraph } from "@dagrejs/dagre";
import type { Edge, Node } from "@xyflow/react";
import type { Graph, Link, Port, TaskInfo } from "./protocol";

let dagre: typeof import("@dagrejs/dagre") | null = null;
/** Fulfilled when graphs can be drawn: what arranges them comes after the rest of the page. */
export const layoutLoaded: Promise<void> = import("@dagrejs/dagre").then((loaded) => {
  dagre = loaded;
});
export const canDraw = (): boolean => dagre !== null;

export const CARD = 236;
export const SMALL_CARD = 176;
const HEAD = 58,
  PORT_ROW = 22,
  FOOT = 62,
  SMALL_HEIGHT = 52;
const FRAME_PAD = 22,
  FRAME_HEAD = 34;
const LANE = 14;
const MANY_TASKS = 40;

export interface GraphOptions {
  compact: boolean;
  folded: ReadonlySet<string>;
  operator: boolean;
  /** Whether RTPUs without a task are drawn, too. */
  empty?: boolean;
}
export type TaskNode = Node<{ task: TaskInfo; compact: boolean; faulty: string[] }, "task">;
export type FrameNode = Node<
  { rtpu: string; keeper: boolean; tasks: string[]; folded: boolean },
  "frame"
>;
export type OtherNode = Node<{ name: string; what: "subsystem" | "device" }, "other">;
export type AnyNode = TaskNode | FrameNode | OtherNode;
export interface WireData extends Record<string, unknown> {
  variables: string[];
  kind: "variable" | "constant" | "link" | "device" | "fallback";
  /** Whether it shows the label of its variable; one wire of each variable does. */
  labelled: boolean;
  /** Points between its ends, so that it does not pass behind cards. */
  points: [number, number][];
}
export type WireEdge = Edge<WireData, "wire">;
export interface Drawing {
  nodes: AnyNode[];
  edges: WireEdge[];
}

export const shouldCompact = (graph: Graph): boolean => graph.tasks.length > MANY_TASKS;
export const inHandle = (variable: string): string => `in:${variable}`;
export const outHandle = (variable: string): string => `out:${variable}`;
export const portTop = (row: number): number => HEAD + PORT_ROW * row + PORT_ROW / 2;

/** Returns the ports of a task by variable; a variable is drawn once on each side. */
export function portRows(task: TaskInfo): { ins: Port[]; outs: Port[] } {
  const once = (ports: Port[]) => [...new Map(ports.map((one) => [one.variable, one])).values()];
  return { ins: once(task.ins), outs: once(task.outs) };
}

export function cardSize(
  task: TaskInfo,
  compact: boolean,
  operator: boolean,
): { width: number; height: number } {
  if (compact) return { width: SMALL_CARD, height: SMALL_HEIGHT };
  const { ins, outs } = portRows(task);
  return {
    width: CARD,
    height: HEAD + PORT_ROW * Math.max(ins.length, outs.length, 1) + FOOT + (operator ? 34 : 0),
  };
}

/** The wires before they are placed: from node, to node, ports and kind. */
interface Wiring {
  source: string;
  target: string;
  sourceHandle: string;
  targetHandle: string;
  variables: string[];
  kind: WireData["kind"];
}

export function drawing(graph: Graph, options: GraphOptions): Drawing {
  const folded = new Set(
    graph.rtpus.map((one) => one.name).filter((name) => options.folded.has(name)),
  );
  const nodes = makeNodes(graph, options, folded);
  const wirings = options.compact
    ? merged(wiringsOf(graph, options, folded))
    : wiringsOf(graph, options, folded);
  const there = new Set(nodes.map((one) => one.id));
  const edges = asEdges(wirings.filter((one) => there.has(one.source) && there.has(one.target)));
  place(nodes, edges);
  return { nodes, edges };
}

export const taskId = (name: string): string => `task ${name}`;
const frameId = (name: string): string => `rtpu ${name}`;
/** The other end of a link; its writer does not know who reads it. */
const otherEnd = (link: Link): string => link.from || link.to || `link ${link.name}`;

function makeNodes(graph: Graph, options: GraphOptions, folded: Set<string>): AnyNode[] {
  const nodes: AnyNode[] = [];
  for (const rtpu of rtpusOf(graph)) {
    const tasks = graph.tasks.filter((one) => one.rtpu === rtpu).map((one) => one.name);
    if (!tasks.length && !options.empty) continue;
    const isFolded = folded.has(rtpu) || !tasks.length;
    nodes.push({
      id: frameId(rtpu),
      type: "frame",
      position: { x: 0, y: 0 },
      selectable: false,
      zIndex: -1,
      ...(isFolded ? { width: 250, height: 92 } : {}),
      data: {
        rtpu,
        keeper: graph.rtpus.some((one) => one.name === rtpu && one.keeper),
        tasks,
        folded: isFolded,
      },
    });
  }
  for (const task of graph.tasks) {
    if (folded.has(task.rtpu)) continue;
    nodes.push({
      id: taskId(task.name),
      type: "task",
      position: { x: 0, y: 0 },
      ...cardSize(task, options.compact, options.operator),
      data: { task, compact: options.compact, faulty: faultyPorts(graph, task) },
      ariaLabel: `task ${task.name} on ${task.rtpu}`,
    });
  }
  const devices = new Set(graph.tasks.flatMap((one) => one.devices));
  const subsystems = new Set(graph.links.map(otherEnd));
  for (const name of subsystems) nodes.push(otherNode(name, "subsystem"));
  for (const name of devices) nodes.push(otherNode(name, "device"));
  return nodes;
}

function otherNode(name: string, what: "subsystem" | "device"): OtherNode {
  return {
    id: `${what} ${name}`,
    type: "other",
    position: { x: 0, y: 0 },
    width: 150,
    height: 44,
    data: { name, what },
    selectable: false,
  };
}

const rtpusOf = (graph: Graph): string[] => [
  ...new Set([...graph.rtpus.map((one) => one.name), ...graph.tasks.map((one) => one.rtpu)]),
];

/** Returns the variables of a task's ports at which a fault is. */
export function faultyPorts(graph: Graph, task: TaskInfo): string[] {
  const found = new Set<string>();
  for (const fault of graph.faults) {
    if (fault.tasks.length && !fault.tasks.includes(task.name)) continue;
    for (const port of [...task.ins, ...task.outs]) {
      const names = [
        port.port,
        port.variable,
        `${task.name}.${port.port}`,
        `${task.name}.${port.variable}`,
      ];
      if (fault.variables.includes(port.variable) || fault.ports.some((one) => names.includes(one)))
        found.add(port.variable);
    }
  }
  return [...found];
}

function wiringsOf(graph: Graph, options: GraphOptions, folded: Set<string>): Wiring[] {
  const of = new Map(graph.tasks.map((one) => [one.name, one]));
  const end = (task: string): string => {
    const rtpu = of.get(task)?.rtpu ?? "";
    return folded.has(rtpu) ? frameId(rtpu) : taskId(task);
  };
  const handle = (task: string, made: string, side: string): string =>
    options.compact || folded.has(of.get(task)?.rtpu ?? "") ? side : made;
  const found: Wiring[] = [];
  const add = (
    source: string,
    target: string,
    from: string,
    to: string,
    variable: string,
    kind: WireData["kind"],
  ) => {
    found.push({
      source,
      target,
      sourceHandle: from,
      targetHandle: to,
      variables: variable ? [variable] : [],
      kind,
    });
  };
  for (const wire of graph.wires) {
    // Both within one folded frame
    if (end(wire.from) === end(wire.to) && wire.from !== wire.to) continue;
    add(
      end(wire.from),
      end(wire.to),
      handle(wire.from, outHandle(wire.variable), "out"),
      handle(wire.to, inHandle(wire.variable), "in"),
      wire.variable,
      wire.constant ? "constant" : "variable",
    );
  }
  for (const link of graph.links) {
    const other = `subsystem ${otherEnd(link)}`,
      task = of.get(link.task);
    if (!task) continue;
    // The task of a link that comes in gives the variable to others: its port is an output.
    const isOut = task.outs.some((one) => one.variable === link.variable);
    const port = handle(
      task.name,
      isOut ? outHandle(link.variable) : inHandle(link.variable),
      isOut ? "out" : "in",
    );
    if (link.direction === "in")
      add(
        other,
        end(task.name),
        "out",
        isOut ? "device" : port,
        isOut ? "" : link.variable,
        "link",
      );
    else
      add(
        end(task.name),
        other,
        isOut ? port : "device-out",
        "in",
        isOut ? link.variable : "",
        "link",
      );
  }
  for (const task of graph.tasks) {
    for (const device of task.devices)
      add(
        `device ${device}`,
        end(task.name),
        "out",
        folded.has(task.rtpu) ? "in" : "device",
        "",
        "device",
      );
    if (task.fallback_of && of.has(task.fallback_of) && end(task.name) !== end(task.fallback_of)) {
      add(
        end(task.name),
        end(task.fallback_of),
        folded.has(task.rtpu) ? "out" : "fallback-out",
        folded.has(of.get(task.fallback_of)!.rtpu) ? "in" : "fallback-in",
        "",
        "fallback",
      );
    }
  }
  return found;
}

/** Returns one wire for all that lead from one node to another. */
function merged(wirings: Wiring[]): Wiring[] {
  const found = new Map<string, Wiring>();
  for (const one of wirings) {
    const constant = one.kind === "constant" ? "constant" : one.kind;
    const key = `${one.source}>${one.target}>${constant}`;
    const there = found.get(key);
    if (there) there.variables = [...new Set([...there.variables, ...one.variables])];
    else found.set(key, { ...one });
  }
  return [...found.values()];
}

function asEdges(wirings: Wiring[]): WireEdge[] {
  const seen = new Map<string, number>();
  const labels = new Set<string>();
  return wirings.map((one) => {
    const name = one.variables.join(",");
    const base = `${one.source}>${one.target}>${one.kind}>${name}`;
    const count = seen.get(base) ?? 0;
    seen.set(base, count + 1);
    const labelled = one.kind !== "device" && !labels.has(`${one.source}>${name}`);
    labels.add(`${one.source}>${name}`);
    return {
      id: count ? `${base}>${count}` : base,
      type: "wire" as const,
      source: one.source,
      target: one.target,
      sourceHandle: one.sourceHandle,
      targetHandle: one.targetHandle,
      focusable: false,
      data: { variables: one.variables, kind: one.kind, labelled, points: [] },
    };
  });
}

/** Sets the positions of nodes and the points of wires. */
function place(nodes: AnyNode[], edges: WireEdge[]): void {
  const frameOf = new Map<string, string>();
  const open = nodes.filter((one): one is FrameNode => one.type === "frame" && !one.data.folded);
  const there = new Set(open.map((one) => one.id));
  for (const node of nodes) {
    if (node.type === "task" && there.has(frameId(node.data.task.rtpu)))
      frameOf.set(node.id, frameId(node.data.task.rtpu));
  }
  if (nodes.length > MANY_TASKS) return placeMany(nodes, edges, open, frameOf);
  const graph = arranged(
    nodes.filter((one) => !there.has(one.id)),
    edges,
    { ranksep: 110, nodesep: 34, frames: open, frameOf },
  );
  for (const frame of open) fitFrame(frame, nodes, frameOf);
  const down = separateFrames(open, nodes, frameOf);
  routeEdges(nodes, edges, (edge) => {
    const found = graph.edge({ v: edge.source, w: edge.target, name: edge.id }) as
      { points?: { x: number; y: number }[] } | undefined;
    return found?.points?.map(({ x, y }) => [x, down(y)]) ?? [];
  });
}

const FRAME_GAP = 24;

/**
 * Moves down what is below a frame that reaches into another one; returns where a height has moved
 * to.
 */
function separateFrames(
  frames: FrameNode[],
  nodes: AnyNode[],
  frameOf: Map<string, string>,
): (y: number) => number {
  const moves: { from: number; by: number }[] = [];
  const sorted = [...frames].sort((a, b) => a.position.y - b.position.y);
  sorted.forEach((lower, k) => {
    for (const upper of sorted.slice(0, k)) {
      const a = boxOf(upper),
        b = boxOf(lower),
        by = a.bottom + FRAME_GAP - b.top;
      if (a.right <= b.left || b.right <= a.left || by <= 0) continue;
      const inside = nodes.filter((one) => frameOf.get(one.id) === lower.id);
      const from = Math.min(...inside.map((one) => one.position.y));
      for (const node of nodes)
        if ((node.type !== "frame" || node.data.folded) && node.position.y >= from)
          node.position = { x: node.position.x, y: node.position.y + by };
      moves.push({ from, by });
      for (const frame of frames) fitFrame(frame, nodes, frameOf);
    }
  });
  return (y) => moves.reduce((at, { from, by }) => (at >= from ? at + by : at), y);
}

interface Spaces {
  ranksep: number;
  nodesep: number;
  frames?: FrameNode[];
  frameOf?: Map<string, string>;
}

/** Has dagre arrange nodes from left to right along their wires; returns its graph. */
function arranged(nodes: AnyNode[], edges: WireEdge[], spaces: Spaces): Digraph {
  if (!dagre) throw new Error("the layout is not loaded yet");
  const graph: Digraph = new dagre.Graph({ multigraph: true, compound: true });
  graph.setGraph({
    rankdir: "LR",
    ranksep: spaces.ranksep,
    nodesep: spaces.nodesep,
    edgesep: 12,
    marginx: 20,
    marginy: 20,
  });
  graph.setDefaultEdgeLabel(() => ({}));
  for (const frame of spaces.frames ?? []) graph.setNode(frame.id, {});
  for (const node of nodes) {
    // A folded frame keeps away from the frames of other RTPUs, which are larger than their tasks.
    const room = node.type === "frame" ? 2 * FRAME_PAD + FRAME_HEAD : 0;
    graph.setNode(node.id, { width: node.width, height: node.height! + room });
    const frame = spaces.frameOf?.get(node.id);
    if (frame) graph.setParent(node.id, frame);
  }
  for (const edge of edges) {
    if (
      edge.source === edge.target ||
      edge.data!.kind === "fallback" ||
      !graph.hasNode(edge.source) ||
      !graph.hasNode(edge.target)
    )
      continue;
    graph.setEdge(
      edge.source,
      edge.target,
      { weight: edge.data!.kind === "constant" ? 1 : 3, minlen: 1 },
      edge.id,
    );
  }
  dagre.layout(graph);
  for (const node of nodes) {
    const { x, y } = graph.node(node.id) as { x: number; y: number };
    node.position = { x: x - node.width! / 2, y: y - node.height! / 2 };
  }
  return graph;
}

const GAP_X = 56,
  GAP_Y = 20,
  WIDEST = 2.4,
  SHAPE = 1.7;

/** Places each RTPU's tasks by themselves, and the frames in rows: a whole that fits a screen. */
function placeMany(
  nodes: AnyNode[],
  edges: WireEdge[],
  open: FrameNode[],
  frameOf: Map<string, string>,
): void {
  const blocks: AnyNode[] = [
    ...open,
    ...nodes.filter((one) => !frameOf.has(one.id) && !open.some((each) => each === one)),
  ];
  for (const frame of open) {
    const inside = nodes.filter((one) => frameOf.get(one.id) === frame.id);
    intoColumns(inside, edges);
    fitFrame(frame, nodes, frameOf);
    const shape = frame.width! / frame.height!;
    if (shape > WIDEST || shape < 1 / WIDEST) {
      intoRows(inside);
      fitFrame(frame, nodes, frameOf);
    }
  }
  const area = blocks.reduce((sum, one) => sum + (one.width! + GAP_X) * (one.height! + GAP_X), 0);
  const widest = Math.sqrt(area * WIDEST);
  let x = 0,
    y = 0,
    tallest = 0;
  for (const block of blocks) {
    if (x > 0 && x + block.width! > widest) {
      x = 0;
      y += tallest + GAP_X;
      tallest = 0;
    }
    const by = { x: x - block.position.x, y: y - block.position.y };
    for (const node of nodes) {
      if (node === block || frameOf.get(node.id) === block.id)
        node.position = { x: node.position.x + by.x, y: node.position.y + by.y };
    }
    x += block.width! + GAP_X;
    tallest = Math.max(tallest, block.height!);
  }
}

/**
 * Places cards in columns: each to the right of those whose variables it reads, but for wires that
 * lead back.
 * dagre's own way takes seconds for hundreds of cards.
 */
function intoColumns(cards: AnyNode[], edges: WireEdge[]): void {
  const before = new Map<string, string[]>(cards.map((one) => [one.id, []]));
  for (const edge of edges)
    if (before.has(edge.source) && edge.data!.kind !== "fallback")
      before.get(edge.target)?.push(edge.source);
  const columns = new Map<string, number>();
  const columnOf = (id: string): number => {
    const known = columns.get(id);
    if (known !== undefined) return known;
    columns.set(id, 0); // who leads back here comes to stand on the right
    const found = Math.max(0, ...before.get(id)!.map((one) => columnOf(one) + 1));
    columns.set(id, found);
    return found;
  };
  cards.forEach((one) => columnOf(one.id));
  const bottoms = new Map<number, number>();
  for (const card of cards) {
    const column = columns.get(card.id)!,
      y = bottoms.get(column) ?? 0;
    card.position = { x: column * (card.width! + GAP_X), y };
    bottoms.set(column, y + card.height! + GAP_Y);
  }
}

/** Places cards in rows, in the order of their columns. */
function intoRows(cards: AnyNode[]): void {
  const width = cards[0]!.width! + GAP_X,
    height = Math.max(...cards.map((one) => one.height!)) + GAP_Y;
  const columns = Math.max(1, Math.round(Math.sqrt((cards.length * height * SHAPE) / width)));
  const sorted = [...cards].sort(
    (a, b) => a.position.x - b.position.x || a.position.y - b.position.y,
  );
  sorted.forEach((one, k) => {
    one.position = { x: (k % columns) * width, y: Math.floor(k / columns) * height };
  });
}

/** Returns a drawing in which what is as it was before is the same object: it is not drawn anew. */
export function keepEqual(before: Drawing, after: Drawing): Drawing {
  const keep = <T extends { id: string }>(olds: readonly T[], news: readonly T[]): T[] => {
    const known = new Map(olds.map((one) => [one.id, one]));
    return news.map((one) => {
      const old = known.get(one.id);
      return old && JSON.stringify(old) === JSON.stringify(one) ? old : one;
    });
  };
  return { nodes: keep(before.nodes, after.nodes), edges: keep(before.edges, after.edges) };
}

/** Returns the drawing with frames and wires as fits cards that were moved. */
export function refit(nodes: AnyNode[], edges: WireEdge[]): Drawing {
  const frameOf = new Map(
    nodes.flatMap((one) => (one.type === "task" ? [[one.id, frameId(one.data.task.rtpu)]] : [])),
  );
  const newNodes = nodes.map((one) =>
    one.type === "frame" && !one.data.folded ? { ...one } : one,
  );
  for (const one of newNodes)
    if (one.type === "frame" && !one.data.folded) fitFrame(one, newNodes, frameOf);
  const newEdges = edges.map((one) => ({ ...one, data: { ...one.data!, points: [] } }));
  if (newNodes.length <= MANY_TASKS) routeEdges(newNodes, newEdges, () => []);
  return { nodes: newNodes, edges: newEdges };
}

/** Puts a frame around its tasks, which must have at least one. */
function fitFrame(frame: FrameNode, nodes: AnyNode[], frameOf: Map<string, string>): void {
  const inside = nodes.filter((one) => frameOf.get(one.id) === frame.id);
  const left = Math.min(...inside.map((one) => one.position.x)) - FRAME_PAD;
  const top = Math.min(...inside.map((one) => one.position.y)) - FRAME_PAD - FRAME_HEAD;
  const right = Math.max(...inside.map((one) => one.position.x + one.width!)) + FRAME_PAD;
  const bottom = Math.max(...inside.map((one) => one.position.y + one.height!)) + FRAME_PAD;
  frame.position = { x: left, y: top };
  frame.width = right - left;
  frame.height = bottom - top;
}

type Box = { left: number; top: number; right: number; bottom: number };
const boxOf = (node: AnyNode): Box => ({
  left: node.position.x,
  top: node.position.y,
  right: node.position.x + node.width!,
  bottom: node.position.y + node.height!,
});

/**
 * Gives each wire its points: those that lead back run below the cards in lanes of their own,
 * those over several columns follow the layout's way between cards.
 */
function routeEdges(
  nodes: AnyNode[],
  edges: WireEdge[],
  way: (edge: WireEdge) => [number, number][],
): void {
  const cards = nodes.filter((one) => one.type !== "frame" || one.data.folded);
  const boxes = new Map(cards.map((one) => [one.id, boxOf(one)]));
  const lanes: { left: number; right: number; y: number }[] = [];
  for (const edge of edges) {
    const from = boxes.get(edge.source)!,
      to = boxes.get(edge.target)!;
    if (edge.data!.kind === "fallback" || edge.data!.kind === "device") continue;
    if (from.right + 10 <= to.left) {
      edge.data!.points = way(edge).slice(2, -2).length ? way(edge).slice(1, -1) : [];
      continue;
    }
    const left = Math.min(to.left, from.left) - 30,
      right = Math.max(from.right, to.right) + 30;
    let y =
      Math.max(
        ...[...boxes.values()]
          .filter((one) => one.right > left && one.left < right)
          .map((one) => one.bottom),
      ) + 16;
    while (lanes.some((one) => one.left < right && one.right > left && Math.abs(one.y - y) < LANE))
      y += LANE;
    lanes.push({ left, right, y });
    const shift = (lanes.length % 5) * 6;
    edge.data!.points = [
      [from.right + 22 + shift, y],
      [to.left - 22 - shift, y],
    ];
  }
}

/** Returns an SVG path with rounded corners through points, and the middle of its longest part. */
export function wirePath(
  from: [number, number],
  points: readonly [number, number][],
  to: [number, number],
): [string, number, number] {
  if (!points.length) {
    const [sx, sy] = from,
      [tx, ty] = to;
    const bend = Math.max(30, Math.min(110, Math.abs(tx - sx) / 2));
    return [
      `M${sx},${sy}C${sx + bend},${sy} ${tx - bend},${ty} ${tx},${ty}`,
      (sx + tx) / 2,
      (sy + ty) / 2,
    ];
  }
  if (points.length === 2 && points[0]![1] === points[1]![1] && points[1]![0] < points[0]![0])
    return lanePath(from, points, to);
  const all = [from, ...points, to];
  let path = `M${from[0]},${from[1]}`;
  for (let k = 1; k < all.length; k++) {
    const [ax, ay] = all[k - 1]!,
      [bx, by] = all[k]!,
      half = (bx - ax) / 2;
    path += `C${ax + half},${ay} ${bx - half},${by} ${bx},${by}`;
  }
  const middle = all[Math.floor(all.length / 2)]!;
  return [path, middle[0], middle[1]];
}

function lanePath(
  from: [number, number],
  points: readonly [number, number][],
  to: [number, number],
): [string, number, number] {
  const [right, y] = points[0]!,
    left = points[1]![0],
    r = 8;
  const down = y >= from[1] ? 1 : -1,
    up = y >= to[1] ? 1 : -1;
  const path =
    `M${from[0]},${from[1]}H${right - r}Q${right},${from[1]} ${right},${from[1] + r * down}` +
    `V${y - r * down}Q${right},${y} ${right - r},${y}H${left + r}Q${left},${y} ${left},${y - r * up}` +
    `V${to[1] + r * up}Q${left},${to[1]} ${left + r},${to[1]}H${to[0]}`;
  return [path, (left + right) / 2, y];
}

interface Sides {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

/**
 * Returns how far to move a box so that it is within an area; one that is too large keeps its
 * upper left corner there.
 */
export function shiftInto(box: Sides, area: Sides, margin = 8): [number, number] {
  const one = (from: number, to: number, low: number, high: number) => {
    const back = Math.min(0, high - margin - to);
    return back + Math.max(0, low + margin - (from + back));
  };
  return [
    one(box.left, box.right, area.left, area.right),
    one(box.top, box.bottom, area.top, area.bottom),
  ];
}
